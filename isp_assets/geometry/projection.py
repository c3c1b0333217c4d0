"""A rung of the ladder: move a garment until it touches nothing beneath it.

Contact is resolved from both sides: garment vertices are lifted off the surfaces
beneath, and the corners of garment triangles are lifted over vertices that poke
through them. Each lift is spread over the neighbourhood and what it stretched is eased,
so that no spike stands out; the last rounds lift without spreading, down to the pairs
of triangles that an exact test still finds crossing. Cloth between two body parts (an
arm and the torso) is drawn in towards its own part. Where there is little room, margins
shrink with it and folds are smoothed; clear cloth that all this drove into the skin goes
back; the order of the layers is given up last of all. Only vertices that came near something are
looked at again.

Positions are in metres, in one shared space. NumPy, one frame and one garment at a
time; obstacles (`Obstacle`) are the body and the finished inner garments.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import Closest, ClosestQuery
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.driven_in import driven_in
from isp_assets.geometry.lifts import (
    ASIDE,
    CLEAR,
    Neighbour,
    any_corner,
    open_beneath,
    over_planes,
    over_vertices,
    shortest_way,
)
from isp_assets.geometry.narrow import crumpled, flatten
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, mean_edge
from isp_assets.geometry.other_parts import Ways, leave_other_parts
from isp_assets.geometry.spread import keep_larger, spread
from isp_assets.geometry.stretch import StretchLimit

BODY_MARGIN = 0.003
"""Clearance to leave over the body [m]."""
LAYER_MARGIN = 0.0025
"""Clearance to leave over an inner garment [m]."""

_SPREAD_DECAY = 0.9  # part of its neighbours' lift that a vertex follows
_RIM = 3.0  # edges from an obstacle's open border within which a deep contact may be one from above the rim
_RIM_REACH = 0.015  # contact deeper than this [m] is left alone there
_LIFT_OUT = 1.1  # a vertex may move this many times its depth at the start
_ORDER_REACH = 0.015  # a garment further beneath an inner one than this [m] cannot be put above it alone


@dataclass(frozen=True)
class ProjectionOptions:
    """How hard to work."""

    rounds: int = 4
    """Rounds of lifting; the last one does not spread."""
    ease: int = 2
    """Steps of easing stretched cloth before the first round; one less after every round but the last."""
    finish: int = 2
    """Rounds of lifting triangles that still cross, at most."""
    spread: int = 8
    """Rings of neighbours that follow a lift."""
    reach: float = 0.06
    """Contact deeper than this [m] is left alone: the way out is not known."""
    foreign_reach: float = 0.015
    """The same for another part of the body, where the cloth cannot be drawn in."""
    poke_reach: float = 0.015
    """How far a vertex beneath may poke through a triangle [m] and still lift it."""
    longest_move: float = 0.05
    """No vertex moves further [m], or 1.1 times its depth at the start: it is caught, as if without room."""
    tolerance: float = 1e-4
    """Lifts below this [m] count as none."""

    def __post_init__(self) -> None:
        if self.rounds < 1 or min(self.finish, self.spread, self.ease) < 0:
            raise GeometryError(f"projection needs rounds >= 1, and nothing below 0, got {self}")


@dataclass(frozen=True, eq=False)
class Projection:
    """A garment clear of what lies beneath it, and what that took."""

    vertices: Float[np.ndarray, "V 3"]
    ran: bool
    """False where nothing touched: ``vertices`` are then the ones that came in."""
    rounds: int
    largest_move: float
    """[m]"""
    tight: Bool[np.ndarray, " V"]
    """Vertices where the surfaces beneath leave no room for cloth."""
    pressed: Bool[np.ndarray, " V"]
    """Vertices between two body parts."""
    crossings: int
    """Pairs of triangles that still cross, where there is room."""


def project(
    vertices: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions | None = None,
    *,
    stretch: StretchLimit | None = None,
    parts: Bool[np.ndarray, "V 6"] | None = None,
) -> Projection:
    """Lift a garment clear of all obstacles.

    Args:
        vertices: The garment in this frame [m].
        mesh: The garment's collision data.
        obstacles: What lies beneath: body first, then inner garments.
        options: How hard to work.
        stretch: The garment's limits of stretch; without them nothing is eased.
        parts: Body parts that its vertices belong to in this frame, if not those of ``mesh``.

    Raises:
        GeometryError: If a position is not finite or the mesh does not fit.
    """
    start = np.ascontiguousarray(vertices, np.float64)
    if not np.isfinite(start).all():
        raise GeometryError("garment positions hold NaN or infinity; check the networks' output")
    options = options or ProjectionOptions()
    mesh = mesh if parts is None else replace(mesh, parts=parts)
    work = _Projector(start, mesh, obstacles, options, stretch)
    rounds = work.lift()
    work.undo(start)
    work.keep_order()
    crossings = work.finish()
    work.keep_order()
    move = float(np.linalg.norm(work.position - start, axis=1).max(initial=0))
    return Projection(work.position, move > 0, rounds, move, work.tight, work.pressed, crossings)


class _Projector:
    """One garment in one frame, while it is being lifted."""

    def __init__(
        self,
        position: Float[np.ndarray, "V 3"],
        mesh: CollisionMesh,
        obstacles: Sequence[Obstacle],
        options: ProjectionOptions,
        stretch: StretchLimit | None,
    ) -> None:
        self.start = self.position = position
        self.mesh, self.options = mesh, options
        self.near: list[Neighbour] = []
        """What lies beneath, the outermost layer first and the body last."""
        open_parts, edge = mesh.parts, mean_edge(position, mesh.topology.faces)
        for obstacle in reversed(obstacles):
            found = obstacle.contacts(position, open_parts, within=ASIDE)
            self.near.append(Neighbour(obstacle, open_parts, found, edge=edge))
            open_parts = open_beneath(open_parts, obstacle, found)
        deepest = np.max([n.depth for n in self.near], axis=0).clip(max=options.reach)
        self.longest = np.maximum(options.longest_move, _LIFT_OUT * deepest)
        self.tight: Bool[np.ndarray, " V"] = np.any([n.cramped for n in self.near], axis=0)
        self.narrow: Float[np.ndarray, " V"] = np.max([n.narrow for n in self.near], axis=0)
        self.stretch = None if stretch is None else crumpled(stretch, mesh, self.narrow, edge=edge)
        self.pressed = np.zeros(len(position), bool)
        """Vertices between two body parts: what lifts them off one drives them into the other."""
        self.ease(steps=options.ease)
        self.start = self.position

    def ease(self, *, steps: int) -> None:
        """Take back strain."""
        if self.stretch is not None:
            self._move(self.stretch.ease(self.position, steps=steps) - self.position)

    def lift(self) -> int:
        """Lift vertices, and triangles once most vertices are clear; the number of rounds taken."""
        options = self.options
        for done in range(options.rounds):
            last = done == options.rounds - 1
            lift = self._lift_vertices(foreign=not last)
            if done > 0 or not lift.any():
                poke = self._lift_triangles(self.position + lift, self.near)
                lift = np.where((lift != 0).any(1, keepdims=True), lift, poke)
            if np.abs(lift).max(initial=0) < options.tolerance:
                return done
            rings = 0 if last else options.spread
            step = spread(lift, self.mesh.topology.neighbour_average, rings=rings, decay=_SPREAD_DECAY)
            self._move(step)
            if not last:
                self._move(flatten(self.position, self.mesh, np.maximum(self.narrow, self.pressed)))
                self.ease(steps=options.ease - 1)
        return options.rounds

    def undo(self, start: Float[np.ndarray, "V 3"]) -> None:
        """Take back what drove clear cloth into the skin."""
        share = driven_in(self.position, start, self.mesh, self.near[-1].obstacle, tight=self.tight)
        if share.any():
            self._move(share[:, None] * (start - self.position))

    def keep_order(self) -> None:
        """Lift what still lies beneath an inner garment just above it, where there is no room as well.

        Margins are not asked for and nothing spreads: what lies on an inner garment is no
        worse off than that garment.
        """
        layers = self.near[:-1]
        if not layers:
            return
        lift = np.zeros_like(self.position)
        for neighbour in layers:
            index, found = self._own_contacts(neighbour)
            margin, reach = np.full(len(index), CLEAR), np.full(len(index), _ORDER_REACH)
            keep_larger(lift, shortest_way(self.position[index], found, margin, reach), index)
        poke = self._lift_triangles(self.position + lift, layers, gap=CLEAR)
        self._move(np.where((lift != 0).any(1, keepdims=True), lift, poke))

    def finish(self) -> int:
        """Lift triangles over the planes of the triangles they still cross; the number left."""
        moved: Bool[np.ndarray, " V"] = np.ones(len(self.position), bool)
        known = [np.zeros((0, 2), np.int64)] * len(self.near)
        for attempt in range(self.options.finish + 1):
            lift = np.zeros_like(self.position)
            for number, neighbour in enumerate(self.near):
                known[number] = pairs = self._crossings(neighbour, moved, known[number])
                if len(pairs) and attempt < self.options.finish:
                    keep_larger(
                        lift, over_planes(self.position, self.mesh.topology.faces, neighbour.obstacle, pairs)
                    )
            if not lift.any():
                break
            self._move(lift)
            moved = (lift != 0).any(axis=1)
        return sum(map(len, known))

    def _move(self, step: Float[np.ndarray, "V 3"]) -> None:
        self.position = self.position + step
        moved = np.abs(step).max(1) > self.options.tolerance
        total = self.position - self.start
        far = np.flatnonzero(np.einsum("vc,vc->v", total, total) > self.longest**2)
        share = self.longest[far] / np.linalg.norm(total[far], axis=1)
        self.position[far], self.tight[far] = self.start[far] + share[:, None] * total[far], True
        for neighbour in self.near:
            neighbour.watched |= moved
            neighbour.found = None

    def _lift_vertices(self, *, foreign: bool) -> Float[np.ndarray, "V 3"]:
        """The largest lift over all obstacles; foreign contact may only use up room above the own margins."""
        own, room = np.zeros_like(self.position), np.full(len(self.position), np.inf)
        for neighbour in self.near:
            obstacle, (index, found) = neighbour.obstacle, self._own_contacts(neighbour)
            margin = obstacle.margin_at(found)
            # A sleeve beneath the cut of a layer's strap lies beside the strap.
            rim = (found.on_cut & (neighbour is not self.near[-1])) | (obstacle.border_rings_at(found) < _RIM)
            reach = np.where(rim, _RIM_REACH, self.options.reach)
            keep_larger(own, shortest_way(self.position[index], found, margin, reach), index)
            spare = (found.height - margin).clip(0)
            room[index] = np.minimum(room[index], np.where(found.on_border, np.inf, spare))
        if not foreign:
            return own
        ways = Ways(room, self.options.reach, self.options.foreign_reach)
        other, pressed = leave_other_parts(self.position, self.mesh, self.near, ways)
        self.pressed |= pressed
        return np.where((own != 0).any(1, keepdims=True), own, other)

    def _own_contacts(self, neighbour: Neighbour) -> tuple[Int[np.ndarray, " n"], Closest]:
        """Vertices that are near an obstacle, and their closest points on it."""
        if neighbour.found is not None:
            return np.arange(len(self.position)), neighbour.found
        index = np.flatnonzero(neighbour.watched)
        points, own = self.position[index], neighbour.own[index]
        return index, neighbour.obstacle.contacts(points, own, within=ASIDE)

    def _lift_triangles(
        self, position: Float[np.ndarray, "V 3"], near: Sequence[Neighbour], *, gap: float | None = None
    ) -> Float[np.ndarray, "V 3"]:
        """Lift the corners of triangles over obstacle vertices that poke through them, by ``gap`` [m].

        By default that is half of the obstacle's margins.
        """
        lift = np.zeros_like(position)
        if not any(len(neighbour.faces) for neighbour in near):
            return lift
        query, reach = ClosestQuery(position, self.mesh.topology), self.options.poke_reach
        for neighbour in near:
            keep_larger(lift, over_vertices(query, self.mesh.parts, neighbour, gap=gap, reach=reach))
        return lift

    def _crossings(
        self, neighbour: Neighbour, moved: Bool[np.ndarray, " V"], known: Int[np.ndarray, "m 2"]
    ) -> Int[np.ndarray, "n 2"]:
        """Crossing pairs of faces that share a part and have room; ``known`` are those before some moved."""
        obstacle, faces = neighbour.obstacle, self.mesh.topology.faces
        beneath, stirred = obstacle.mesh.topology.faces, any_corner(moved, faces)
        mine = np.flatnonzero(any_corner(neighbour.watched, faces) & stirred)
        pairs = crossing_pairs(self.position, faces[mine], obstacle.vertices, beneath[neighbour.faces])
        pairs = np.stack([mine[pairs[:, 0]], neighbour.faces[pairs[:, 1]]], axis=1)
        above, below = faces[pairs[:, 0]], beneath[pairs[:, 1]]
        own = (self.mesh.parts[above].any(1) & obstacle.mesh.parts[below].any(1)).any(1)
        trapped = (self.tight | self.pressed)[above].any(1) | obstacle.tight[below].any(1)
        return np.concatenate([known[~stirred[known[:, 0]]], pairs[own & ~trapped]])
