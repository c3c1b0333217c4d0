"""Ray casting against one set of triangles, by Intel Embree through the package ``embreex``."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.errors import MissingExtraError

_LIFT = 5e-4
"""Rays leave a surface this far along their direction [m]: above float32 noise, below the gap of layers."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What some rays met first."""

    ray: Int[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]
    weights: Float[np.ndarray, "n 3"]
    """Barycentric coordinates in the face."""
    face_normal: Float[np.ndarray, "n 3"]
    """By the winding of the face; not of unit length."""
    missed: Int[np.ndarray, " m"]
    """Rays that met nothing."""

    def facing(self, rays: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """True where the ray met the outer side of its face."""
        return (self.face_normal * rays).sum(1) < 0


class Tracer:
    """Triangles, ready for ray queries.

    Raises:
        MissingExtraError: If ``embreex`` is not installed.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise MissingExtraError("embreex", "sheet", "the contact sheet") from error
        self._origin = vertices.mean(0).astype(np.float32)  # float32 is finest near zero
        self._vertices = vertices.astype(np.float32) - self._origin
        self._faces = faces
        self._scene = EmbreeScene()
        TriangleMesh(scene=self._scene, vertices=self._vertices, indices=faces.astype(np.int32))

    def first_hit(self, eye: Float[np.ndarray, " 3"], rays: Float[np.ndarray, "n 3"]) -> Hits:
        """The nearest face along each ray from ``eye`` [m]."""
        origins = np.broadcast_to((eye - self._origin).astype(np.float32), rays.shape).copy()
        found = self._scene.run(origins, rays.astype(np.float32), output=1)
        face = found["primID"]
        ray = np.flatnonzero(face >= 0)
        u, v, face = found["u"][ray], found["v"][ray], face[ray]
        a, b, c = np.moveaxis(self._vertices[self._faces[face]], 1, 0)
        missed = np.flatnonzero(found["primID"] < 0)
        return Hits(ray, face, np.stack([1 - u - v, u, v], 1), np.cross(b - a, c - a), missed)

    def blocked(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """True where something lies beyond ``points`` [m] along ``directions`` (unit)."""
        if len(points) == 0:
            return np.zeros(0, bool)
        directions = np.ascontiguousarray(directions, np.float32)
        origins = (points - self._origin).astype(np.float32) + _LIFT * directions
        return self._scene.run(origins, directions, query="OCCLUDED") >= 0
