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
from isp_assets.geometry.grading import edge_strain
from isp_assets.geometry.narrow import narrowness, squeezed
from isp_assets.geometry.obstacle import ARMS, TORSO, CollisionMesh, Obstacle, apart_from_arms, mean_edge
from isp_assets.geometry.quasi_newton import QuasiNewton
from isp_assets.geometry.spread import fade_out

_HARD, _EASY = 0.25, 0.12  # limits of strain, for poses that strain cloth a lot and a little
_CONTACT = 4e6  # stiffness of contact per mass [1/s²] in a hard pose; lower limits press harder
_TAUT = (150.0, 1000.0)  # stiffness beyond the limit, relative to the membrane, in a hard and an easy pose
_STEADY = 1e5  # stiffness per mass [1/s²] of springs to the start in an easy pose: it has many minima
_STIFF_MOVES = 100.0  # how much stiffer than flat cloth moves are bent in an easy pose, besides
_LEAST_PRESSED = 0.03  # share of the limit's stiffness that squeezed cloth has, in an easy pose
_AROUND = 0.02  # another limb further than this [m] does not press on cloth
_CAUGHT = 0.002  # cloth this near to the margin of another limb [m] stays where it is
_CAUGHT_FADE = 0.008  # and in an easy pose, less and less firmly, cloth this much further away [m]
_AROUND_ARMHOLE = 0.1  # cloth this near to a held armhole [m] keeps its strain; twice as far, it keeps none
_OVER_HIDDEN = 0.006  # cloth over hidden skin may come as high as it was, or this high [m]


class Relaxation:
    """A garment of V vertices in one frame, whose energy is lowered over what lies beneath.

    Beyond some strain cloth gets much stiffer than its energy says, as threads do: what a pose
    strains most hands it on to its surroundings. What is moved is bent by it as flat cloth would
    be, so that folds are kept where their strain lets them: of many folds with much the same
    energy, the next frame may else find others.

    The lower the limit, the easier the pose: contact and what is beyond the limit get stiffer, as cloth
    presses harder; cloth that is pressed together where there is little room, as in an armpit, is not
    forced apart, since its way out would lead into the skin; and frames are kept alike: springs hold cloth
    at its start, its moves are bent as stiff cloth would be, and where there is no room or another
    limb is near it stays, the more firmly the less room there is.

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
        self.easy = 1 - hard
        self.taut = hard * _TAUT[0] + self.easy * _TAUT[1]
        self.hold = np.maximum(cloth.hold, self.easy * _STEADY * cloth.mass)
        self.bending = (1 + self.easy * _STIFF_MOVES) * cloth.bending
        found = skin.contacts(self.start, own, within=DEEP)
        self.narrow = self.easy * narrowness(skin, found)
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
        held = self.held_at(position)
        moves = held < 1
        springs = (self.hold + held * (self.stiffness - self.hold))[:, None]
        home = self.start + held[:, None] * (position - self.start)
        for _ in range(rounds):
            contact = self._contact(position, moves)

            def energy(
                place: Float[np.ndarray, "V 3"], contact: Penalty = contact
            ) -> tuple[float, Float[np.ndarray, "V 3"]]:
                moved, away = place - self.start, place - home
                bent, pulled = self.bending @ moved, springs * away
                total = 0.5 * float((moved * bent).sum() + (away * pulled).sum())
                gradient = bent + pulled
                parts = (
                    self.cloth.energy(place),
                    self.cloth.limit_energy(place, self.limit, stiffness=self.taut, pressed=self.pressed),
                    contact.energy(place),
                )
                for value, slope in parts:
                    total, gradient = total + value, gradient + slope
                return total, gradient

            position = self._solver.descend(position, energy, steps=steps)
        return position

    def least_strain(self, allowed: float) -> float:
        """Strain (p99) that is to be left: tucked cloth, and cloth around armholes, keeps what it has.

        An open edge between an arm and the torso has many ways to go, and would take another in every frame.

        Args:
            allowed: What is left elsewhere.
        """
        topology = self.mesh.topology
        shoulder = np.zeros(len(self.start), bool)
        shoulder[topology.faces[self.mesh.part_faces[TORSO]]] = True
        shoulder &= self.mesh.parts[:, ARMS].any(axis=1)
        armhole = np.where((topology.border_rings < 1) & shoulder, self.held_at(self.start), 0.0)
        size = mean_edge(self.start, topology.faces)
        around = 2 * fade_out(armhole, topology.faces, reach=2 * _AROUND_ARMHOLE, edge=size)
        kept = np.where(self.still, 1.0, around.clip(max=1))
        of_side = np.maximum(kept[topology.faces], kept[np.roll(topology.faces, -1, axis=1)])
        strain = np.abs(edge_strain(self.start, topology.faces, self.cloth.flat_lengths))
        eased = np.minimum(strain, allowed)
        return max(allowed, float(np.percentile(eased + of_side * (strain - eased), 99)))

    def held_at(self, position: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, " V"]:
        """How firmly vertices stay, 0 to 1: where another limb presses on them, or there is no room.

        Args:
            position: Where they are [m].
        """
        skin, own = self.beneath[0]
        touch = skin.contacts(position, ~own, within=_AROUND)
        fade = max(self.easy * _CAUGHT_FADE, 1e-9)
        caught = ((skin.margin + _CAUGHT + fade - touch.height) / fade).clip(0, 1)
        caught[touch.on_border | touch.on_cut] = 0
        return np.where(self.still, 1.0, np.maximum(caught, self.narrow))

    def _pressed(self, narrow: Bool[np.ndarray, " V"], share: float) -> Float[np.ndarray, " n"]:
        """How firmly each of the cloth's sides resists being pressed together: a share in narrow places."""
        faces = self.mesh.topology.faces
        either = (narrow[faces] | narrow[np.roll(faces, -1, axis=1)]).ravel()
        return np.where(either, share, 1.0)

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
