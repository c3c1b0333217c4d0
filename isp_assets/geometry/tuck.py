"""Tuck a garment under the garments worn over it.

The layering network and the projection move outer garments only. Where an inner
garment hangs far outside an outer one (the wide hem of a shirt worn inside trousers),
that would blow the outer one up. There the inner one gives way: it is drawn in until
it stands out by no more than ``give``, and its neighbourhood follows smoothly.

Positions are in metres, in one shared space. NumPy, one frame and one garment at a time.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import SurfaceNormals
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.spread import keep_larger, spread

GIVE = 0.006
"""How far an inner garment may stand out of an outer one before it gives way [m]."""

_REACH = 0.12  # garments further apart than this [m] have nothing to do with one another
_RINGS, _DECAY = (
    24,
    0.98,
)  # rings of neighbours that follow, and how much of it: a soft fall over ten centimetres
_SAME_SIDE = 0.25  # cosine from which two pieces of cloth count as facing the same way


def tuck(
    vertices: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    covers: Sequence[Obstacle],
    *,
    give: float = GIVE,
) -> Float[np.ndarray, "V 3"]:
    """Draw a garment in under its covers.

    Args:
        vertices: The inner garment in this frame [m].
        mesh: Its collision data.
        covers: The garments worn over it, as they are draped before any correction.
        give: How far it may stand out of a cover [m]; the cover is lifted by that much later.

    Returns:
        New positions [m]; the same array where nothing stands out.

    Raises:
        GeometryError: If ``give`` is negative.
    """
    if give < 0:
        raise GeometryError(f"give must be >= 0 m, got {give:g}")
    pull = np.zeros(vertices.shape)
    if not covers:
        return vertices
    normals = SurfaceNormals(vertices, mesh.topology.faces).of_vertices
    for cover in covers:
        found = cover.contacts(np.ascontiguousarray(vertices, np.float64), mesh.parts, within=_REACH)
        stands_out = (found.height > give) & (found.height < _REACH) & ~found.on_border
        stands_out &= np.einsum("vc,vc->v", normals, found.normal) > _SAME_SIDE
        share = (1 - give / np.maximum(found.height, 1e-9))[:, None]
        keep_larger(pull, np.where(stands_out[:, None], share * (found.point - vertices), 0.0))
    if not pull.any():
        return vertices
    return vertices + spread(pull, mesh.neighbour_average, rings=_RINGS, decay=_DECAY)
