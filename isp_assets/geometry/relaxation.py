"""Relax a garment that is strained: a state of lower energy near by, clear of what lies beneath.

Projection looks at one vertex at a time and eases what it strained close by. Where a pose strains
a whole garment, as a deep squat does its seat, the cloth has to move as a whole. That is a
minimum of its energy (membrane, bending, gravity) over planes through the nearest skin and the
nearest cloth of every layer beneath (`contact_planes`), which are looked up anew after every few
steps. Each step is one of L-BFGS, whose first guess of the inverse Hessian is the constant matrix
of projective dynamics, factored once a garment.

Positions are in metres, Y up, in one shared space. NumPy, one frame at a time.

Reference: Liu, Bouaziz and Kavan, "Quasi-Newton Methods for Real-Time Simulation of
Hyperelastic Materials", ACM Transactions on Graphics 36(3), 2017.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import ClosestQuery
from isp_assets.geometry.contact_planes import DEEP, Penalty, Planes
from isp_assets.geometry.elastic_cloth import ElasticCloth
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, apart_from_arms

_CONTACT = 4e6  # stiffness of contact per mass [1/s²]
_AROUND = 0.02  # another limb further than this [m] does not press on cloth
_CAUGHT = 0.002  # cloth this near to the margin of another limb [m] stays where it is
_OVER_HIDDEN = 0.006  # cloth over hidden skin may come as high as it was, or this high [m]
_MEMORY = 10  # steps that L-BFGS remembers
_SHORTENINGS = 12  # halvings of a step that does not lower the energy
_DESCENT = 1e-4  # share of the promised decrease that a step must bring
_SETTLED = 1e-7  # decrease [J] below which nothing more happens

Energy = Callable[[Float[np.ndarray, "V 3"]], tuple[float, Float[np.ndarray, "V 3"]]]
"""Energy [J] of positions, and its gradient [N]."""


class Relaxation:
    """A garment of V vertices in one frame, whose energy is lowered over what lies beneath.

    Beyond some strain cloth gets much stiffer than its energy says, as threads do: what a pose
    strains most hands it on to its surroundings. What is moved is bent by it as flat cloth would
    be, so that folds are kept where their strain lets them: of many folds with much the same
    energy, the next frame may else find others.

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
        limit: float = 0.25,
        still: Bool[np.ndarray, " V"] | None = None,
    ) -> None:
        self.start, self.cloth, self.mesh = np.ascontiguousarray(start, np.float64), cloth, mesh
        self.limit = limit
        self.still = np.zeros(len(start), bool) if still is None else still
        own, skin = apart_from_arms(mesh.parts), beneath[0]
        self.beneath = [(skin, own), *((layer, mesh.parts) for layer in beneath[1:])]
        self.stiffness = _CONTACT * cloth.mass
        self.highest = skin.contacts(self.start, own, within=DEEP).height.clip(_OVER_HIDDEN, DEEP)

    def advance(
        self, position: Float[np.ndarray, "V 3"], *, rounds: int = 4, steps: int = 10
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
        springs = np.where(moves, self.cloth.hold, self.stiffness)[:, None]
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
                    self.cloth.limit_energy(place, self.limit),
                    contact.energy(place),
                )
                for value, slope in parts:
                    total, gradient = total + value, gradient + slope
                return total, gradient

            position = _descend(position, energy, self.cloth, steps=steps)
        return position

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
        planes = [Planes.above(position, vertices, *on) for on in self.beneath]
        planes += [Planes.above(position, faces, *on) for on in layers]
        planes += [Planes.over_vertices(garment, *on, concerned=moves) for on in self.beneath]
        planes += [Planes.near_hidden(position, vertices, skin, own, self.highest)]
        return Planes.joined(planes).penalty(len(position), self.stiffness)


def _descend(
    position: Float[np.ndarray, "V 3"], energy: Energy, cloth: ElasticCloth, *, steps: int
) -> Float[np.ndarray, "V 3"]:
    """Some steps of L-BFGS, each shortened until it lowers the energy."""
    history: list[tuple[np.ndarray, np.ndarray, float]] = []
    value, gradient = energy(position)
    for _ in range(steps):
        direction = _direction(gradient, history, cloth)
        slope = float((gradient * direction).sum())
        if slope >= 0:
            break
        for halving in range(_SHORTENINGS):
            step = 0.5**halving * direction
            reached, turned = energy(position + step)
            if reached <= value + _DESCENT * 0.5**halving * slope:
                break
        else:
            break
        change = turned - gradient
        curvature = float((step * change).sum())
        if curvature > 0:
            history = [*history[1 - _MEMORY :], (step, change, 1 / curvature)]
        gain, position, value, gradient = value - reached, position + step, reached, turned
        if gain < _SETTLED:
            break
    return position


def _direction(
    gradient: Float[np.ndarray, "V 3"],
    history: list[tuple[np.ndarray, np.ndarray, float]],
    cloth: ElasticCloth,
) -> Float[np.ndarray, "V 3"]:
    """The two-loop recursion of L-BFGS around the factored matrix."""
    left, shares = gradient.copy(), []
    for step, change, weight in reversed(history):
        shares.append(weight * float((step * left).sum()))
        left -= shares[-1] * change
    direction = cloth.solver.solve(left)
    for (step, change, weight), share in zip(history, reversed(shares), strict=True):
        direction += (share - weight * float((change * direction).sum())) * step
    return -direction
