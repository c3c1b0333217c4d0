"""Contact of a garment with body parts that it does not belong to: an arm on a shirt, a thigh on a skirt.

Parts of the projection. Positions are in metres. NumPy, one frame at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.closest import Closest
from isp_assets.geometry.draw_in import draw_in
from isp_assets.geometry.lifts import ASIDE, WATCHED, Neighbour, open_beneath, shortest_way, towards
from isp_assets.geometry.spread import keep_larger


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
    position: Float[np.ndarray, "V 3"],
    parts: Bool[np.ndarray, "V 6"],
    near: Sequence[Neighbour],
    ways: Ways,
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    """Draw in what touches another part; where there is no room for that, lift it by what there is.

    Args:
        position: The garment [m].
        parts: Which body parts each vertex belongs to.
        near: Every inner garment from the outermost in, then the body.
        ways: Where the vertices may go.

    Returns:
        The moves [m], and the vertices that touch another part.
    """
    lift, touched = np.zeros_like(position), np.zeros_like(parts)
    if near[0].other is None:
        _look(position, parts, near)
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
    lift *= np.minimum(1, ways.room / np.maximum(size, 1e-9))[:, None]
    touched &= ~parts
    pressed: Bool[np.ndarray, " V"] = np.asarray(touched.any(axis=1))
    index = np.flatnonzero(pressed & np.isfinite(ways.room) & (ways.room > 0))
    skin = near[-1].obstacle.contacts(position[index], parts[index], within=ASIDE)
    inwards = towards(position[index], skin)
    known = inwards.any(1)
    index, inwards = index[known], inwards[known]
    if len(index):
        moves, clear = draw_in(
            position[index], inwards, ways.room[index],
            lambda points, rows: _clearance(points, touched[index[rows]], index[rows], near),
        )  # fmt: skip
        known = clear | (ways.room[index] < ways.reach)
        lift[index[known]] = moves[known]
    return lift, pressed


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


def _clearance(
    points: Float[np.ndarray, "n 3"],
    parts: Bool[np.ndarray, "n 6"],
    rows: Int[np.ndarray, " n"],
    near: Sequence[Neighbour],
) -> Float[np.ndarray, " n"]:
    """How far points are above the margins over some parts [m]; negative where they touch."""
    least = np.full(len(points), np.inf)
    for neighbour in near:
        assert neighbour.other is not None
        found = _touch(points, parts & neighbour.other[rows], neighbour)
        least = np.minimum(least, found.height - neighbour.obstacle.margin)
    return least


def _touch(points: Float[np.ndarray, "n 3"], parts: Bool[np.ndarray, "n 6"], neighbour: Neighbour) -> Closest:
    """Closest points on some parts; infinite heights where one lies on a border and no side is known."""
    found = neighbour.obstacle.contacts(points, parts, within=neighbour.obstacle.margin)
    return replace(found, height=np.where(found.on_border | found.on_cut, np.inf, found.height))
