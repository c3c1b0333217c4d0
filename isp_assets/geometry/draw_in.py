"""Draw cloth in from between two body parts: towards its own part, as far as the other one demands.

A sleeve pressed against the torso, or a shirt beneath an arm, may lie deep inside the
other part, where the shortest way out can lead through it. The way along the line
to its own part cannot. Positions are in metres. NumPy, one frame at a time.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

_HALVINGS = 5
_FURTHEST = 3.0  # a point goes so many times as far as it lies within the other part, at most
_STEEPEST = 0.02  # beyond this height [m] the other part is out of sight


def draw_in(
    points: Float[np.ndarray, "P 3"],
    inwards: Float[np.ndarray, "P 3"],
    room: Float[np.ndarray, " P"],
    clearance: Callable[[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]], Float[np.ndarray, " n"]],
) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, " P"]]:
    """The shortest moves along ``inwards`` after which nothing is touched.

    Args:
        points: Points that touch another part [m].
        inwards: Unit directions to their own part.
        room: How far each may go [m].
        clearance: Gives for points, and the rows of ``points`` that they come from, how far they
            are clear; negative while they touch.

    Returns:
        The moves [m]; and where they are enough. Where they are not, the moves take the room:
        the two parts press the cloth flat. A light touch takes little of it, lest cloth jump.
    """
    rows = np.arange(len(points))
    room = np.minimum(room, _FURTHEST * (-clearance(points, rows)).clip(0))
    moves = room[:, None] * inwards
    above = clearance(points + moves, rows)
    clear = above >= 0
    rows = np.flatnonzero(clear)
    if len(rows) == 0:
        return moves, clear
    touching, free = np.zeros(len(rows)), np.ones(len(rows))
    below, above = clearance(points[rows], rows).clip(max=0), above[rows]
    for _ in range(_HALVINGS):
        middle = 0.5 * (touching + free)
        found = clearance(points[rows] + (middle * room[rows])[:, None] * inwards[rows], rows)
        enough = found >= 0
        free, touching = np.where(enough, middle, free), np.where(enough, touching, middle)
        above, below = np.where(enough, found, above), np.where(enough, below, found)
    # Between the last two by a straight line: steps would make the cloth flicker.
    line = -below / np.maximum(np.minimum(above, _STEEPEST) - below, 1e-12)
    moves[rows] = ((touching + line.clip(0, 1) * (free - touching)) * room[rows])[:, None] * inwards[rows]
    return moves, clear
