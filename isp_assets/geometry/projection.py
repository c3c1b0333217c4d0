"""The last rung of the ladder: move a garment until it touches nothing beneath it.

Contact is resolved from both sides: garment vertices are lifted off the surfaces
beneath, and the corners of garment triangles are lifted over vertices that poke
through them. Each lift is spread over the neighbourhood, so that no spike stands
out; the last rounds lift without spreading, down to the pairs of triangles that
an exact test still finds crossing.

Positions are in metres, in one shared space. NumPy, one frame and one garment at a
time; obstacles (`Obstacle`) are the body and the finished inner garments.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import Closest, ClosestQuery, SurfaceTopology, unit_face_normals
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle

BODY_MARGIN = 0.003
"""Clearance to leave over the body [m]."""
LAYER_MARGIN = 0.0025
"""Clearance to leave over an inner garment [m]."""

_NEAR = 0.01  # a garment vertex this near [m] to a place without room for cloth is itself without room


@dataclass(frozen=True)
class ProjectionOptions:
    """How hard to work."""

    rounds: int = 4
    """Rounds of lifting and spreading."""
    finish: int = 4
    """Rounds of lifting triangles that still cross, at most."""
    spread: int = 8
    """Rings of neighbours that follow a lift."""
    reach: float = 0.06
    """Own contact deeper than this [m] is left alone: the way out is not known."""
    foreign_reach: float = 0.015
    """The same for contact with another part of the body."""
    poke_reach: float = 0.015
    """How far a vertex beneath may poke through a triangle [m] and still lift it."""
    tolerance: float = 1e-4
    """Lifts below this [m] count as none."""

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.finish < 0 or self.spread < 0:
            raise GeometryError(f"projection needs rounds >= 1, finish >= 0 and spread >= 0, got {self}")


@dataclass(frozen=True, eq=False)
class Projection:
    """A garment clear of what lies beneath it, and what that took."""

    vertices: Float[np.ndarray, "V 3"]
    ran: bool
    """False where nothing touched: ``vertices`` are then the ones that came in."""
    rounds: int
    largest_move: float
    """[m]"""
    tight: Bool[np.ndarray, " V"]
    """Vertices where the surfaces beneath leave no room for cloth."""
    crossings: int
    """Pairs of triangles that still cross."""


def project(
    vertices: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions = ProjectionOptions(),
) -> Projection:
    """Lift a garment clear of all obstacles.

    Args:
        vertices: The garment in this frame [m].
        mesh: The garment's collision data.
        obstacles: What lies beneath: body first, then inner garments.
        options: How hard to work.

    Raises:
        GeometryError: If a position is not finite or the mesh does not fit.
    """
    start = np.ascontiguousarray(vertices, np.float64)
    if not np.isfinite(start).all():
        raise GeometryError("garment positions hold NaN or infinity; check the networks' output")
    position, average = start, _neighbour_average(mesh.topology)
    rounds = 0
    tight = _tight(position, mesh, obstacles)
    for rounds in range(1, options.rounds + 1):
        lift = _lift_vertices(position, mesh, obstacles, options, tight, foreign=rounds < options.rounds)
        poke = (
            _lift_triangles(position + lift, mesh, obstacles, options, tight)
            if rounds > 1
            else np.zeros_like(lift)
        )
        lift = lift + poke
        if np.abs(lift).max(initial=0) < options.tolerance and rounds > 1:
            break
        position = position + _spread(lift, average, options.spread if rounds < options.rounds else 0)
    position, crossings = _finish(position, mesh, obstacles, options, tight)
    move = np.linalg.norm(position - start, axis=1).max(initial=0)
    ran = bool(move > 0)
    return Projection(position if ran else start, ran, rounds, float(move), tight, crossings)


def _tight(
    position: Float[np.ndarray, "V 3"], mesh: CollisionMesh, obstacles: Sequence[Obstacle]
) -> Bool[np.ndarray, " V"]:
    """Garment vertices close to a place without room for cloth."""
    tight = np.zeros(len(position), bool)
    for obstacle in obstacles:
        if obstacle.tight.any():
            found = obstacle.contacts(position, mesh.parts, within=_NEAR)
            beneath = obstacle.tight[obstacle.mesh.topology.faces[found.face]].any(1)
            tight |= beneath & (np.abs(found.height) < _NEAR)
    return tight


def _lift_vertices(
    position: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions,
    tight: Bool[np.ndarray, " V"],
    *,
    foreign: bool,
) -> Float[np.ndarray, "V 3"]:
    """The largest lift over all obstacles; foreign contact may only use up room above the own margins."""
    own, other = np.zeros_like(position), np.zeros_like(position)
    room = np.full(len(position), np.inf)
    for obstacle in obstacles:
        found = obstacle.contacts(position, mesh.parts, within=options.foreign_reach)
        margin = np.where(tight, 5e-4, obstacle.margin)
        _keep_larger(own, _lift(position, found, margin, options.reach))
        spare = np.where(found.on_border, np.inf, (found.height - obstacle.margin).clip(0))
        room = np.minimum(room, spare)
        if foreign:
            found = obstacle.contacts(position, ~mesh.parts, within=obstacle.margin)
            _keep_larger(other, _lift(position, found, margin, options.foreign_reach))
    length = np.linalg.norm(other, axis=1)
    other *= np.minimum(1, room / np.maximum(length, 1e-9))[:, None]
    return np.where((own != 0).any(1, keepdims=True), own, other)


def _lift(
    position: Float[np.ndarray, "V 3"], found: Closest, margin: Float[np.ndarray, " V"], reach: float
) -> Float[np.ndarray, "V 3"]:
    """Shortest way to the margin over one obstacle."""
    touching = (found.height < margin) & (found.height > -reach) & ~found.on_border
    away = np.where(found.height[:, None] >= 0, position - found.point, found.point - position)
    length = np.linalg.norm(away, axis=1, keepdims=True)
    away = np.where(length > 1e-6, away / np.maximum(length, 1e-6), found.normal)
    return np.where(touching[:, None], (margin - found.height)[:, None].clip(0, 1) * away, 0.0)


def _lift_triangles(
    position: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions,
    tight: Bool[np.ndarray, " V"],
) -> Float[np.ndarray, "V 3"]:
    """Lift the corners of triangles over obstacle vertices that poke through them."""
    lift, reach = np.zeros_like(position), options.poke_reach
    query = ClosestQuery(position, mesh.topology)
    low, high = position.min(0) - reach, position.max(0) + reach
    for obstacle in obstacles:
        inside = ((obstacle.vertices > low) & (obstacle.vertices < high)).all(1)
        index = np.flatnonzero(inside)
        found = query(obstacle.vertices[index])
        corner = mesh.topology.faces[found.face]
        gap = (
            obstacle.margin / 2
        )  # vertices already keep the whole margin; half of it allows for their chords
        poking = (found.height > -gap) & (found.height < reach) & ~found.on_border
        poking &= (mesh.parts[corner].any(1) & obstacle.mesh.parts[index]).any(1)
        facing = obstacle.vertex_normals[index]
        poking &= (facing * found.normal).sum(1) > 0.3
        poking &= ~(tight[corner].any(1) | obstacle.tight[index])
        corner, weights = corner[poking], found.weights[poking]
        share = weights / (weights * weights).sum(1, keepdims=True)
        push = (found.height[poking] + gap)[:, None, None] * share[..., None] * facing[poking][:, None]
        _keep_larger(lift, _largest_per_vertex(corner, push, len(position)))
    return lift


def _finish(
    position: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions,
    tight: Bool[np.ndarray, " V"],
) -> tuple[Float[np.ndarray, "V 3"], int]:
    """Lift triangles over the planes of the triangles they still cross."""
    faces = mesh.topology.faces
    for attempt in range(options.finish + 1):
        lift, crossings = np.zeros_like(position), 0
        normals = None
        for obstacle in obstacles:
            beneath = obstacle.mesh.topology.faces
            pairs = crossing_pairs(position, faces, obstacle.vertices, beneath)
            own = mesh.parts[faces[pairs[:, 0]]].any(1) & obstacle.mesh.parts[beneath[pairs[:, 1]]].any(1)
            trapped = tight[faces[pairs[:, 0]]].any(1) | obstacle.tight[beneath[pairs[:, 1]]].any(1)
            pairs = pairs[own.any(1) & ~trapped]
            crossings += len(pairs)
            if len(pairs) == 0 or attempt == options.finish:
                continue
            normals = unit_face_normals(position, faces) if normals is None else normals
            mine, theirs = normals[pairs[:, 0]], obstacle.face_normals[pairs[:, 1]]
            alike = (mine * theirs).sum(1, keepdims=True)
            plane = np.where(alike > 0.2, theirs, mine)
            corner = position[faces[pairs[:, 0]]]
            top = (obstacle.vertices[beneath[pairs[:, 1]]] * plane[:, None]).sum(-1).max(1)
            need = (top[:, None] + 3e-4 - (corner * plane[:, None]).sum(-1)).clip(0, 0.004)
            push = need[..., None] * plane[:, None] * (np.abs(alike) > 0.2)[..., None]
            _keep_larger(lift, _largest_per_vertex(faces[pairs[:, 0]], push, len(position)))
        if not lift.any():
            break
        position = position + lift
    return position, crossings


def _keep_larger(kept: Float[np.ndarray, "V 3"], offered: Float[np.ndarray, "V 3"]) -> None:
    """Replace rows of ``kept`` where ``offered`` is longer."""
    larger = (offered * offered).sum(1) > (kept * kept).sum(1)
    kept[larger] = offered[larger]


def _largest_per_vertex(
    corner: Int[np.ndarray, "n 3"], push: Float[np.ndarray, "n 3 3"], num_vertices: int
) -> Float[np.ndarray, "V 3"]:
    vertex, push = corner.reshape(-1), push.reshape(-1, 3)
    order = np.argsort((push * push).sum(1), kind="stable")
    largest = np.zeros((num_vertices, 3))
    largest[vertex[order]] = push[order]  # the last write to a row wins: the longest push
    return largest


def _spread(lift: Float[np.ndarray, "V 3"], average: csr_array, rings: int) -> Float[np.ndarray, "V 3"]:
    """Let neighbours follow: a screened Laplace equation, lifted vertices held, by Jacobi rounds."""
    held = (lift != 0).any(1)
    if not held.any():
        return lift
    spread = lift
    for _ in range(rings):
        spread = np.where(held[:, None], lift, 0.9 * (average @ spread))
    return spread


def _neighbour_average(topology: SurfaceTopology) -> csr_array:
    faces, count = topology.faces, len(topology.border_vertex)
    row, column = np.concatenate([faces, np.roll(faces, 1, axis=1)]).reshape(-1), None
    column = np.concatenate([np.roll(faces, -1, axis=1), faces]).reshape(-1)
    ones = csr_array((np.ones(len(row)), (row, column)), shape=(count, count))
    ones.data[:] = 1.0
    degree = np.asarray(ones.sum(1)).reshape(-1)
    ones.data /= np.repeat(np.maximum(degree, 1), np.diff(ones.indptr))
    return ones
