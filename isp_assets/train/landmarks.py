"""Landmarks of a body, read from its posed mesh alone: heights, half widths and girths.

Positions are in metres, Y up, the body facing +Z, its left side at +X; half widths
and arm or leg landmarks are those of the left side.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from isp_assets.errors import BodyError
from isp_assets.train.body_field import DepthMap, DistanceGrid, depth_map, distance_grid


@dataclass(frozen=True, eq=False)
class RestBody:
    """A body in its rest pose, with what patterns and draping measure on it."""

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]

    @cached_property
    def depth(self) -> DepthMap:
        """Depth seen from the front and the back."""
        return depth_map(self.vertices, self.faces)

    @cached_property
    def distance(self) -> DistanceGrid:
        """Signed distance."""
        return distance_grid(self.vertices, self.faces)

    @cached_property
    def landmarks(self) -> "Landmarks":
        """Heights, widths and girths."""
        return _measure(self)

    def section(
        self, origin: Float[np.ndarray, " 3"], normal: Float[np.ndarray, " 3"]
    ) -> tuple[Float[np.ndarray, "S 2 3"], Int[np.ndarray, " S"]]:
        """Cut by a plane.

        Returns:
            Segments [m] and the connected loop each belongs to; loop 0 has its mean nearest to ``origin``.
        """
        height = (self.vertices - origin) @ normal
        above = height > 0
        start, end = self.faces, np.roll(self.faces, -1, axis=1)
        cut = above[start] != above[end]
        rows = np.flatnonzero(cut.any(axis=1))
        if rows.size == 0:
            raise BodyError(f"plane through {np.round(origin, 3).tolist()} does not cut the body")
        pair = np.stack([start[rows][cut[rows]].reshape(-1, 2), end[rows][cut[rows]].reshape(-1, 2)], axis=-1)
        pair = np.sort(pair, axis=-1)  # [S, 2 ends, 2 vertices]: one rounding for both faces of an edge
        a, b = pair[..., 0], pair[..., 1]
        share = (height[a] / (height[a] - height[b]))[..., None]
        segments = self.vertices[a] + share * (self.vertices[b] - self.vertices[a])
        _, node = np.unique(pair.reshape(-1, 2), axis=0, return_inverse=True)
        node = node.reshape(-1, 2)
        n = node.max() + 1
        _, component = connected_components(
            coo_array((np.ones(len(node)), node.T), shape=(n, n)), directed=False
        )
        loop = component[node[:, 0]]
        means = np.array([segments[loop == k].mean(axis=(0, 1)) for k in range(loop.max() + 1)])
        rank = np.argsort(np.argsort(np.linalg.norm(means - origin, axis=1)))
        return segments, rank[loop]

    def girth(self, origin: Float[np.ndarray, " 3"], normal: Float[np.ndarray, " 3"]) -> float:
        """Length [m] of a tape about the loop of the section nearest to ``origin``."""
        segments, loop = self.section(origin, normal)
        normal = normal / np.linalg.norm(normal)
        across = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        points = segments[loop == 0].reshape(-1, 3)
        plane = np.stack([points @ across, points @ np.cross(normal, across)], axis=1)
        return float(ConvexHull(plane).area)

    def level_girth(self, y: float) -> float:
        """Length [m] of a level tape about the trunk at height ``y``."""
        return self.girth(np.array([0.0, y, 0.0]), np.array([0.0, 1.0, 0.0]))

    def shoulder_line(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Upper silhouette of shoulder and arm at ``x`` [m], the head left out."""
        limit = self.landmarks.arm_y + 0.22
        tops = []
        for value in np.asarray(x, dtype=float):
            upper = [high for _, high in self.depth.runs_in_column(value) if high < limit]
            tops.append(max(upper) if upper else self.landmarks.arm_y + 0.10)
        return np.array(tops)


@dataclass(frozen=True)
class Landmarks:
    """Heights (``_y``), half widths (``_x``) and girths, all in metres."""

    top_y: float
    bottom_y: float
    arm_y: float
    armpit_x: float
    armpit_y: float
    crotch_y: float
    waist_x: float
    waist_y: float
    hip_x: float
    hip_y: float
    neck_x: float
    neck_y: float
    waist_girth: float
    hip_girth: float
    chest_girth: float
    arm_x: tuple[float, ...]
    """Upper arm, elbow, wrist."""
    arm_girth: tuple[float, ...]
    leg_xy: tuple[tuple[float, float], ...]
    """Middle of the left leg at thigh, knee, ankle."""
    leg_axis: tuple[float, float]
    """Unit direction of the left leg, downwards."""
    leg_girth: tuple[float, ...]
    crotch_arc: float
    """From the front of the waist through the legs to its back."""


