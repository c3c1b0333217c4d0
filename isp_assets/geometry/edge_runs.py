"""Edges of a panel: stretches of its outline with one label, between crisp corners.

A learnt label field is noisy where two edges meet, and a contour on a grid cuts
corners off. So labels are smoothed along the outline, stretches too short to be
edges join a neighbour, and every meeting point moves to the corner nearby, if there is one.

Lengths are network units: the panel's square is 2 wide.
"""

from bisect import bisect_right
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_SMOOTHING = 0.012
"""Half width of the label average along the outline."""
_SHORT = 0.03
"""Stretches shorter than this are label noise."""
_WINDOW = 0.035
"""How far from a label switch its corner is looked for."""
_CHORD = 0.025
"""Length of the two chords that measure how much the outline turns."""
_TURN = np.deg2rad(40.0)
"""Turns smaller than this are no corner."""
_SHARP = np.deg2rad(48.0)
"""Turns larger than this are corners even where the label stays, as at the tip of a V-neck."""
_CONFIDENT = 6.0
"""Log odds beyond this count alike: one sure point must not outvote its neighbours."""


@dataclass(frozen=True, eq=False)
class EdgeRun:
    """One edge of a panel's outline."""

    label: int
    points: Float[np.ndarray, "n 2"]
    """From corner to corner, counter-clockwise about the panel; ends where the next run begins."""

    @property
    def length(self) -> float:
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class _Corner:
    """Where one run ends and the next begins, between points of the outline."""

    position: Float[np.ndarray, "2"]
    last: int
    """Last outline point of the run before."""
    first: int
    """First outline point of the run after; may exceed the number of points by one round."""


def split_edges(points: Float[np.ndarray, "n 2"], logits: Float[np.ndarray, "n L"]) -> tuple[EdgeRun, ...]:
    """Cut a closed outline into labelled edges.

    Args:
        points: Closed polygon, counter-clockwise, evenly spaced, no repeated end point.
        logits: Label logits at its points; label 0 ("no edge") is never chosen.

    Returns:
        Runs in order, each ending where the next begins. Sharp corners end a run too, so
        neighbours may have one label. A smooth loop with one label gives one run, closed on itself.
    """
    n = len(points)
    step = float(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).mean())
    evidence = _smooth(_log_probability(logits), round(_SMOOTHING / step))
    starts, labels = (a.tolist() for a in _merge_short(evidence, max(2, round(_SHORT / step))))
    turn = _turning(points, max(2, round(_CHORD / step)))
    starts, labels = _add_sharp_corners(starts, labels, turn, round(2 * _WINDOW / step))
    if len(starts) == 1:
        return (EdgeRun(labels[0] + 1, np.concatenate([points, points[:1]])),)
    lengths = np.diff(np.append(starts, starts[0] + n))
    corners = []
    for k, start in enumerate(starts):
        room = min(lengths[k - 1], lengths[k]) // 2 - 1
        window = int(min(max(room, 0), round(_WINDOW / step)))
        switch = _switch_position(evidence, start, labels[k - 1], labels[k])
        corners.append(_place_corner(points, turn, switch, window))
    return tuple(
        EdgeRun(labels[k] + 1, _between(points, corners[k], corners[(k + 1) % len(corners)]))
        for k in range(len(starts))
    )


def dissolve(loop: tuple[EdgeRun, ...], index: int, *, label: int | None = None) -> tuple[EdgeRun, ...]:
    """Give one run of a loop to a neighbour; runs that then meet with this label become one.

    Args:
        loop: Runs in order; a lone run stays as it is.
        index: The run to dissolve.
        label: Label that it gets if a neighbour has it; otherwise the longer neighbour's.
    """
    if len(loop) == 1:
        return loop
    rotated = loop[index:] + loop[:index]
    neighbours = (rotated[-1], rotated[1])
    if label not in {run.label for run in neighbours}:
        label = max(neighbours, key=lambda run: run.length).label
    return join_alike((EdgeRun(label, rotated[0].points), *rotated[1:]), {label})


def join_alike(loop: tuple[EdgeRun, ...], labels: Collection[int]) -> tuple[EdgeRun, ...]:
    """Merge neighbours of one label, if it is among ``labels``; across the loop's ends too."""
    joined = [loop[0]]
    for run in loop[1:]:
        if run.label == joined[-1].label and run.label in labels:
            joined[-1] = _append(joined[-1], run)
        else:
            joined.append(run)
    if len(joined) > 1 and joined[0].label == joined[-1].label and joined[0].label in labels:
        joined = [_append(joined[-1], joined[0]), *joined[1:-1]]
    return tuple(joined)


def _append(first: EdgeRun, second: EdgeRun) -> EdgeRun:
    return EdgeRun(first.label, np.concatenate([first.points, second.points[1:]]))


def _log_probability(logits: Float[np.ndarray, "n L"]) -> Float[np.ndarray, "n K"]:
    """Bounded log probabilities of labels 1, 2, ...; column 0 is label 1."""
    edges = np.asarray(logits[:, 1:], dtype=np.float64)
    shifted = edges - edges.max(axis=1, keepdims=True)
    return np.maximum(shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True)), -_CONFIDENT)


