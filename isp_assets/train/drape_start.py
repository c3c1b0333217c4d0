"""Where draping begins: both sheets round the body without touching it, and the waist at its place.

Positions are in metres, Y up, the body facing +Z.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import ConvexHull

from isp_assets.train.body_field import DepthMap
from isp_assets.train.landmarks import RestBody
from isp_assets.train.pattern import SewnPattern


def wrapped_start(pattern: SewnPattern, body: RestBody, *, margin: float = 0.012, slope: float = 1.2):
    """Lift both sheets off the body along z; away from it they meet in the middle of its depth."""
    depth = body.depth
    middle, up, down = _wrap_fields(depth, margin, slope)
    row_column = ((pattern.vertex_xy - depth.origin) / depth.cell).T[::-1]

    def at(field: Float[np.ndarray, "Y X"]) -> Float[np.ndarray, " V"]:
        return ndimage.map_coordinates(field, row_column, order=1, mode="nearest")

    side = pattern.vertex_side
    z = at(middle) + np.where(side > 0, at(up), 0) - np.where(side < 0, at(down), 0)
    return np.concatenate([pattern.vertex_xy, z[:, None]], axis=1)


@lru_cache(maxsize=4)
def _wrap_fields(depth: DepthMap, margin: float, slope: float, reach: float = 0.12):
    """Middle depth, and height of the front and back sheets off it: the body's, widened by a cone."""
    mask = depth.mask
    rows, columns = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    front, back = depth.front[rows, columns], depth.back[rows, columns]
    middle = ndimage.gaussian_filter(0.5 * (front + back), 6)
    step, diagonal = slope * depth.cell, slope * depth.cell * np.sqrt(2)
    cone = -np.array([[diagonal, step, diagonal], [step, 0, step], [diagonal, step, diagonal]])

    def widen(height: Float[np.ndarray, "Y X"]) -> Float[np.ndarray, "Y X"]:
        for _ in range(int(reach / depth.cell)):
            height = ndimage.grey_dilation(height, structure=cone)
        return np.maximum(height, 0)

    up = widen(np.where(mask, front - middle + margin, 0))
    down = widen(np.where(mask, middle - back + margin, 0))
    return middle, up, down


def waist_targets(pattern: SewnPattern, body: RestBody, *, gap: float = 0.004) -> Float[np.ndarray, "A 3"]:
    """Positions of the waist: by arc length round the body's section, offset to the pattern's length."""
    if len(pattern.anchors) == 0:
        return np.empty((0, 3))
    xy, side = pattern.vertex_xy[pattern.anchors], pattern.vertex_side[pattern.anchors]
    segments, loop = body.section(np.array([0.0, xy[0, 1], 0.0]), np.array([0.0, 1.0, 0.0]))
    points = segments[loop == 0].reshape(-1, 3)[:, [0, 2]]
    hull = ConvexHull(points)
    ring = points[hull.vertices]  # counter-clockwise in (x, z): from the front centre towards -x
    width = np.abs(xy[:, 0]).max()
    offset = max(gap, (4 * width - hull.area) / (2 * np.pi))
    tangent = np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    ring = ring + offset * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    ring = np.concatenate([ring, ring[:1]])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    dense = np.linspace(0, arc[-1], 2001)
    curve = np.stack([np.interp(dense, arc, ring[:, k]) for k in (0, 1)], axis=1)
    # The front centre must be found exactly: a ring turned by a centimetre skews the whole garment.
    in_front = curve[:, 1] > points[:, 1].mean()
    front_centre = dense[np.where(in_front, np.abs(curve[:, 0]), np.inf).argmin()]
    quarter = 0.25 * arc[-1] * xy[:, 0] / width
    position = (front_centre + np.where(side < 0, 0.5 * arc[-1] + quarter, -quarter)) % arc[-1]
    x, z = (np.interp(position, dense, curve[:, k]) for k in (0, 1))
    return np.stack([x, xy[:, 1], z], axis=1)
