"""Sewing patterns as labelled outlines, and their triangulation into one sewn mesh.

Panels lie in the frontal plane of the body: x towards its left, y up [m]. Front and
back share that plane, so seam curves that are equal in both panels meet point by point.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from isp_assets.conventions import PANELS
from isp_assets.errors import GarmentError
from isp_assets.geometry.topology import weld
from isp_assets.geometry.triangulate import triangulate_panel
from isp_assets.train.landmarks import Landmarks, RestBody

Curve = Float[np.ndarray, "_ 2"]


@dataclass(frozen=True, eq=False)
class PatternEdge:
    """A stretch of a panel's outline with one label; one label may cover several stretches."""

    label: int
    points: Float[np.ndarray, "n 2"]
    """Polyline [m]; its last point is the first of the next edge."""


Loop = tuple[PatternEdge, ...]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Two panels, each one or more closed loops of edges, counter-clockwise."""

    panels: Mapping[str, tuple[Loop, ...]]
    seam_pairs: tuple[tuple[int, int], ...]
    """Labels (front, back) of edges that are sewn together."""
    anchor_labels: tuple[int, ...] = ()
    """Edges that the body holds: a waistband."""


@dataclass(frozen=True)
class PatternCategory:
    """What is common to all garments of a category."""

    name: str
    edge_names: Mapping[int, str]
    seam_pairs: tuple[tuple[int, int], ...]
    anchor_labels: tuple[int, ...]
    presets: Mapping[str, Any]
    """Named garments and their parameters."""
    sample: Callable[[np.random.Generator], Any]
    """Draws random parameters."""
    draw: Callable[[RestBody, Landmarks, Any], Pattern]
    """Makes the pattern on a body in its rest pose; the landmarks are those of its T-pose."""
    panel_center: Callable[[Landmarks], tuple[float, float]]
    """Centre of the network's coordinates [m], from the landmarks in the rest pose."""
    panel_scale: float
    """Metres per unit of the network's coordinates."""
    leg_angle: float = 0.0
    """Outward turn of both legs in the rest pose [rad]."""


@dataclass(frozen=True, eq=False)
class SewnPanel:
    """A triangulated panel of a sewn pattern."""

    xy: Float[np.ndarray, "P 2"]
    faces: Int[np.ndarray, "F 3"]
    """Wound so that the sewn surface faces outwards: the front counter-clockwise in xy, the back not."""
    vertex_index: Int[np.ndarray, " P"]


@dataclass(frozen=True, eq=False)
class SewnPattern:
    """Both panels welded along their seams."""

    panels: Mapping[str, SewnPanel]
    anchors: Int[np.ndarray, " A"]
    vertex_xy: Float[np.ndarray, "V 2"]
    """Flat position of every welded vertex [m]."""
    vertex_side: Int[np.ndarray, " V"]
    """1 on the front panel, -1 on the back, 0 on a seam."""
    twins: Int[np.ndarray, "n 2"]
    """Front and back vertices at the same flat position."""

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles over welded vertices, front first."""
        return np.concatenate([p.vertex_index[p.faces] for p in self.panels.values()])

    @property
    def corner_xy(self) -> Float[np.ndarray, "F 3 2"]:
        """Flat positions of the corners of ``faces`` [m]."""
        return np.concatenate([p.xy[p.faces] for p in self.panels.values()])


def sew(pattern: Pattern, spacing: float) -> SewnPattern:
    """Triangulate both panels and weld them along the seams.

    Raises:
        GarmentError: If the two sides of a seam do not have equal curves.
        GeometryError: If an outline crosses itself.
    """
    points, faces, index = {}, {}, {}
    for side in PANELS:
        loops, index[side] = _resample_loops(pattern.panels[side], spacing)
        points[side], faces[side] = triangulate_panel(loops, spacing)
    faces["back"] = faces["back"][:, [0, 2, 1]]
    offset = len(points["front"])
    pairs = []
    for front, back in pattern.seam_pairs:
        ends = [
            index[side].get(label, np.empty(0, dtype=np.int64))
            for side, label in zip(PANELS, (front, back), strict=True)
        ]
        xy = [points[side][rows] for side, rows in zip(PANELS, ends, strict=True)]
        if len(ends[0]) != len(ends[1]) or (len(xy[0]) and np.abs(xy[0] - xy[1]).max() > 1e-6):
            raise GarmentError(
                f"seam ({front}, {back}): the two sides have different curves "
                f"({len(ends[0])} and {len(ends[1])} points)"
            )
        pairs.append(np.stack([ends[0], offset + ends[1]], axis=1))
    everything = np.concatenate([points[side] for side in PANELS])
    vertex, count = weld(len(everything), np.concatenate(pairs))
    vertex_of = {"front": vertex[:offset], "back": vertex[offset:]}
    vertex_xy = np.empty((count, 2))
    vertex_xy[vertex] = everything
    side_of = np.zeros(count, dtype=np.int64)
    for side, sign in zip(PANELS, (1, -1), strict=True):
        side_of[np.setdiff1d(vertex_of[side], vertex_of["back" if side == "front" else "front"])] = sign
    anchors = [
        vertex_of[s][index[s][label]] for s in PANELS for label in pattern.anchor_labels if label in index[s]
    ]
    return SewnPattern(
        panels={side: SewnPanel(points[side], faces[side], vertex_of[side]) for side in PANELS},
        anchors=np.unique(np.concatenate(anchors)) if anchors else np.empty(0, dtype=np.int64),
        vertex_xy=vertex_xy,
        vertex_side=side_of,
        twins=_twins(vertex_xy, side_of),
    )


def outline_samples(
    loops: tuple[Loop, ...], spacing: float
) -> tuple[Float[np.ndarray, "M 2"], Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Sample the outline densely.

    Returns:
        Points [m], the label of the edge that starts at or passes through each, and its loop.
    """
    points, labels, numbers = [], [], []
    for number, loop in enumerate(loops):
        for edge in loop:
            fine = resample(edge.points, spacing)[:-1]
            points.append(fine)
            labels.append(np.full(len(fine), edge.label))
            numbers.append(np.full(len(fine), number))
    return np.concatenate(points), np.concatenate(labels), np.concatenate(numbers)


