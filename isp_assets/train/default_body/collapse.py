"""Thin out a mesh by half-edge collapses: every vertex that remains stays where it was.

Reference: Garland and Heckbert, "Surface simplification using quadric error metrics", 1997.
"""

import heapq
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

_LENGTH_COST = 1e-6  # per square metre of edge: orders the collapses on flat ground, where the error is zero
_LEAST_NORMAL_COSINE = 0.25  # a collapse must not turn a face over, or nearly
_LEAST_ASPECT = 0.12  # twice the area over the longest edge squared
_MOST_NEIGHBOURS = 11


class Collapser:
    """A triangle mesh that is being thinned out.

    Args:
        points: Vertex positions [m]; they never change.
        faces: Triangles; vertices of no face are ignored.
        fixed: Vertices of a border: they may slide along it, never leave it.
        region: Region number of each vertex.
        budget: Vertices to keep in each region; ``None`` leaves the region untouched.
        longest: Longest edge that a collapse may make in each region [m].
    """

    def __init__(
        self,
        points: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        *,
        fixed: Bool[np.ndarray, " V"],
        region: Int[np.ndarray, " V"],
        budget: Sequence[int | None],
        longest: Sequence[float],
    ) -> None:
        self._points, self._fixed, self._region = points, fixed, region
        self._budget, self._longest = budget, longest
        self._faces = [tuple(face) for face in faces.tolist()]
        self._around: list[set[int]] = [set() for _ in points]  # faces around each vertex
        self._quadrics = np.zeros((len(points), 4, 4))
        for number, face in enumerate(self._faces):
            normal, area = self._normal_and_area(face)
            plane = np.append(normal, -normal @ points[face[0]])
            for vertex in face:
                self._around[vertex].add(number)
                self._quadrics[vertex] += area * np.outer(plane, plane)
        used = np.array([len(around) > 0 for around in self._around])
        self._count = np.bincount(region[used], minlength=len(budget))
        self._version = np.zeros(len(points), dtype=np.int64)  # outdates the queue's older entries
        self._queue: list[tuple[float, int, int, int, int]] = []

    def run(self) -> Int[np.ndarray, "G 3"]:
        """Collapse the cheapest edges until every region is within budget; the faces that remain."""
        for vertex in range(len(self._points)):
            self._offer(vertex)
        while self._queue:
            _, gone, kept, gone_version, kept_version = heapq.heappop(self._queue)
            fresh = self._version[gone] == gone_version and self._version[kept] == kept_version
            if fresh and self._around[gone] and self._around[kept] and self._may_collapse(gone, kept):
                self._collapse(gone, kept)
        remaining = sorted({number for around in self._around for number in around})
        return np.array([self._faces[number] for number in remaining])

    def _offer(self, gone: int) -> None:
        if self._budget[self._region[gone]] is not None:
            for kept in self._neighbours(gone):
                self._push(gone, kept)

    def _push(self, gone: int, kept: int) -> None:
        point = np.append(self._points[kept], 1)
        error = point @ (self._quadrics[gone] + self._quadrics[kept]) @ point
        length = ((self._points[gone] - self._points[kept]) ** 2).sum()
        cost = float(error + _LENGTH_COST * length)
        versions = int(self._version[gone]), int(self._version[kept])
        heapq.heappush(self._queue, (cost, gone, kept, *versions))

    def _may_collapse(self, gone: int, kept: int) -> bool:
        budget = self._budget[self._region[gone]]
        if budget is None or self._count[self._region[gone]] <= budget:
            return False
        shared = self._around[gone] & self._around[kept]
        if self._fixed[gone]:
            if not self._fixed[kept] or len(shared) != 1:
                return False
        elif len(shared) != 2:
            return False
        neighbours, others = self._neighbours(gone), self._neighbours(kept)
        # The link condition keeps the surface a manifold.
        if len(neighbours & others) != len(shared) or len(neighbours | others) - 2 > _MOST_NEIGHBOURS:
            return False
        return all(self._stays_well_shaped(number, gone, kept) for number in self._around[gone] - shared)

    def _stays_well_shaped(self, number: int, gone: int, kept: int) -> bool:
        before = self._faces[number]
        after = tuple(kept if vertex == gone else vertex for vertex in before)
        normal_before, _ = self._normal_and_area(before)
        normal_after, area = self._normal_and_area(after)
        corners = self._points[list(after)]
        longest = float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).max())
        return bool(
            normal_before @ normal_after >= _LEAST_NORMAL_COSINE
            and longest <= self._longest[self._region[gone]]
            and 2 * area / (longest**2 + 1e-20) >= _LEAST_ASPECT
        )

    def _collapse(self, gone: int, kept: int) -> None:
        for number in self._around[gone] & self._around[kept]:
            for vertex in self._faces[number]:
                self._around[vertex].discard(number)
        for number in self._around[gone]:
            self._faces[number] = tuple(kept if vertex == gone else vertex for vertex in self._faces[number])
            self._around[kept].add(number)
        self._around[gone] = set()
        self._quadrics[kept] += self._quadrics[gone]
        self._count[self._region[gone]] -= 1
        self._version[gone] += 1
        self._version[kept] += 1
        self._offer(kept)
        for neighbour in self._neighbours(kept):
            if self._budget[self._region[neighbour]] is not None:
                self._push(neighbour, kept)

    def _neighbours(self, vertex: int) -> set[int]:
        return {other for number in self._around[vertex] for other in self._faces[number]} - {vertex}

    def _normal_and_area(self, face: tuple[int, ...]) -> tuple[Float[np.ndarray, "3"], float]:
        a, b, c = self._points[list(face)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        return normal / (length + 1e-20), length / 2
