"""Planes that points of a garment stay above while its energy is lowered.

Contact is looked up now and then, and is a penalty over planes in between. Points are the
garment's vertices, the middles of its triangles, and the places of its triangles that
vertices beneath come near: where only vertices are kept off, layers and bent limbs poke through.

Positions are in metres, in one shared space. NumPy, one frame at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from isp_assets.geometry.closest import Closest, ClosestQuery
from isp_assets.geometry.obstacle import Obstacle

DEEP = 0.06
"""What lies deeper than this [m] does not know its way out."""
_BENEATH = 0.015  # the same for a layer: an open sheet has no inside that cloth could be pushed out of
_ABOVE = 0.001  # asked for on top of the margin [m]: a penalty gives way a little
_CHORD = 0.5  # share of the clearance asked for between vertices, as their chords cut bent surfaces
_NEAR = 0.02  # cloth further than this above its clearance [m] meets nothing in a few steps
_DEPTH = 0.025  # lacking clearance beyond which the penalty grows linearly [m]
_POKE = 0.015  # a vertex that pokes through a triangle further than this [m] does not count
_FACING = 0.25  # cosine from which a triangle and what pokes through it face the same way


def nearest(
    position: Float[np.ndarray, "V 3"],
    corner: Int[np.ndarray, "n 3"],
    surface: Obstacle,
    parts: Bool[np.ndarray, "V 6"],
) -> Closest:
    """The nearest places of a surface, if not too far away.

    Args:
        position: The garment [m].
        corner: The triangles whose middles are looked up; a vertex is given three times.
        surface: What lies beneath.
        parts: Body parts whose surface each vertex lies over; a middle, those of all its corners.
    """
    return surface.contacts(position[corner].mean(axis=1), parts[corner].all(axis=1), within=DEEP)


@dataclass(frozen=True, eq=False)
class Planes:
    """Planes, each for a point of the cloth, given by the corners of its triangle."""

    corner: Int[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 3"]
    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    level: Float[np.ndarray, " n"]
    """Height that the point keeps over the plane [m]."""

    @classmethod
    def above(
        cls,
        position: Float[np.ndarray, "V 3"],
        corner: Int[np.ndarray, "n 3"],
        surface: Obstacle,
        found: Closest,
    ) -> "Planes":
        """Planes through the nearest places of a surface.

        Args:
            position: The garment [m].
            corner: The triangles whose middles are to stay above; a vertex is given three times.
            surface: What lies beneath.
            found: Their `nearest` places on it.
        """
        place = position[corner].mean(axis=1)
        share = np.where(corner[:, 0] == corner[:, 1], 1.0, _CHORD)
        level = share * (surface.margin_at(found) + _ABOVE)
        deep = _BENEATH if surface.mesh.topology.is_open else DEEP
        meets = (found.height < level + _NEAR) & (found.height > -deep) & ~found.on_border
        near = np.flatnonzero(meets)
        # Above its level, a point is kept off by the way to it; beneath, by the surface's own normal.
        way = (place - found.point)[near] / np.maximum(np.abs(found.height[near]), 1e-9)[:, None]
        normal = np.where((found.height > level)[near, None], way, found.normal[near])
        weights = np.full((len(near), 3), 1 / 3)
        return cls(corner[near], weights, found.point[near], normal, level[near])

    @classmethod
    def over_vertices(
        cls,
        garment: ClosestQuery,
        surface: Obstacle,
        parts: Bool[np.ndarray, "V 6"],
        *,
        concerned: Bool[np.ndarray, " V"],
    ) -> "Planes":
        """Planes through vertices beneath, for the places of triangles that they come near."""
        distance, _ = cKDTree(garment.vertices, balanced_tree=False).query(
            surface.vertices, distance_upper_bound=_NEAR
        )
        index = np.flatnonzero(distance < _NEAR)
        found = garment(surface.vertices[index])
        corner, normal = garment.topology.faces[found.face], surface.normals.of_vertices[index]
        facing = np.einsum("nc,nc->n", normal, found.normal) > _FACING
        near = facing & (found.height > -_NEAR) & (found.height < _POKE) & ~found.on_border
        near &= (parts[corner].any(axis=1) & surface.mesh.parts[index]).any(axis=1)
        near &= concerned[corner].all(axis=1)
        level = _CHORD * (surface.margins[index] + _ABOVE)
        return cls(
            corner[near], found.weights[near], surface.vertices[index[near]], normal[near], level[near]
        )

    @classmethod
    def near_hidden(
        cls,
        position: Float[np.ndarray, "V 3"],
        corner: Int[np.ndarray, "n 3"],
        skin: Obstacle,
        found: Closest,
        highest: Float[np.ndarray, " V"],
    ) -> "Planes":
        """Planes that cloth over hidden skin stays beneath: unseen, it must not come out elsewhere.

        Args:
            position: The garment [m].
            corner: Its vertices, each three times.
            skin: The body.
            found: Their `nearest` places on it.
            highest: How high over hidden skin each vertex may come [m].
        """
        index = corner[:, 0]
        hidden = skin.blocked[skin.mesh.topology.faces[found.face]].any(axis=1)
        cap = highest[index]
        high = np.flatnonzero(hidden & np.isfinite(found.height) & (found.height > (cap - _NEAR).clip(0)))
        away = (position[index] - found.point)[high] / np.maximum(found.height[high], 1e-9)[:, None]
        weights = np.full((len(high), 3), 1 / 3)
        return cls(corner[high], weights, found.point[high], -away, -cap[high])

    @classmethod
    def joined(cls, planes: Sequence["Planes"]) -> "Planes":
        """All planes of several."""
        names = ("corner", "weights", "point", "normal", "level")
        return cls(*(np.concatenate([getattr(each, name) for each in planes]) for name in names))

    def penalty(self, num_vertices: int, stiffness: Float[np.ndarray, " V"]) -> "Penalty":
        """What it costs to lie beneath.

        Args:
            num_vertices: Vertices of the garment.
            stiffness: Of contact at each of them [N/m].
        """
        row = np.repeat(np.arange(len(self.corner)), 3)
        entries = self.weights.ravel(), (row, self.corner.ravel())
        points = csr_array(entries, shape=(len(self.corner), num_vertices))
        return Penalty(self, points, points @ stiffness)


@dataclass(frozen=True, eq=False)
class Penalty:
    """Energy of points that lie lower than their planes ask: quadratic in what lacks, then linear."""

    planes: Planes
    points: csr_array
    """[n, V]: positions of the garment to the points."""
    stiffness: Float[np.ndarray, " n"]

    @cached_property
    def _offset(self) -> Float[np.ndarray, " n"]:
        return self.planes.level + np.einsum("nc,nc->n", self.planes.point, self.planes.normal)

    def energy(self, position: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """Energy [J] of positions, and its gradient [N]."""
        normal = self.planes.normal
        lacking = (self._offset - np.einsum("nc,nc->n", self.points @ position, normal)).clip(0)
        near = lacking.clip(max=_DEPTH)
        energy = float((self.stiffness * near * (lacking - 0.5 * near)).sum())
        return energy, self.points.T @ (-(self.stiffness * near)[:, None] * normal)
