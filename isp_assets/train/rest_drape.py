"""Physics of the rest shape: hang a sewn pattern on a body until it is at rest.

Three stages: both sheets start collision-free, wrapped round the body's depth map;
XPBD makes all the large motion; L-BFGS then finds the minimum of the very energy that
the draping network is trained with, plus a penalty inside the body's margin. Seams are
welded from the start, so nothing is stitched. Positions are in metres, Y up.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from isp_assets.conventions import GRAVITY
from isp_assets.errors import GarmentError, MissingExtraError
from isp_assets.geometry.energy import ClothRest, Fabric, cloth_rest
from isp_assets.geometry.topology import edges
from isp_assets.train.body_field import DepthMap
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
    metrics: dict[str, float]


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
        raise GarmentError("draping diverged: positions are not finite; the pattern is too tight for the body")
    metrics = {"speed": speed, "residual": residual, **_measure(vertices, pattern, cloth, body)}
    return RestShape(vertices=vertices, metrics=metrics)


def wrapped_start(pattern: SewnPattern, body: RestBody, *, margin: float = 0.012, slope: float = 1.2):
    """Lift both sheets off the body along z, falling back to its middle away from it; no contact anywhere."""
    depth = body.depth
    if "_wrap" not in depth.__dict__:
        object.__setattr__(depth, "_wrap", _wrap_fields(depth, margin, slope))
    middle, up, down = depth.__dict__["_wrap"]
    row_column = ((pattern.vertex_xy - depth.origin) / depth.cell).T[::-1]

    def at(field: Float[np.ndarray, "Y X"]) -> Float[np.ndarray, " V"]:
        return ndimage.map_coordinates(field, row_column, order=1, mode="nearest")

    side = pattern.vertex_side
    z = at(middle) + np.where(side > 0, at(up), 0) - np.where(side < 0, at(down), 0)
    return np.concatenate([pattern.vertex_xy, z[:, None]], axis=1)


def _wrap_fields(depth: DepthMap, margin: float, slope: float, reach: float = 0.12):
    mask = depth.mask
    rows, columns = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    front, back = depth.front[rows, columns], depth.back[rows, columns]
    middle = ndimage.gaussian_filter(0.5 * (front + back), 6)
    step, diagonal = slope * depth.cell, slope * depth.cell * np.sqrt(2)
    cone = -np.array([[diagonal, step, diagonal], [step, 0, step], [diagonal, step, diagonal]])

    def widen(height: Float[np.ndarray, "Y X"]) -> Float[np.ndarray, "Y X"]:
        for _ in range(int(reach / depth.cell)):
            height = ndimage.grey_dilation(height, structure=cone)
        return np.maximum(height, 0)

    up = widen(np.where(mask, front - middle + margin, 0))
    down = widen(np.where(mask, middle - back + margin, 0))
    return middle, up, down


def waist_targets(pattern: SewnPattern, body: RestBody, *, gap: float = 0.004) -> Float[np.ndarray, "A 3"]:
    """Positions of the anchored waist: by arc length round the body's section, offset to the pattern's length."""
    if len(pattern.anchors) == 0:
        return np.empty((0, 3))
    xy, side = pattern.vertex_xy[pattern.anchors], pattern.vertex_side[pattern.anchors]
    segments, loop = body.section(np.array([0.0, xy[0, 1], 0.0]), np.array([0.0, 1.0, 0.0]))
    points = segments[loop == 0].reshape(-1, 3)[:, [0, 2]]
    hull = ConvexHull(points)
    ring = points[hull.vertices]  # counter-clockwise in (x, z): from the front centre towards -x
    width = np.abs(xy[:, 0]).max()
    offset = max(gap, (4 * width - hull.area) / (2 * np.pi))
    tangent = np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    ring = ring + offset * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    ring = np.concatenate([ring, ring[:1]])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    dense = np.linspace(0, arc[-1], 2001)
    curve = np.stack([np.interp(dense, arc, ring[:, k]) for k in (0, 1)], axis=1)
    # The front centre must be found exactly: a ring turned by a centimetre skews the whole garment.
    in_front = curve[:, 1] > points[:, 1].mean()
    front_centre = dense[np.where(in_front, np.abs(curve[:, 0]), np.inf).argmin()]
    quarter = 0.25 * arc[-1] * xy[:, 0] / width
    position = (front_centre + np.where(side < 0, 0.5 * arc[-1] + quarter, -quarter)) % arc[-1]
    x, z = (np.interp(position, dense, curve[:, k]) for k in (0, 1))
    return np.stack([x, xy[:, 1], z], axis=1)


def _relax(start, targets, pattern: SewnPattern, cloth: ClothRest, body: RestBody, settings: DrapeSettings):
    from isp_assets.train import _kernels

    mesh = edges(pattern.faces)
    flat = pattern.corner_xy
    lengths = np.linalg.norm(np.roll(flat, -1, axis=1) - flat, axis=-1).reshape(-1)
    length = np.bincount(mesh.face_edge.reshape(-1), lengths) / mesh.num_faces
    inverse_mass = 1 / cloth.mass.numpy()
    inverse_mass[pattern.anchors] = 0
    x, velocity, speed = start.copy(), np.zeros_like(start), np.zeros(settings.substeps)
    grid = body.distance
    for _ in range(1 + _EXTRA_ROUNDS):
        _kernels.relax(
            x, velocity, inverse_mass, mesh.vertices, length, cloth.hinges.numpy(), cloth.hinge_weights.numpy(),
            cloth.hinge_area.numpy() / (3 * settings.fabric.bending), grid.values, grid.origin, grid.cell,
            pattern.anchors, targets, pattern.twins, len(speed), settings.time_step, GRAVITY,
            settings.stretch_stiffness, settings.damping, settings.margin, settings.friction, settings.sheet_gap, speed,
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

    options = dict(maxiter=settings.iterations, maxfun=2 * settings.iterations, maxcor=20, ftol=1e-14, gtol=1e-9)
    found = minimize(objective, (start[free] * scale).reshape(-1), jac=True, method="L-BFGS-B", options=options)
    x[free] = found.x.reshape(-1, 3) / scale
    _, gradient = evaluate(x)
    return x.copy(), float(np.linalg.norm(gradient[free]) / (np.linalg.norm(mass) * GRAVITY))


def energy_function(pattern: SewnPattern, cloth: ClothRest, body: RestBody, settings: DrapeSettings):
    """Energy [J] and gradient of a rest shape, body and twin sheets included; the gradient is reused storage."""
    from isp_assets.train import _kernels

    fabric, grid = settings.fabric, body.distance
    mass = cloth.mass.numpy()
    gradient = np.zeros((len(mass), 3))
    elastic = (
        cloth.faces.numpy(), cloth.inverse_rest.numpy(), cloth.area.numpy(), cloth.hinges.numpy(),
        cloth.hinge_weights.numpy(), 3 * fabric.bending / cloth.hinge_area.numpy(), mass, fabric.mu, fabric.lam, GRAVITY,
    )  # fmt: skip
    contact = (grid.values, grid.origin, grid.cell, settings.margin, settings.contact_stiffness * mass)

    def evaluate(x: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        energy = _kernels.elastic_energy(x, *elastic, gradient)
        energy += _kernels.contact_energy(x, *contact, pattern.twins, settings.sheet_gap, gradient)
        return energy, gradient

    return evaluate


def _measure(x, pattern: SewnPattern, cloth: ClothRest, body: RestBody) -> dict[str, float]:
    mesh = edges(pattern.faces)
    flat = pattern.corner_xy
    lengths = np.linalg.norm(np.roll(flat, -1, axis=1) - flat, axis=-1).reshape(-1)
    length = np.bincount(mesh.face_edge.reshape(-1), lengths) / mesh.num_faces
    strain = np.linalg.norm(x[mesh.vertices[:, 0]] - x[mesh.vertices[:, 1]], axis=1) / length - 1
    return {
        "strain_mean": float(np.abs(strain).mean()),
        "strain_p99": float(np.quantile(strain, 0.99)),
        "strain_max": float(strain.max()),
        "strain_min": float(strain.min()),
        "clearance": float(body.distance.sample(x).min()),
        "body_intersects": float(_intersects(x, pattern.faces, body)),
        "self_intersects": float(_intersects(x, pattern.faces, None)),
    }


def _intersects(x, faces, body: RestBody | None) -> bool:
    """Whether the garment's triangles cross the body's, or each other."""
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
        patch = np.concatenate([np.zeros(len(x), dtype=np.int32), np.ones(len(body.vertices), dtype=np.int32)])
        mesh.can_collide = ipctk.make_vertex_patches_filter(patch)
    return bool(ipctk.has_intersections(mesh, vertices))
