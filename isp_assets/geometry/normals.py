"""Unit normals of triangle meshes.

Pure, batched over leading axes, differentiable in the positions. Degenerate faces
and vertices without faces get the zero vector, never NaN.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

_SMALLEST = 1e-18  # doubled area [m²]; far below any real face, far above where float32 underflows


def face_normals(
    vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "*batch F 3"]:
    """Unit normals of faces; the corners run counter-clockwise seen from the tip of the normal."""
    return normalize(_doubled_area(vertices, faces), dim=-1, eps=_SMALLEST)


def vertex_normals(
    vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "*batch V 3"]:
    """Unit normals of vertices: the area-weighted mean over the faces around each."""
    weighted = _doubled_area(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        total = total.index_add(-2, corner, weighted)
    return normalize(total, dim=-1, eps=_SMALLEST)


def _doubled_area(vertices: Tensor, faces: Tensor) -> Tensor:
    """Normals whose length is twice the area of the face."""
    first, second, third = (vertices.index_select(-2, corner) for corner in faces.unbind(1))
    return torch.linalg.cross(second - first, third - first, dim=-1)
