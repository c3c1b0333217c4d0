"""Train the diffused skinning field ``w(v)`` of one body.

The target spreads the body's surface smoothly into space: at distance ``d`` from the
skin, a point takes part in all body vertices by a Gaussian of its distance to them,
of width ``sqrt(base² + (growth d)²)``, and by the area they stand for. On the skin
that is the local surface; half a leg's length away, both legs and the pelvis alike.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 6-7.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.body import Body
from isp_assets.bundle import SkinBundle
from isp_assets.conventions import JOINT_NAMES, NUM_JOINTS
from isp_assets.geometry.closest import ClosestQuery, SurfaceTopology
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.train.garment_maker import CATEGORIES
from isp_assets.train.loop import RunOptions, RunReport, train
from isp_assets.train.optimizers import OptimizerName

_HELD_OUT = 1500
_STEP = 0.005  # length over which smoothness is measured [m]
_BENT = np.full((24, 3), 0.4, np.float32)  # a pose [rad] whose corrective shape is measured


@dataclass(frozen=True)
class Diffusion:
    """How far the surface's weights spread, and where the field is sampled."""

    base: float = 0.025
    """Kernel width on the skin [m]."""
    growth: float = 1.0
    """Kernel width per distance from the skin."""
    reach: float = 0.4
    """Largest offset of a sample from the skin [m]; a wide skirt is that far away."""
    samples: int = 60_000
    """Sample points per rest pose."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Points around the body in one rest pose."""

    points: Float[Tensor, "P 3"]
    width: Float[Tensor, " P"]
    """Kernel width of the target [m]."""

    def take(self, index: Tensor | slice) -> "Samples":
        return Samples(self.points[index], self.width[index])

    def to(self, device: torch.device) -> "Samples":
        return Samples(self.points.to(device), self.width.to(device))


