"""Physics of the rest shape: hang a sewn pattern on a body until it is at rest.

Three stages: both sheets start clear of the body, wrapped round the body's depth map;
XPBD makes all the large motion; L-BFGS then finds the minimum of the very energy that
the draping network is trained with, plus a penalty inside the body's margin. Seams are
welded from the start, so nothing is stitched. Positions are in metres, Y up.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize

from isp_assets.conventions import GRAVITY
from isp_assets.errors import GarmentError, MissingExtraError
from isp_assets.geometry.energy import (
    ClothRest,
    Fabric,
    bending_energy,
    cloth_rest,
    gravity_energy,
    membrane_energy,
)
from isp_assets.geometry.topology import Edges, edges
from isp_assets.train.drape_start import waist_targets, wrapped_start
from isp_assets.train.landmarks import RestBody
from isp_assets.train.pattern import SewnPattern

_SETTLED = 0.02  # rms speed [m/s] below which XPBD has done its part
_EXTRA_ROUNDS = 2  # of half the substeps each


@dataclass(frozen=True)
class DrapeSettings:
    """How long and how closely to drape."""

    substeps: int = 1000
    """Of XPBD; wide garments that still swing get up to twice as many."""
    iterations: int = 250
    """Of L-BFGS."""
    margin: float = 0.006
    """Distance to keep from the body [m]; flat triangles cut up to 3 mm into round shoulders."""
    sheet_gap: float = 0.004
    """Distance of front and back vertices at the same flat position, along z [m]."""
    time_step: float = 1 / 600
    stretch_stiffness: float = 400.0
    """Of the edges in XPBD [N/m]."""
    damping: float = 0.99
    """Velocity kept per substep."""
    friction: float = 0.2
    contact_stiffness: float = 3.3e6
    """Penalty per mass [N/(m kg)]."""
    fabric: Fabric = field(default_factory=Fabric)


@dataclass(frozen=True, eq=False)
class RestShape:
    """A garment at rest on a body."""

    vertices: Float[np.ndarray, "V 3"]
    """Positions [m]."""
    metrics: dict[str, float]
    """Rms speed at the end of XPBD [m/s], residual |net force| / |weight|, strain of the edges, smallest
    clearance of a vertex [m], and 1 where triangles cross the body or each other."""


def drape_to_rest(pattern: SewnPattern, body: RestBody, settings: DrapeSettings | None = None) -> RestShape:
    """Hang a sewn pattern on a body.

    Raises:
        GarmentError: If the solver diverges.
        MissingExtraError: If numba or ipctk is not installed.
    """
    settings = settings or DrapeSettings()
    cloth = cloth_rest(pattern.faces, pattern.corner_xy, len(pattern.vertex_xy), settings.fabric)
    targets = waist_targets(pattern, body)
    start = wrapped_start(pattern, body)
    loose, speed = _relax(start, targets, pattern, cloth, body, settings)
    vertices, residual = _polish(loose, pattern, cloth, body, settings)
    if not np.isfinite(vertices).all():
        raise GarmentError(
            "draping diverged: positions are not finite; the pattern is too tight for the body"
        )
    metrics = {"speed": speed, "residual": residual, **_measure(vertices, pattern, cloth, body)}
    return RestShape(vertices=vertices, metrics=metrics)


def _flat_edges(pattern: SewnPattern) -> tuple[Edges, Float[np.ndarray, " E"]]:
    """Edges of the sewn mesh and their flat lengths [m]; on a seam, the mean of both panels."""
    mesh, flat = edges(pattern.faces), pattern.corner_xy
    lengths = np.linalg.norm(np.roll(flat, -1, axis=1) - flat, axis=-1).reshape(-1)
    return mesh, np.bincount(mesh.face_edge.reshape(-1), lengths) / mesh.num_faces


def _relax(start, targets, pattern: SewnPattern, cloth: ClothRest, body: RestBody, settings: DrapeSettings):
    from isp_assets.train import _kernels

    mesh, length = _flat_edges(pattern)
    inverse_mass = 1 / cloth.mass.numpy()
    inverse_mass[pattern.anchors] = 0
    x, velocity, speed = start.copy(), np.zeros_like(start), np.zeros(settings.substeps)
    grid = body.distance
    for _ in range(1 + _EXTRA_ROUNDS):
        _kernels.relax(
            x, velocity, inverse_mass, mesh.vertices, length, cloth.hinges.numpy(),
            cloth.hinge_weights.numpy(), cloth.hinge_area.numpy() / (3 * settings.fabric.bending),
            grid.values, grid.origin, grid.cell, pattern.anchors, targets, pattern.twins, len(speed),
            settings.time_step, GRAVITY, settings.stretch_stiffness, settings.damping, settings.margin,
            settings.friction, settings.sheet_gap, speed,
        )  # fmt: skip
        if speed[-1] < _SETTLED:
            break
        speed = np.zeros(settings.substeps // 2)
    return x, float(speed[-1])


def _polish(start, pattern: SewnPattern, cloth: ClothRest, body: RestBody, settings: DrapeSettings):
    """L-BFGS on mass-scaled positions; also gives |net force| / |weight| at its end."""
    mass = cloth.mass.numpy()
    free = np.ones(len(mass), dtype=bool)
    free[pattern.anchors] = False
    scale = np.sqrt(mass[free])[:, None]
    evaluate = energy_function(pattern, cloth, body, settings)
    x = start.copy()

    def objective(y):
        x[free] = y.reshape(-1, 3) / scale
        energy, gradient = evaluate(x)
        return energy, (gradient[free] / scale).reshape(-1)

    limit = settings.iterations
    options = {"maxiter": limit, "maxfun": 2 * limit, "maxcor": 20, "ftol": 1e-14, "gtol": 1e-9}
    first = (start[free] * scale).reshape(-1)
    found = minimize(objective, first, jac=True, method="L-BFGS-B", options=options)
    x[free] = found.x.reshape(-1, 3) / scale
    _, gradient = evaluate(x)
    return x.copy(), float(np.linalg.norm(gradient[free]) / (np.linalg.norm(mass) * GRAVITY))


def energy_function(pattern: SewnPattern, cloth: ClothRest, body: RestBody, settings: DrapeSettings):
    """Energy [J] and its gradient as a function of a rest shape: cloth, body and twin sheets."""
    from isp_assets.train import _kernels

    fabric, grid = settings.fabric, body.distance
    stiffness = settings.contact_stiffness * cloth.mass.numpy()
    contact = (grid.values, grid.origin, grid.cell, settings.margin, stiffness)
    sheets = (pattern.twins, settings.sheet_gap)

    def evaluate(x: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        position = torch.tensor(x, requires_grad=True)
        energy = membrane_energy(position, cloth, fabric) + bending_energy(position, cloth, fabric)
        energy = energy + gravity_energy(position, cloth)
        (slope,) = torch.autograd.grad(energy, position)
        gradient = slope.numpy()
        return energy.item() + _kernels.contact_energy(x, *contact, *sheets, gradient), gradient

    return evaluate


def _measure(x, pattern: SewnPattern, cloth: ClothRest, body: RestBody) -> dict[str, float]:
    mesh, length = _flat_edges(pattern)
    strain = np.linalg.norm(x[mesh.vertices[:, 0]] - x[mesh.vertices[:, 1]], axis=1) / length - 1
    return {
        "strain_mean": float(np.abs(strain).mean()),
        "strain_p99": float(np.quantile(strain, 0.99)),
        "strain_max": float(strain.max()),
        "strain_min": float(strain.min()),
        "clearance": float(body.distance.sample(x).min()),
        "body_intersects": float(intersects(x, pattern.faces, body)),
        "self_intersects": float(intersects(x, pattern.faces)),
    }


def intersects(
    x: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], body: RestBody | None = None
) -> bool:
    """Whether the triangles of a garment cross those of the body, or without a body each other; exact."""
    try:
        import ipctk
    except ImportError as error:
        raise MissingExtraError("ipctk", "train", "checking training garments for intersections") from error
    vertices, triangles = x, faces
    if body is not None:
        vertices = np.concatenate([x, body.vertices])
        triangles = np.concatenate([faces, body.faces + len(x)])
    mesh = ipctk.CollisionMesh(vertices, ipctk.edges(triangles), triangles)
    if body is not None:
        patch = np.repeat(np.array([0, 1], dtype=np.int32), [len(x), len(body.vertices)])
        mesh.can_collide = ipctk.make_vertex_patches_filter(patch)
    return bool(ipctk.has_intersections(mesh, vertices))