def _measure(body: RestBody) -> Landmarks:
    """Read all landmarks; the thresholds hold for standing adults with the arms level."""
    depth, vertices = body.depth, body.vertices
    widest, top, bottom = vertices[:, 0].max(), vertices[:, 1].max(), vertices[:, 1].min()
    arm_y = depth.runs_in_column(0.62 * widest)[-1].mean()
    if not bottom + 0.5 * (top - bottom) < arm_y < top:
        raise BodyError("patterns need a standing body with its arms level; got another pose")

    ys = np.arange(arm_y, arm_y - 0.35, -depth.cell)
    trunk = np.array([_trunk_half_width(depth, y) for y in ys])
    armpit = np.flatnonzero(trunk < 1.45 * np.median(trunk[-12:]))[0]
    middle = depth.runs_in_column(0.0)
    crotch_y = next(low for low, high in middle if high > bottom + 0.4 * (top - bottom))

    heights = np.arange(crotch_y + 0.05, ys[armpit] - 0.05, depth.cell)
    widths = np.array([_trunk_half_width(depth, y) for y in heights])
    high = heights > crotch_y + 0.14
    waist_y, waist_x = heights[high][widths[high].argmin()], widths[high].min()
    low = heights < waist_y
    hip_y, hip_x = heights[low][widths[low].argmax()], widths[low].max()
    neck_ys = np.arange(arm_y + 0.06, top - 0.12, depth.cell)
    neck = np.array([depth.runs_in_row(y)[-1, 1] for y in neck_ys])

    arm_x = tuple(float(f * widest) for f in (0.32, 0.55, 0.80))
    arm_girth = tuple(
        body.girth(np.array([x, depth.runs_in_column(x)[-1].mean(), 0.0]), np.array([1.0, 0.0, 0.0]))
        for x in arm_x
    )
    leg_xy = tuple(_leg_middle(depth, bottom + f * (crotch_y - bottom)) for f in (0.93, 0.52, 0.12))
    axis = np.subtract(leg_xy[2], leg_xy[0])
    axis /= np.linalg.norm(axis)
    leg_girth = tuple(body.girth(np.array([*xy, 0.0]), np.array([*axis, 0.0])) for xy in leg_xy)
    floats = {
        "top_y": top, "bottom_y": bottom, "arm_y": arm_y, "armpit_x": trunk[armpit], "armpit_y": ys[armpit],
        "crotch_y": crotch_y, "waist_x": waist_x, "waist_y": waist_y, "hip_x": hip_x, "hip_y": hip_y,
        "neck_x": neck.min(), "neck_y": neck_ys[neck.argmin()], "waist_girth": body.level_girth(waist_y),
        "hip_girth": body.level_girth(hip_y), "chest_girth": body.level_girth(ys[armpit] - 0.04),
        "crotch_arc": _crotch_arc(body, waist_y),
    }  # fmt: skip
    return Landmarks(
        **{name: float(value) for name, value in floats.items()},
        arm_x=arm_x, arm_girth=arm_girth, leg_xy=leg_xy, leg_axis=tuple(axis.tolist()), leg_girth=leg_girth,
    )  # fmt: skip


def _trunk_half_width(depth: DepthMap, y: float) -> float:
    """Right end of the run that contains x = 0; infinite between the legs."""
    return max((high for low, high in depth.runs_in_row(y) if low <= 0.02 and high >= -0.02), default=np.inf)


def _leg_middle(depth: DepthMap, y: float) -> tuple[float, float]:
    low, high = next(run for run in depth.runs_in_row(y)[::-1] if run[1] > 0)
    return float(0.5 * (max(low, 0.0) + high)), float(y)


def _crotch_arc(body: RestBody, waist_y: float) -> float:
    segments, loop = body.section(np.array([0.004, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    longest = np.bincount(loop, lengths).argmax()
    return float(lengths[(loop == longest) & (segments[..., 1] < waist_y).all(axis=1)].sum())
