"""Contact of a garment with body parts that it does not belong to: an arm on a shirt, a thigh on a skirt.

Parts of the projection. Positions are in metres. NumPy, one frame at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.closest import Closest
from isp_assets.geometry.draw_in import draw_in
from isp_assets.geometry.lifts import (
    ASIDE,
    WATCHED,
    Neighbour,
    any_corner,
    open_beneath,
    shortest_way,
    towards,
)
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.geometry.spread import keep_larger

_SAMPLES = np.array([[1 / 3] * 3, [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
"""Places on a triangle that must be clear besides its corners."""
_SHORTEST_WAY = 1e-4  # below this [m] there is no room to draw anything in


@dataclass(frozen=True, eq=False)
class Ways:
    """Where a garment's vertices may go to leave other parts."""

    room: Float[np.ndarray, " V"]
    """How far each is above the margins over its own parts [m]; infinite where there are none."""
    reach: float
    """Cloth that stays caught is pressed flat onto its own part if it is no further away than this [m]."""
    foreign_reach: float
    """Contact shallower than this [m] is lifted the shortest way, where no other way is known."""


def leave_other_parts(
    position: Float[np.ndarray, "V 3"], mesh: CollisionMesh, near: Sequence[Neighbour], ways: Ways
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    """Draw in what touches another part; where there is no room for that, lift it by what there is.

    Between a corner that is drawn in and one that hangs free, as cloth does behind a pressed arm,
    a triangle would still touch: its corners are drawn in together until it is clear as well.

    Args:
        position: The garment [m].
        mesh: Its collision data.
        near: Every inner garment from the outermost in, then the body.
        ways: Where the vertices may go.

    Returns:
        The moves [m], and the vertices that touch another part.
    """
    if near[0].other is None:
        _look(position, mesh.parts, near)
    lift, touched = _shallow(position, mesh.parts, near, ways)
    pressed: Bool[np.ndarray, " V"] = np.asarray(touched.any(axis=1))
    caught = mesh.topology.faces[any_corner(pressed, mesh.topology.faces)]
    index = np.unique(caught)
    skin = near[-1].obstacle.contacts(position[index], mesh.parts[index], within=ASIDE)
    way = np.zeros_like(position)
    room = np.where(np.isfinite(ways.room), ways.room, 0)[index]
    way[index] = room[:, None] * towards(position[index], skin)
    own = np.flatnonzero(pressed & way.any(axis=1))
    squeeze = _Squeeze(touched, near)
    share, clear = squeeze.draw(position[own], way[own], own[:, None])
    known = clear | (ways.room[own] < ways.reach)
    lift[own[known]] = (share[:, None] * way[own])[known]
    size = np.maximum(np.sqrt(np.einsum("vc,vc->v", way, way)), 1e-9)
    left = np.minimum(size, ways.reach) - np.einsum("vc,vc->v", lift, way) / size
    way *= (left / size).clip(0, 1)[:, None]
    return lift + squeeze.draw_faces(position + lift, way, caught), pressed


def _look(
    position: Float[np.ndarray, "V 3"], parts: Bool[np.ndarray, "V 6"], near: Sequence[Neighbour]
) -> None:
    """Decide which other parts each vertex may meet on which neighbour, and where it is near them."""
    open_parts = ~parts
    for neighbour in near:
        neighbour.other = open_parts
        found = _touch(position, neighbour.other, neighbour)
        neighbour.watched_other = found.height < WATCHED
        open_parts = open_beneath(open_parts, neighbour.obstacle, found)


def _shallow(
    position: Float[np.ndarray, "V 3"], parts: Bool[np.ndarray, "V 6"], near: Sequence[Neighbour], ways: Ways
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V 6"]]:
    """The shortest ways out of shallow contact, as far as there is room; and which parts are touched."""
    lift, touched = np.zeros_like(position), np.zeros_like(parts)
    for neighbour in near:
        assert neighbour.other is not None
        index = np.flatnonzero(neighbour.watched_other)
        found = _touch(position[index], neighbour.other[index], neighbour)
        margin = np.full(len(index), neighbour.obstacle.margin)
        touching = found.height < margin
        touched[index[touching]] |= neighbour.obstacle.parts_at(found.face[touching])
        reach = np.full(len(index), ways.foreign_reach)
        keep_larger(lift, shortest_way(position[index], found, margin, reach), index)
    size = np.sqrt(np.einsum("vc,vc->v", lift, lift))
    return lift * np.minimum(1, ways.room / np.maximum(size, 1e-9))[:, None], touched & ~parts


@dataclass(frozen=True, eq=False)
class _Squeeze:
    """Which other parts the garment touches, and all that they may be part of."""

    touched: Bool[np.ndarray, "V 6"]
    near: Sequence[Neighbour]

    def draw_faces(
        self,
        position: Float[np.ndarray, "V 3"],
        way: Float[np.ndarray, "V 3"],
        caught: Int[np.ndarray, "F 3"],
    ) -> Float[np.ndarray, "V 3"]:
        """Moves along the corners' ways after which centres of faces and edges are clear too."""
        points = np.einsum("qk,fkc->fqc", _SAMPLES, position[caught]).reshape(-1, 3)
        ways = np.einsum("qk,fkc->fqc", _SAMPLES, way[caught]).reshape(-1, 3)
        corners = np.repeat(caught, len(_SAMPLES), axis=0)
        rows = np.flatnonzero(np.einsum("nc,nc->n", ways, ways) > _SHORTEST_WAY**2)
        rows = rows[self.clearance(points[rows], corners[rows]) < 0]
        share, _ = self.draw(points[rows], ways[rows], corners[rows])
        most = np.zeros(len(position))
        used = _SAMPLES[rows % len(_SAMPLES)] > 0
        np.maximum.at(most, corners[rows][used], np.broadcast_to(share[:, None], used.shape)[used])
        return most[:, None] * way

    def draw(
        self, points: Float[np.ndarray, "n 3"], way: Float[np.ndarray, "n 3"], corners: Int[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Share of its way that each point must go, all of it where that is not enough; and where it is."""
        size = np.sqrt(np.einsum("nc,nc->n", way, way))
        if len(points) == 0:
            return size, np.zeros(0, bool)
        moves, clear = draw_in(
            points, way / size[:, None], size, lambda places, rows: self.clearance(places, corners[rows])
        )
        return np.sqrt(np.einsum("nc,nc->n", moves, moves)) / size, clear

    def clearance(
        self, points: Float[np.ndarray, "n 3"], corners: Int[np.ndarray, "n k"]
    ) -> Float[np.ndarray, " n"]:
        """How far points are above the margins over parts that their vertices touch [m]; negative inside."""
        least, parts = np.full(len(points), np.inf), self.touched[corners].any(axis=1)
        for neighbour in self.near:
            assert neighbour.other is not None
            found = _touch(points, parts & neighbour.other[corners].any(axis=1), neighbour)
            least = np.minimum(least, found.height - neighbour.obstacle.margin)
        return least


def _touch(points: Float[np.ndarray, "n 3"], parts: Bool[np.ndarray, "n 6"], neighbour: Neighbour) -> Closest:
    """Closest points on some parts; infinite heights where one lies on a border and no side is known."""
    found = neighbour.obstacle.contacts(points, parts, within=neighbour.obstacle.margin)
    return replace(found, height=np.where(found.on_border | found.on_cut, np.inf, found.height))