def _smooth(values: Float[np.ndarray, "n K"], reach: int) -> Float[np.ndarray, "n K"]:
    """Mean over ``2 reach + 1`` neighbours on a closed curve."""
    reach = min(reach, (len(values) - 1) // 2)
    return np.mean([np.roll(values, shift, axis=0) for shift in range(-reach, reach + 1)], axis=0)


def _merge_short(evidence: Float[np.ndarray, "n K"], shortest: int):
    """Runs of equal best label: their starts and labels, none shorter than ``shortest`` points."""
    n = len(evidence)
    best = evidence.argmax(axis=1)
    starts = np.flatnonzero(best != np.roll(best, 1))
    if len(starts) == 0:
        return np.array([0]), best[:1]
    labels = best[starts]
    total = np.concatenate(
        [[np.zeros(evidence.shape[1])], np.cumsum(np.concatenate([evidence, evidence]), axis=0)]
    )
    while len(starts) > 1:
        lengths = np.diff(np.append(starts, starts[0] + n))
        k = int(lengths.argmin())
        if lengths[k] >= shortest:
            break
        score = total[starts[k] + lengths[k]] - total[starts[k]]
        before, after = labels[k - 1], labels[(k + 1) % len(labels)]
        labels[k] = before if score[before] >= score[after] else after
        new = labels != np.roll(labels, 1)
        if not new.any():
            return np.array([0]), labels[:1]
        starts, labels = starts[new], labels[new]
    return starts, labels


def _add_sharp_corners(starts: list[int], labels: list[int], turn: Float[np.ndarray, " n"], apart: int):
    """Starts and labels of runs, cut at sharp corners that lie ``apart`` points or more from other starts."""
    n = len(turn)
    alone = len(starts) == 1
    found = [] if alone else list(starts)
    for corner in np.argsort(-np.abs(turn), kind="stable").tolist():
        if abs(turn[corner]) < _SHARP:
            break
        if all(min((corner - s) % n, (s - corner) % n) >= apart for s in found):
            found.append(corner)
    if not found:
        return starts, labels
    # A run has the label of the last label switch at or before its start.
    found.sort()
    return found, [labels[bisect_right(starts, s) - 1] for s in found]


def _turning(points: Float[np.ndarray, "n 2"], reach: int) -> Float[np.ndarray, " n"]:
    """Angle between the chords before and after every point [rad], positive for convex corners."""
    reach = min(reach, (len(points) - 1) // 2)
    before, after = points - np.roll(points, reach, axis=0), np.roll(points, -reach, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.arctan2(cross, (before * after).sum(axis=1))


def _switch_position(evidence: Float[np.ndarray, "n K"], start: int, old: int, new: int) -> float:
    """Where, in points, the evidence for two labels is equal: between ``start - 1`` and ``start``."""
    difference = evidence[[start - 1, start], new] - evidence[[start - 1, start], old]
    if not difference[0] < 0 <= difference[1]:
        return start - 0.5
    return start - 1 + float(difference[0] / (difference[0] - difference[1]))


def _place_corner(
    points: Float[np.ndarray, "n 2"], turn: Float[np.ndarray, " n"], switch: float, window: int
) -> _Corner:
    """The sharpest point near a label switch, or the switch itself on a smooth stretch."""
    n = len(points)
    around = round(switch) + np.arange(-window, window + 1)
    near = np.abs(turn[around % n]) * (1 - 0.3 * np.abs(around - switch) / (window + 1))
    center = int(around[near.argmax()])
    if abs(turn[center % n]) < _TURN:
        last = int(np.floor(switch))
        share = switch - last
        position = (1 - share) * points[last % n] + share * points[(last + 1) % n]
        # A point nearer than half a step to the corner would make a needle of an edge.
        return _Corner(position, last - (share < 0.5), last + 1 + (share >= 0.5))
    sharp = _meet(points[(center + np.arange(-4, -1)) % n], points[(center + np.arange(4, 1, -1)) % n])
    step = np.linalg.norm(points[(center + 1) % n] - points[center % n])
    if sharp is None or np.linalg.norm(sharp - points[center % n]) > 1.5 * step:
        return _Corner(points[center % n], center - 1, center + 1)
    return _Corner(sharp, center - 2, center + 2)


def _meet(before: Float[np.ndarray, "m 2"], after: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "2"] | None:
    """Where the lines through two short stretches cross; None if they are nearly parallel."""
    origins = np.stack([before.mean(axis=0), after.mean(axis=0)])
    lines = [
        np.linalg.svd(stretch - origin)[2][0]
        for stretch, origin in zip((before, after), origins, strict=True)
    ]
    cross = lines[0][0] * lines[1][1] - lines[0][1] * lines[1][0]
    if abs(cross) < 0.3:
        return None
    gap = origins[1] - origins[0]
    return origins[0] + lines[0] * (gap[0] * lines[1][1] - gap[1] * lines[1][0]) / cross


def _between(points: Float[np.ndarray, "n 2"], start: _Corner, end: _Corner) -> Float[np.ndarray, "m 2"]:
    """Polyline from corner to corner."""
    n = len(points)
    index: Int[np.ndarray, " m"] = start.first + np.arange((end.last - start.first) % n + 1)
    if (end.last - start.first) % n > n - 8:  # the corners' surroundings overlap: nothing lies between
        index = index[:0]
    return np.concatenate([[start.position], points[index % n], [end.position]])