class SkinTask:
    """What `train` needs: the field, its target, losses and metrics."""

    name = "skin"
    optimizer: OptimizerName = "adam"

    def __init__(
        self, body: Body, config: SkinFieldConfig, diffusion: Diffusion, *,
        seed: int = 0, device: str = "cpu",
    ) -> None:  # fmt: skip
        self.diffusion, self.device = diffusion, torch.device(device)
        self.config: Mapping[str, Any] = {
            "field": config.to_dict(), "diffusion": asdict(diffusion), "body": body.sha256,
        }  # fmt: skip
        poses = torch.tensor(config.rest_poses).unflatten(1, (24, 3))
        surfaces, area, faces = body.pose(poses).vertices, _vertex_area(body), body.faces.numpy()
        corrective = body.pose_dirs @ body.pose(torch.tensor(_BENT)[None]).pose_feature[0]
        self.module = SkinField(config)
        self.module.place_on(surfaces, area)
        rng = np.random.default_rng(seed)
        drawn = [self._draw(surface, faces, rng).to(self.device) for surface in surfaces]
        self.body, self.module = body.to(self.device), self.module.to(self.device)
        self.surfaces, self.area = surfaces.to(self.device), area.to(self.device)
        self.corrective = corrective.to(self.device)
        self.pools = [samples.take(slice(_HELD_OUT, None)) for samples in drawn]
        self.held_out = [samples.take(slice(_HELD_OUT)) for samples in drawn]

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.module.parameters()), "lr": 2e-3}]

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        """Squared log ratio of the kernel widths; with a head, also the cross-entropy of the weights."""
        config = self.module.config
        terms: dict[str, Tensor] = {}
        width_loss, entropy = torch.zeros((), device=self.device), torch.zeros((), device=self.device)
        for rest, pool in enumerate(self.pools):
            if config.kernel:
                batch = pool.take(self._rows(len(pool.points), 4096, generator))
                ratio = self.module.log_width(batch.points, rest=rest) - batch.width.log()
                width_loss = width_loss + ratio.square().mean()
            if config.rank:
                batch = pool.take(self._rows(len(pool.points), 256, generator))
                log_weights = self.module.logits(batch.points, rest=rest).log_softmax(-1)
                entropy = entropy - (self.target(batch, rest=rest) * log_weights).sum(-1).mean()
        if config.kernel:
            terms["width"] = width_loss
        if config.rank:
            terms["entropy"] = 0.01 * entropy
        return terms

    def _rows(self, available: int, count: int, generator: torch.Generator) -> Tensor:
        return torch.randint(available, (count,), generator=generator).to(self.device)

    def target(self, samples: Samples, *, rest: int) -> Float[Tensor, "P N"]:
        """The weights that the field should give."""
        square = torch.cdist(samples.points, self.surfaces[rest]).square()
        return (self.area.log() - 0.5 * square / samples.width[:, None].square()).softmax(-1)

    @torch.no_grad()
    def measure(self) -> dict[str, float]:
        """Errors of what is folded out of the weights, and their steepness, on held-out points."""
        figures = [self._measure(samples, rest) for rest, samples in enumerate(self.held_out)]
        return {name: max(f[name] for f in figures) for name in figures[0]}

    def _measure(self, samples: Samples, rest: int) -> dict[str, float]:
        weights, target = self.module(samples.points, rest=rest), self.target(samples, rest=rest)
        joint = 0.5 * ((weights - target) @ self.body.weights).abs().sum(-1)
        count = self.body.shape_dirs.shape[-1]
        shape = ((weights - target) @ self.body.shape_dirs.flatten(1)).unflatten(1, (3, count)).norm(dim=1)
        pose = ((weights - target) @ self.corrective).norm(dim=-1)
        diagonal = torch.nn.functional.normalize(torch.ones(3, device=self.device), dim=0)
        beside = samples.points + _STEP * diagonal
        change = 0.5 * ((self.module(beside, rest=rest) - weights) @ self.body.weights).abs().sum(-1)
        return {
            "joint_weight_error_mean": float(joint.mean()),
            "joint_weight_error_p95": float(joint.quantile(0.95)),
            "shape_error_mm_p95": 1e3 * float(shape.quantile(0.95)),
            "pose_error_mm_p95": 1e3 * float(pose.quantile(0.95)),
            "joint_weight_change_per_cm_p99": float(change.quantile(0.99)) * 0.01 / _STEP,
        }

    def _draw(
        self, surface: Float[Tensor, "N 3"], faces: Int[np.ndarray, "F 3"], rng: np.random.Generator
    ) -> Samples:
        """A fifth of the points on the skin, the rest at log-uniform offsets roughly along the normal."""
        count = self.diffusion.samples + _HELD_OUT
        vertices = surface.double().numpy()
        corner = vertices[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        doubled = np.linalg.norm(normal, axis=1)
        face = rng.choice(len(faces), count, p=doubled / doubled.sum())
        point = (corner[face] * rng.dirichlet((1, 1, 1), count)[..., None]).sum(1)
        direction = normal[face] / doubled[face, None] + 0.7 * rng.normal(size=(count, 3))
        offset = np.exp(rng.uniform(np.log(0.003), np.log(self.diffusion.reach), count))
        near = rng.random(count) < 0.2
        offset[near] = rng.uniform(-0.01, 0.01, near.sum())
        point += offset[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        query = ClosestQuery(vertices, SurfaceTopology.build(faces, len(vertices)))
        distance = query(point).height
        width = np.hypot(self.diffusion.base, self.diffusion.growth * distance)
        return Samples(torch.from_numpy(point).float(), torch.from_numpy(width).float())


def train_skin(
    out: Path,
    options: RunOptions,
    *,
    body: Body,
    rest_poses: Sequence[Float[np.ndarray, "24 3"]],
    diffusion: Diffusion | None = None,
    config: SkinFieldConfig | None = None,
) -> RunReport:
    """Train a skin field and write ``skin.safetensors`` into ``out``.

    Args:
        out: Folder; also takes the checkpoint and the history.
        options: Budget and device; a field this small needs about three minutes on one core.
        body: The body whose weights are diffused.
        rest_poses: Every pose in which garments are modelled.
        diffusion: How the weights spread.
        config: Size of the field; its vertex count and poses are replaced by those given here.
    """
    poses = tuple(tuple(float(x) for x in np.asarray(pose).reshape(-1)) for pose in rest_poses)
    config = config or SkinFieldConfig(num_vertices=len(body.template))
    task = SkinTask(
        body, replace(config, num_vertices=len(body.template), rest_poses=poses), diffusion or Diffusion(),
        device=options.device,
    )  # fmt: skip
    report = train(task, out, options)
    provenance = {"steps": report.steps, "seconds": round(report.seconds, 1), "config": dict(task.config)}
    bundle = SkinBundle(
        task.module.cpu(), body_sha256=body.sha256, provenance=provenance, metrics=dict(report.metrics)
    )
    bundle.save(Path(out) / "skin.safetensors")
    return report


def rest_poses_of_categories() -> list[Float[np.ndarray, "24 3"]]:
    """Every rest pose [rad] in which the categories of the package are modelled, the T-pose first."""
    poses = []
    for angle in sorted({category.leg_angle for category in CATEGORIES.values()} | {0.0}):
        pose = np.zeros((NUM_JOINTS, 3))
        pose[JOINT_NAMES.index("left_hip"), 2], pose[JOINT_NAMES.index("right_hip"), 2] = angle, -angle
        poses.append(pose)
    return poses


def _vertex_area(body: Body) -> Float[Tensor, " N"]:
    """A third of the area of the faces around each vertex [m²]."""
    corner = body.template[body.faces]
    doubled = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=-1)
    thirds = (doubled / 6)[:, None].expand(-1, 3).reshape(-1)
    return torch.zeros(len(body.template)).index_add(0, body.faces.reshape(-1), thirds)
