"""On which side of a mesh points lie, told from the whole mesh instead of its nearest triangle.

Positions are in metres, in one shared space. NumPy, one frame at a time.

References: Jacobson, Kavan and Sorkine-Hornung, "Robust Inside-Outside Segmentation using
Generalized Winding Numbers", SIGGRAPH 2013; Barill et al., "Fast Winding Numbers for Soups
and Clouds", SIGGRAPH 2018.
"""

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

_INSIDE = 0.5
_BENEATH = 0.3  # beneath a garment it is .6 to 2, outside -.3 to .2 (-1 in a fold's loop), seldom in between


class Winding:
    """The winding number of a mesh in one frame; the tree is built once."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self._tree = igl.FastWindingNumberBVH()
        self._tree.init(np.ascontiguousarray(vertices, np.float64), faces)

    def __call__(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
        """How many times the surface goes around each point."""
        if len(points) == 0:
            return np.zeros(0)
        return np.asarray(self._tree.winding_number(np.ascontiguousarray(points, np.float64))).reshape(-1)

    def inside(self, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
        """Whether points lie inside a closed surface."""
        return self(points) > _INSIDE

    def beneath(self, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
        """Whether points near a garment lie between it and the body, whatever its folds look like."""
        return self(points) > _BENEATH
