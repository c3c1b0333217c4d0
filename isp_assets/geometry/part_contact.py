"""Contact of a garment with the skin beneath it, and with other parts of the body that come near.

The nearest skin to a sleeve may be the torso's, and a push away from the nearest skin
may lead a shirt through the arm that lies on it. So heights are taken over the skin of a
vertex's own body parts, and another part is a ceiling: it bounds how far from its own
skin the cloth may be.

Positions are in metres, in one shared space; batched over poses; differentiable in the
garment. Which sample is nearest, and where the ceiling is, is decided without gradients.
On the CPU the look-up uses a tree per pose and part, on other devices distances.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from isp_assets.errors import GeometryError
from isp_assets.geometry.contact import Gap
from isp_assets.geometry.normals import vertex_normals
from isp_assets.geometry.obstacle import CollisionMesh

FLAT = 0.002
"""Height over its own skin [m] to which another part presses cloth at most."""

_HALVINGS = 5
_OTHER_MARGIN = 0.002  # clearance [m] to another part; small, because cloth is clear of its own skin as well
_ASIDE = 0.06  # own skin is sought first where the part's bounds are this near [m]


@dataclass(frozen=True, eq=False)
class PartSamples:
    """Which skin vertices are samples of which body part; the same in every pose."""

    parts: Bool[Tensor, "P K"]
    rim: Bool[Tensor, "P K"]
    """Samples next to skin that is not of the part: there the other parts are the same skin."""

    @classmethod
    def of_mesh(cls, mesh: CollisionMesh) -> "PartSamples":
        """Sort the vertices of a body."""
        faces, parts = mesh.topology.faces, mesh.parts
        rim = parts & (parts.sum(1, keepdims=True) > 1)
        shared = parts[faces].all(1)
        for corner in faces.T:
            np.logical_or.at(rim, corner, ~shared & parts[corner])
        return cls(torch.from_numpy(parts), torch.from_numpy(rim))

    def to(self, device: torch.device | str) -> "PartSamples":
        """A copy on another device."""
        return PartSamples(self.parts.to(device), self.rim.to(device))

    @cached_property
    def members(self) -> tuple[Int[np.ndarray, " _"], ...]:
        """Vertices of each part."""
        return tuple(np.flatnonzero(column) for column in self.parts.T.cpu().numpy())


class PosedParts:
    """A body in T poses, split into parts."""

    def __init__(
        self, vertices: Float[Tensor, "T P 3"], faces: Int[Tensor, "F 3"], samples: PartSamples
    ) -> None:
        """Place the body.

        Raises:
            GeometryError: If ``samples`` belong to another mesh.
        """
        if vertices.shape[1] != len(samples.parts):
            raise GeometryError(
                f"the body has {vertices.shape[1]} vertices, its parts are known for {len(samples.parts)}"
            )
        self.samples, self.faces = samples, faces
        self.points = vertices.detach()
        self.normals = vertex_normals(self.points, faces)
        self._trees: dict[tuple[int, int], cKDTree] = {}

    def beneath(self, own: Bool[Tensor, "V K"]) -> "OwnSkin":
        """The body as a garment meets it whose vertices belong to these parts."""
        return OwnSkin(self, own)

    def nearest(
        self, frame: int, points: Float[Tensor, "n 3"], allowed: Bool[Tensor, "n K"], *, within: float
    ) -> Int[Tensor, " n"]:
        """The nearest sample of the allowed parts; -1 where all are out of sight.

        Args:
            frame: Pose.
            points: Where to look from [m].
            allowed: Parts to look at.
            within: Parts whose bounding box is further away than this [m] are out of sight.
        """
        if points.device.type == "cpu":
            return torch.from_numpy(self._by_tree(frame, points.numpy(), allowed.numpy(), within))
        return self.by_distance(frame, points, allowed)

    def by_distance(
        self, frame: int, points: Float[Tensor, "n 3"], allowed: Bool[Tensor, "n K"]
    ) -> Int[Tensor, " n"]:
        """As `nearest`, from all distances, however far: for devices without trees."""
        distance = torch.cdist(points, self.points[frame])
        distance = distance.masked_fill(~(allowed.float() @ self.samples.parts.T.float() > 0), torch.inf)
        found = distance.min(dim=1)
        return torch.where(torch.isfinite(found.values), found.indices, -1)

    def _by_tree(
        self, frame: int, points: Float[np.ndarray, "n 3"], allowed: Bool[np.ndarray, "n K"], within: float
    ) -> Int[np.ndarray, " n"]:
        best = np.full(len(points), np.inf)
        index = np.full(len(points), -1)
        for part, members in enumerate(self.samples.members):
            if not len(members) or not allowed[:, part].any():
                continue
            tree = self._tree(frame, part)
            near = ((points >= tree.mins - within) & (points <= tree.maxes + within)).all(1)
            rows = np.flatnonzero(near & allowed[:, part])
            distance, found = tree.query(points[rows])
            closer = distance < best[rows]
            best[rows[closer]] = distance[closer]
            index[rows[closer]] = members[found[closer]]
        return index

    def _tree(self, frame: int, part: int) -> cKDTree:
        if (frame, part) not in self._trees:
            points = self.points[frame][self.samples.members[part]].numpy()
            # A balanced tree recurses for ever on exact zeros where torch flushes denormal numbers.
            self._trees[frame, part] = cKDTree(points, balanced_tree=False)
        return self._trees[frame, part]

    def height(self, frame: int, points: Float[Tensor, "n 3"], sample: Int[Tensor, " n"]) -> Tensor:
        """Height of points over the tangent planes of samples [m]; infinite for sample -1."""
        offset = points - self.points[frame][sample]
        return torch.where(sample >= 0, (offset * self.normals[frame][sample]).sum(-1), torch.inf)


@dataclass(frozen=True, eq=False)
class OwnSkin:
    """A posed body as the vertices of one garment meet it."""

    body: PosedParts
    own: Bool[Tensor, "V K"]
    """Parts that each garment vertex belongs to."""

    def gap(self, vertices: Float[Tensor, "T V 3"]) -> Gap:
        """Height over the own parts, and the ceiling that other parts leave [m]."""
        heights, ceilings = [], []
        for frame, positions in enumerate(vertices):
            still = positions.detach()
            sample = self.body.nearest(frame, still, self.own, within=_ASIDE)
            lost = sample < 0
            if lost.any():
                sample[lost] = self.body.nearest(frame, still[lost], self.own[lost], within=torch.inf)
            heights.append(self.body.height(frame, positions, sample))
            ceilings.append(self._ceiling(frame, still, sample))
        return Gap(torch.stack(heights), torch.stack(ceilings))

    def frame(self, index: int) -> "OwnSkin":
        """One pose alone, in double precision."""
        body = self.body
        return PosedParts(body.points[index : index + 1].double(), body.faces, body.samples).beneath(self.own)

    def _ceiling(
        self, frame: int, points: Float[Tensor, "V 3"], sample: Int[Tensor, " V"]
    ) -> Float[Tensor, " V"]:
        """Height at which the line from the own skin to each point meets another part; infinite for most."""
        ceiling = torch.full_like(points[:, 0], torch.inf)
        height = self.body.height(frame, points, sample)
        clear = self._clearance(frame, points, self.own)
        rows = ((clear < 0) & (height > FLAT)).nonzero()[:, 0]
        if len(rows) == 0:
            return ceiling
        skin, own = self.body.points[frame][sample[rows]], self.own[rows]
        way = points[rows] - skin
        free = _last_free(
            lambda share: self._clearance(frame, skin + share[:, None] * way, own) >= 0, height[rows]
        )
        ceiling[rows] = (free * height[rows]).clamp_min(FLAT)
        return ceiling

    def _clearance(
        self, frame: int, points: Float[Tensor, "n 3"], own: Bool[Tensor, "n K"]
    ) -> Float[Tensor, " n"]:
        """How far points are above the margin over other parts [m]; infinite over a rim."""
        sample = self.body.nearest(frame, points, ~own, within=_OTHER_MARGIN)
        rim = (self.body.samples.rim[sample] & ~own).any(1)
        height = self.body.height(frame, points, sample) - _OTHER_MARGIN
        return torch.where(rim, torch.inf, height)


def _last_free(
    is_free: Callable[[Float[Tensor, " n"]], Bool[Tensor, " n"]], like: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Shares of a way, from 0 where it is free to 1 where it is not, up to which it stays free."""
    low, high = torch.zeros_like(like), torch.ones_like(like)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        good = is_free(middle)
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    return low
