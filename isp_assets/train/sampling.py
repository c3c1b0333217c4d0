"""Points with the exact signed distance and label of a panel, to train its field on.

All coordinates are network units.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.errors import DatasetError


@dataclass(frozen=True, eq=False)
class Outline:
    """The border of a panel: closed polylines, a label on every segment."""

    points: Float[np.ndarray, "M 2"]
    """Vertices of all loops, loop after loop."""
    following: Int[np.ndarray, " M"]
    """The next vertex of the same loop; the last one leads back to the first."""
    label: Int[np.ndarray, " M"]
    """Edge label of the segment from each vertex to the following one."""

    @classmethod
    def from_loops(
        cls, points: Float[np.ndarray, "M 2"], loop: Int[np.ndarray, " M"], label: Int[np.ndarray, " M"]
    ) -> "Outline":
        """Close loops given vertex by vertex; ``loop`` numbers each vertex's loop.

        Raises:
            DatasetError: If the vertices of a loop are not consecutive, or a loop has fewer than three.
        """
        starts = np.flatnonzero(np.diff(loop, prepend=-1))
        if len(np.unique(loop)) != len(starts):
            raise DatasetError("outline: the vertices of a loop must be consecutive")
        if np.diff(starts, append=len(loop)).min() < 3:
            raise DatasetError("outline: every loop needs at least three vertices")
        following = np.arange(1, len(loop) + 1)
        following[np.append(starts[1:], len(loop)) - 1] = starts
        return cls(np.asarray(points, float), following, np.asarray(label, int))

    @property
    def corners(self) -> Float[np.ndarray, "C 2"]:
        """Vertices at which the label changes."""
        changes = self.label != self.label[self.following]
        return self.points[self.following[changes]]

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 2"]:
        """Points on the border, uniform in arc length."""
        step = self.points[self.following] - self.points
        length = np.linalg.norm(step, axis=1)
        segment = rng.choice(len(length), count, p=length / length.sum())
        return self.points[segment] + rng.random((count, 1)) * step[segment]

    def distance(self, xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Exact signed distance to the border, negative inside, and the label of the nearest segment."""
        solid = np.pad(self.points, ((0, 0), (0, 1)))
        segments = np.stack([np.arange(len(self.points)), self.following], axis=1)
        squared, nearest, _ = igl.point_mesh_squared_distance(np.pad(xy, ((0, 0), (0, 1))), solid, segments)
        length = np.sqrt(squared)
        return np.where(self.inside(xy), -length, length), self.label[nearest]

    def inside(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether a ray to the right crosses the border an odd number of times."""
        order = np.argsort(xy[:, 1], kind="stable")
        x, y = xy[order].T
        start, end = self.points, self.points[self.following]
        low, high = np.searchsorted(y, np.sort([start[:, 1], end[:, 1]], axis=0))
        odd = np.zeros(len(xy), bool)
        # Sorted by height, the points that a short segment can matter to are one small slice.
        for a, b, i, j in zip(start, end, low, high, strict=True):
            if i < j:
                odd[i:j] ^= x[i:j] < a[0] + (y[i:j] - a[1]) * ((b[0] - a[0]) / (b[1] - a[1]))
        result = np.empty_like(odd)
        result[order] = odd
        return result


@dataclass(frozen=True)
class SamplingOptions:
    """How many points of a panel are drawn where; the rest is uniform in [-1, 1]^2."""

    points: int = 16000
    border: float = 0.15
    """Share exactly on the border."""
    bands: tuple[tuple[float, float], ...] = ((0.15, 0.005), (0.2, 0.03), (0.2, 0.1))
    """Share and radius of the points around the border. Too many in the innermost band teach a flat field."""
    corner: float = 0.1
    """Share within ``corner_radius`` of a corner, where labels meet."""
    corner_radius: float = 0.03


@dataclass(frozen=True, eq=False)
class PanelSamples:
    """Points of one panel and what its field must say there."""

    xy: Float[np.ndarray, "n 2"]
    distance: Float[np.ndarray, " n"]
    label: Int[np.ndarray, " n"]


def sample_panel(outline: Outline, options: SamplingOptions, rng: np.random.Generator) -> PanelSamples:
    """Draw training points of one panel, in random order."""

    def around(centres: Float[np.ndarray, "n 2"], radius: float) -> Float[np.ndarray, "n 2"]:
        return centres + rng.uniform(-radius, radius, centres.shape)

    corners = outline.corners if len(outline.corners) else outline.points
    chosen = corners[rng.integers(0, len(corners), int(options.corner * options.points))]
    parts = [outline.draw(int(options.border * options.points), rng), around(chosen, options.corner_radius)]
    for share, radius in options.bands:
        parts.append(around(outline.draw(int(share * options.points), rng), radius))
    parts.append(rng.uniform(-1, 1, (options.points - sum(map(len, parts)), 2)))
    xy = rng.permutation(np.concatenate(parts).clip(-1, 1))
    distance, label = outline.distance(xy)
    return PanelSamples(xy, distance, label)
