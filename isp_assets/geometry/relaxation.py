"""Relax a garment that is strained: a state of lower energy near by, clear of what lies beneath.

Projection looks at one vertex at a time and eases what it strained close by. Where a pose strains
a whole garment, as a deep squat does its seat, the cloth has to move as a whole. That is a
minimum of its energy (membrane, bending, gravity) over planes through the nearest skin and the
nearest cloth of every layer beneath (`contact_planes`), which are looked up anew after every few
steps of L-BFGS (`quasi_newton`) around the constant matrix of projective dynamics, factored once a
garment.

Positions are in metres, Y up, in one shared space. NumPy, one frame at a time.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import ClosestQuery
from isp_assets.geometry.contact_planes import DEEP, Penalty, Planes, nearest
from isp_assets.geometry.elastic_cloth import ElasticCloth
from isp_assets.geometry.narrow import squeezed
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, apart_from_arms
from isp_assets.geometry.quasi_newton import QuasiNewton

_HARD, _EASY = 0.25, 0.12  # limits of strain, for poses that strain cloth a lot and a little
_CONTACT = 4e6  # stiffness of contact per mass [1/s²] in a hard pose; lower limits press harder
_STEADY = 3e4  # stiffness per mass [1/s²] of springs to the start in an easy pose: it has many minima
_LEAST_PRESSED = 0.03  # share of the limit's stiffness that squeezed cloth has, in an easy pose
_AROUND = 0.02  # another limb further than this [m] does not press on cloth
_CAUGHT = 0.002  # cloth this near to the margin of another limb [m] stays where it is
_OVER_HIDDEN = 0.006  # cloth over hidden skin may come as high as it was, or this high [m]


class Relaxation:
    """A garment of V vertices in one frame, whose energy is lowered over what lies beneath.

    Beyond some strain cloth gets much stiffer than its energy says, as threads do: what a pose
    strains most hands it on to its surroundings. What is moved is bent by it as flat cloth would
    be, so that folds are kept where their strain lets them: of many folds with much the same
    energy, the next frame may else find others.

    The lower the limit, the easier the pose: contact gets stiffer, as cloth presses harder; springs to
    the start keep frames alike; and cloth that is pressed together where there is little room, as in an
    armpit, is not forced apart, since its way out would lead into the skin.

    Args:
        start: The garment in this frame, clear of what lies beneath [m].
        cloth: Its energy.
        mesh: Its collision data, with the parts that its vertices belong to in this frame.
        beneath: The body, then every inner garment.
        limit: Strain of an edge beyond which cloth gets stiff.
        still: Vertices that stay, such as those of a hem that was pressed flat.
    """

    def __init__(
        self,
        start: Float[np.ndarray, "V 3"],
        cloth: ElasticCloth,
        mesh: CollisionMesh,
        beneath: Sequence[Obstacle],
        *,
        limit: float = _HARD,
        still: Bool[np.ndarray, " V"] | None = None,
    ) -> None:
        self.start, self.cloth, self.mesh = np.ascontiguousarray(start, np.float64), cloth, mesh
        self.limit = limit
        hard = float(np.clip((limit - _EASY) / (_HARD - _EASY), 0, 1))
        self.still = np.zeros(len(start), bool) if still is None else still
        own, skin = apart_from_arms(mesh.parts), beneath[0]
        self.beneath = [(skin, own), *((layer, mesh.parts) for layer in beneath[1:])]
        self.stiffness = _CONTACT * (_HARD / limit) ** 2 * cloth.mass
        self.hold = np.maximum(cloth.hold, (1 - hard) * _STEADY * cloth.mass)
        found = skin.contacts(self.start, own, within=DEEP)
        self.highest = found.height.clip(_OVER_HIDDEN, DEEP)
        self.pressed = self._pressed(squeezed(skin, found), max(np.sqrt(hard), _LEAST_PRESSED))
        self._solver = QuasiNewton(cloth.solver.solve)

    def advance(
        self, position: Float[np.ndarray, "V 3"], *, rounds: int = 3, steps: int = 10
    ) -> Float[np.ndarray, "V 3"]:
        """Lower the energy further.

        Args:
            position: The start, or what the last call gave [m].
            rounds: Times that the nearest surfaces are looked up.
            steps: Steps after each.

        Returns:
            New positions [m]. They may cut what lies beneath by some tenths of a millimetre.

        Raises:
            GeometryError: If ``rounds`` or ``steps`` is below 1.
        """
        if min(rounds, steps) < 1:
            raise GeometryError(f"relaxing needs at least 1 round and 1 step, got {rounds} and {steps}")
        position = np.ascontiguousarray(position, np.float64)
        moves = ~(self._caught(position) | self.still)
        springs = np.where(moves, self.hold, self.stiffness)[:, None]
        home = np.where(moves[:, None], self.start, position)
        for _ in range(rounds):
            contact = self._contact(position, moves)

            def energy(
                place: Float[np.ndarray, "V 3"], contact: Penalty = contact
            ) -> tuple[float, Float[np.ndarray, "V 3"]]:
                moved, away = place - self.start, place - home
                bent, pulled = self.cloth.bending @ moved, springs * away
                total = 0.5 * float((moved * bent).sum() + (away * pulled).sum())
                gradient = bent + pulled
                parts = (
                    self.cloth.energy(place),
                    self.cloth.limit_energy(place, self.limit, pressed=self.pressed),
                    contact.energy(place),
                )
                for value, slope in parts:
                    total, gradient = total + value, gradient + slope
                return total, gradient

            position = self._solver.descend(position, energy, steps=steps)
        return position

    def _pressed(self, narrow: Bool[np.ndarray, " V"], share: float) -> Float[np.ndarray, " n"]:
        """How firmly each of the cloth's sides resists being pressed together: a share in narrow places."""
        faces = self.mesh.topology.faces
        either = (narrow[faces] | narrow[np.roll(faces, -1, axis=1)]).ravel()
        return np.where(either, share, 1.0)

    def _caught(self, position: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
        """Vertices that another limb presses on."""
        skin, own = self.beneath[0]
        touch = skin.contacts(position, ~own, within=_AROUND)
        return (touch.height < skin.margin + _CAUGHT) & ~touch.on_border & ~touch.on_cut

    def _contact(self, position: Float[np.ndarray, "V 3"], moves: Bool[np.ndarray, " V"]) -> Penalty:
        """Contact of vertices that move."""
        vertices = np.repeat(np.flatnonzero(moves)[:, None], 3, axis=1)
        faces = self.mesh.topology.faces
        faces = faces[moves[faces].all(axis=1)]
        garment = ClosestQuery(position, self.mesh.topology)
        (skin, own), *layers = self.beneath
        on_skin = nearest(position, vertices, skin, own)
        planes = [
            Planes.above(position, vertices, skin, on_skin),
            Planes.near_hidden(position, vertices, skin, on_skin, self.highest),
        ]
        planes += [
            Planes.above(position, corner, layer, nearest(position, corner, layer, parts))
            for layer, parts in layers
            for corner in (vertices, faces)
        ]
        planes += [Planes.over_vertices(garment, *on, concerned=moves) for on in self.beneath]
        return Planes.joined(planes).penalty(len(position), self.stiffness)