def resample(curve: Curve, spacing: float) -> Curve:
    """Points along a polyline at equal arc length, about ``spacing`` apart, both ends kept."""
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    even = np.linspace(0, arc[-1], max(1, round(arc[-1] / spacing)) + 1)
    return np.stack([np.interp(even, arc, curve[:, k]) for k in (0, 1)], axis=1)


def bezier(start, control, end, n: int = 16) -> Curve:
    """Quadratic Bezier curve."""
    t = np.linspace(0, 1, n)[:, None]
    return (1 - t) ** 2 * np.asarray(start) + 2 * t * (1 - t) * np.asarray(control) + t**2 * np.asarray(end)


def smooth_curve(points, n: int = 24) -> Curve:
    """A smooth curve through points that does not overshoot them."""
    points = np.asarray(points, dtype=np.float64)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return PchipInterpolator(arc, points)(np.linspace(0, arc[-1], n))


def mirrored(curve: Curve) -> Curve:
    """The curve reflected in x and reversed: the other half of a symmetric outline."""
    return np.asarray(curve)[::-1] * np.array([-1.0, 1.0])


def _resample_loops(
    loops: tuple[Loop, ...], spacing: float
) -> tuple[list[Curve], dict[int, Int[np.ndarray, " _"]]]:
    """Loop points, and per label the panel point numbers of its edges, end points included."""
    result: list[Curve] = []
    index: dict[int, list[Int[np.ndarray, " _"]]] = {}
    start = 0
    for loop in loops:
        curves = [resample(edge.points, spacing) for edge in loop]
        for curve, following in zip(curves, curves[1:] + curves[:1], strict=True):
            if np.linalg.norm(curve[-1] - following[0]) > 1e-7:
                raise GarmentError(f"outline is not closed at {curve[-1].round(4).tolist()}")
        total = sum(len(c) - 1 for c in curves)
        first = 0
        for edge, curve in zip(loop, curves, strict=True):
            rows = start + (first + np.arange(len(curve))) % total
            index.setdefault(edge.label, []).append(rows)
            first += len(curve) - 1
        result.append(np.concatenate([c[:-1] for c in curves]))
        start += total
    return result, {label: np.concatenate(rows) for label, rows in index.items()}


def _twins(vertex_xy: Float[np.ndarray, "V 2"], side: Int[np.ndarray, " V"]) -> Int[np.ndarray, "n 2"]:
    front, back = np.flatnonzero(side > 0), np.flatnonzero(side < 0)
    if len(front) == 0 or len(back) == 0:
        return np.empty((0, 2), dtype=np.int64)
    distance, nearest = cKDTree(vertex_xy[back], balanced_tree=False).query(vertex_xy[front])
    return np.stack([front, back[nearest]], axis=1)[distance < 1e-4]
