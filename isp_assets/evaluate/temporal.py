"""How calmly cloth moves: jerk against the skin beneath, noise passed on, jumps from frame to frame.

Positions are in metres, world space; T consecutive frames.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from isp_assets.errors import GeometryError

_STILL = 1e-4  # a body that moves less than this in a frame [m] counts as moving this far
_QUIET = 1e-9  # jerks and noises below this count as none


def skin_beneath(garment: Float[np.ndarray, "V 3"], body: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " V"]:
    """The body vertex nearest to each garment vertex in one frame: what it is compared with in all frames."""
    # A balanced tree recurses for ever on exact zeros where torch flushes denormal numbers.
    return cKDTree(body, balanced_tree=False).query(garment)[1].astype(np.int64)


def jerk(positions: Float[np.ndarray, "T V 3"], fps: float | int) -> Float[np.ndarray, "T-3 V 3"]:
    """Third differences over time [m/s^3]; exact for cubics.

    Raises:
        GeometryError: If there are fewer than four frames.
    """
    if len(positions) < 4:
        raise GeometryError(f"jerk takes at least 4 consecutive frames, got {len(positions)}")
    return np.diff(positions.astype(np.float64), n=3, axis=0) * float(fps) ** 3


def jerk_ratio(
    garment: Float[np.ndarray, "T V 3"], skin: Float[np.ndarray, "T V 3"], fps: float | int
) -> float:
    """Root mean square jerk of a garment over that of the skin beneath each of its vertices.

    1 for cloth that moves as the skin does. A skin without jerk counts as the tiniest one.

    Raises:
        GeometryError: If there are fewer than four frames.
    """
    return float(_size(jerk(garment, fps)) / max(_size(jerk(skin, fps)), _QUIET))


def noise_gain(garment: Float[np.ndarray, "T V 3"], skin: Float[np.ndarray, "T V 3"]) -> float:
    """Scatter of a garment about its mean over that of the skin beneath, for one pose with noise."""
    scatter = [_size(points - points.mean(0)) for points in (garment.astype(float), skin.astype(float))]
    return float(scatter[0] / max(scatter[1], _QUIET))


def jump_ratios(
    garment: Float[np.ndarray, "T V 3"], body: Float[np.ndarray, "T N 3"]
) -> Float[np.ndarray, " T"]:
    """Longest way of a garment vertex over the longest way of a body vertex since the frame before.

    The first frame has 0. A body at rest counts as moving .1 mm.
    """
    ways = [np.linalg.norm(np.diff(p.astype(float), axis=0), axis=2).max(1) for p in (garment, body)]
    return np.concatenate([[0.0], ways[0] / np.maximum(ways[1], _STILL)])


def _size(vectors: Float[np.ndarray, "*batch 3"]) -> float:
    return float(np.sqrt((vectors**2).sum(-1).mean()))
