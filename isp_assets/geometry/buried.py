"""Skin that lies inside another limb, and the cloth that belongs on it.

Captured motion drives arms into the torso, by centimetres. The nearest way out of the body
leads a sleeve through its own arm there, and a shirt's side around the arm. Nobody sees
that cloth: it stays with its skin, and what is seen of it meets at the crease.

Positions are in metres, in one shared space. NumPy, one frame at a time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.closest import ClosestQuery
from isp_assets.geometry.obstacle import ARMS, BODY_PARTS, CollisionMesh, Obstacle, mean_edge
from isp_assets.geometry.spread import fade_out

_ABOVE = 0.001  # skin is inside the body if the point this far [m] above it is; less depth hides nothing
_FROM, _FULL = 0.02, 0.035  # depth of skin [m] from which on its cloth is drawn to it, and lies on it
_FADE = 0.1  # distance [m] within which neighbouring cloth follows


class BodyObstacle(Obstacle):
    """A closed body in one frame, which knows the skin that its own parts hide."""

    @cached_property
    def depth_in(self) -> Float[np.ndarray, "V 6"]:
        """How deep each vertex lies inside every part that is not its own [m]."""
        faces, main = self.mesh.topology.faces, self.mesh.main_part
        depth = np.zeros((len(self.vertices), len(BODY_PARTS)))
        for part, surface in enumerate(self.mesh.main_surfaces):
            corner = self.vertices[faces[surface.faces]].reshape(-1, 3)
            if len(corner) == 0:
                continue
            inside = ((self.vertices >= corner.min(0)) & (self.vertices <= corner.max(0))).all(1)
            index = np.flatnonzero(inside & (main != part))
            query = ClosestQuery(self.vertices, self.mesh.topology, part=surface, normals=self.normals)
            found = query(self.vertices[index])
            # Beyond the cut, where the part was joined to the others, there is no side.
            depth[index, part] = np.where(found.on_cut, 0, (-found.height).clip(0))
        if depth.any():
            probe = self.vertices + _ABOVE * self.normals.of_vertices
            depth[~self.winding.inside(probe)] = 0
        return depth

    @cached_property
    def blocked(self) -> Bool[np.ndarray, " V"]:
        """Hidden skin: probing above it finds room, as far as it is from the skin that hides it."""
        return self.depth_in.max(axis=1) > _ABOVE

    @cached_property
    def depth_at_arms(self) -> Float[np.ndarray, " V"]:
        """How deep skin of the arms lies inside another part, and other skin inside an arm [m].

        Thighs against the belly do not count: cloth spans that crease, and fares better in it.
        """
        of_arm = np.isin(self.mesh.main_part, ARMS)
        return np.where(of_arm, self.depth_in.max(axis=1), self.depth_in[:, list(ARMS)].max(axis=1))


@dataclass(frozen=True, eq=False)
class HomeSkin:
    """The place on the body that each vertex of a garment lies over at rest."""

    corner: Int[np.ndarray, "V 3"]
    """Vertices of the body."""
    weights: Float[np.ndarray, "V 3"]
    part: Int[np.ndarray, " V"]

    @classmethod
    def find(
        cls, points: Float[np.ndarray, "V 3"], body: Float[np.ndarray, "B 3"], mesh: CollisionMesh
    ) -> "HomeSkin":
        """Closest points at rest.

        Args:
            points: The garment, in canonical space [m].
            body: The body there [m].
            mesh: The body's collision data.
        """
        found = ClosestQuery(body, mesh.topology)(points)
        corner = mesh.topology.faces[found.face]
        nearest = np.take_along_axis(corner, found.weights.argmax(1)[:, None], axis=1)[:, 0]
        return cls(corner, found.weights, mesh.main_part[nearest])

    def at(self, values: Float[np.ndarray, "B *C"]) -> Float[np.ndarray, "V *C"]:
        """Values of the body's vertices there."""
        return np.einsum("vk,vk...->v...", self.weights, values[self.corner])


@dataclass(frozen=True, eq=False)
class LaidCloth:
    """A garment in one frame, with the cloth of buried skin laid on it."""

    vertices: Float[np.ndarray, "V 3"]
    parts: Bool[np.ndarray, "V 6"]
    """Body parts that each vertex belongs to in this frame: one alone where it was laid on its skin."""


def lay_on_skin(
    position: Float[np.ndarray, "V 3"],
    skinned: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    home: HomeSkin,
    body: BodyObstacle,
    *,
    gap: float,
) -> LaidCloth:
    """Lay cloth whose skin an arm hides on that skin; what is around it follows.

    Args:
        position: The garment [m].
        skinned: The same before it was displaced: on the right side of its own limb [m].
        mesh: The garment's collision data.
        home: Where its vertices belong.
        body: The body in this frame.
        gap: How far off its skin cloth may stay [m].
    """
    depth = home.at(body.depth_at_arms)
    share = ((depth - _FROM) / (_FULL - _FROM)).clip(0, 1)
    if not share.any():
        return LaidCloth(position, mesh.parts)
    edge = mean_edge(position, mesh.topology.faces)
    share = fade_out(share * share * (3 - 2 * share), mesh.topology.faces, reach=_FADE, edge=edge)
    skin = home.at(body.vertices)
    away = skinned - skin
    length = np.sqrt(np.einsum("vc,vc->v", away, away))
    target = skin + away * np.minimum(1, gap / np.maximum(length, 1e-9))[:, None]
    alone = np.arange(len(BODY_PARTS)) == home.part[:, None]
    return LaidCloth(
        position + share[:, None] * (target - position), np.where((share > 0)[:, None], alone, mesh.parts)
    )
