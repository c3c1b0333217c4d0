"""Training of the baseline: the field and a code for each garment, jointly (an auto-decoder).

Run:  PYTHONPATH=tests python -m bench.udf.train --data DIR --category top --out DIR --minutes 30
"""

import argparse
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench.udf.field import UdfConfig, UdfField, distance_errors
from bench.udf.samples import UdfSamplingOptions, points_on, rest_mesh, sample_distances, unit_box
from torch import Tensor, nn

from isp_assets.train.dataset import GarmentDataset, load_dataset
from isp_assets.train.loop import RunOptions, RunReport, train
from isp_assets.train.optimizers import LOOKUP, OptimizerName
from isp_assets.train.patterns import dataset_digest


@dataclass(frozen=True)
class UdfOptions:
    """Network and losses of the baseline."""

    code_size: int = 32
    width: int = 128
    depth: int = 7
    output: str = "hypot"
    """How distances are made: "hypot", or "sigmoid" as in DrapeNet."""
    border_weight: float = 0.5
    """Of the part of the distance that leads beyond the border; for "hypot"."""
    gradient_weight: float = 0.0
    """Of the angle between the field's gradient and the true one."""
    code_weight: float = 1e-4
    optimizer: OptimizerName = "adam"
    field_rate: float = 1.5e-3
    code_rate: float = 2e-3
    garments_per_step: int = 24
    points_per_step: int = 192
    """Points a garment."""
    sampling: UdfSamplingOptions = field(default_factory=UdfSamplingOptions)


class UdfNetworks(nn.Module):
    """The field, and the codes of the garments."""

    def __init__(self, config: UdfConfig, num_garments: int) -> None:
        super().__init__()
        self.field = UdfField(config)
        self.codes = nn.Parameter(0.1 * torch.randn(num_garments, config.code_size))


class UdfTask:
    """Clipped distances, and if wished their gradients, at random points of random garments."""

    def __init__(self, dataset: GarmentDataset, options: UdfOptions, run: RunOptions) -> None:
        self.name = f"udf {dataset.category}"
        self.options, self.dataset, self.device = options, dataset, torch.device(run.device)
        self.optimizer = options.optimizer
        torch.manual_seed(run.seed)
        center, scale = unit_box(dataset)
        config = UdfConfig(
            center, scale, code_size=options.code_size, width=options.width, depth=options.depth,
            output=options.output,
        )  # fmt: skip
        self.module: UdfNetworks = UdfNetworks(config, len(dataset.garments)).to(self.device)
        self.config: Mapping[str, Any] = {
            "options": asdict(options), "field": config.to_dict(), "category": dataset.category,
            "garments": [garment.name for garment in dataset.garments],
            "dataset_sha256": dataset_digest(dataset),
        }  # fmt: skip
        self.samples = self._sample(np.random.default_rng(run.seed)).to(self.device)

    def _sample(self, rng: np.random.Generator) -> Tensor:
        field_ = self.module.field
        meshes = [rest_mesh(garment) for garment in self.dataset.garments]
        meshes = [(field_.to_network(vertices), faces) for vertices, faces in meshes]
        each = -(-field_.config.num_places // len(meshes))
        places = np.concatenate([points_on(mesh, each, rng) for mesh in meshes])
        places = rng.permutation(places)[: field_.config.num_places]
        field_.places.copy_(torch.from_numpy(places))
        rows = [sample_distances(mesh, places, self.options.sampling, rng) for mesh in meshes]
        return torch.stack(rows)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [
            {"params": list(self.module.field.parameters()), "lr": self.options.field_rate},
            {"params": [self.module.codes], "lr": self.options.code_rate, **LOOKUP},
        ]

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        options = self.options
        count, available = self.samples.shape[:2]
        size = (min(options.garments_per_step, count), options.points_per_step)
        garment = torch.randperm(count, generator=generator)[: size[0]].to(self.device)
        points = torch.randint(available, size, generator=generator).to(self.device)
        codes = self.module.codes[garment]
        batch = self.samples[garment[:, None], points]
        return {
            **field_losses(self.module.field, batch, codes[:, None], options),
            "code": options.code_weight * codes.square().sum(-1).mean(),
        }

    def measure(self) -> dict[str, float]:
        """Errors near the surface [mm], and how much is taken for a surface that is far from it.

        What the field says on the surface becomes its ``floor``.
        """
        field_, codes = self.module.field, self.module.codes
        chosen = np.unique(np.linspace(0, len(codes) - 1, 12).astype(int)).tolist()
        batch = self.samples[chosen, :4000]
        clip = field_.config.clip
        true, found = batch[..., 3].clamp(max=clip), field_(batch[..., :3], codes[chosen, None])
        on, near = true < 1e-5, true < 0.02
        field_.floor.copy_(found[on].median())
        millimetres = 1000 * field_.config.scale
        return {
            "near_mm": millimetres * float((found - true)[near].abs().mean()),
            "surface_mm": millimetres * float(found[on].mean()),
            "surface_p95_mm": millimetres * float(found[on].quantile(0.95)),
            "ghost_percent": 100 * float((found < 0.25 * true)[true > 0.02].double().mean()),
        }


def field_losses(field_: UdfField, batch: Tensor, codes: Tensor, options: UdfOptions) -> dict[str, Tensor]:
    """Loss terms at samples [G, N, 8], as ``sample_distances`` gives them, for codes [G, 1, code_size]."""
    clip = field_.config.clip
    points, true, direction, border = batch[..., :3], batch[..., 3], batch[..., 4:7], batch[..., 7]
    if options.gradient_weight:
        points = points.clone().requires_grad_()
    found, beyond = field_.parts(points, codes)
    terms = {"distance": distance_errors(found, true, clip).mean()}
    if field_.config.output == "hypot":
        terms["border"] = options.border_weight * ((beyond - border).abs() * (true < clip)).mean()
    if options.gradient_weight:
        (gradient,) = torch.autograd.grad(found.sum(), points, create_graph=True)
        cosine = nn.functional.cosine_similarity(gradient, direction, dim=-1, eps=1e-4)
        near = (true < clip) & (true > 1e-3)
        terms["gradient"] = options.gradient_weight * (1 - cosine)[near].mean()
    return terms


def train_udf(
    dataset: GarmentDataset, folder: Path, *, run: RunOptions, options: UdfOptions | None = None
) -> RunReport:
    """Train the baseline; the result is the checkpoint in ``folder``."""
    return train(UdfTask(dataset, options or UdfOptions(), run), folder, run)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--category", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--width", type=int, default=UdfOptions.width)
    parser.add_argument("--output", choices=("hypot", "sigmoid"), default=UdfOptions.output)
    parser.add_argument("--optimizer", choices=("adam", "soap"), default=UdfOptions.optimizer)
    parser.add_argument("--rate", type=float, default=UdfOptions.field_rate)
    parser.add_argument("--gradient-weight", type=float, default=UdfOptions.gradient_weight)
    given = parser.parse_args()
    run = RunOptions(
        steps=given.steps, minutes=given.minutes, seed=given.seed, device=given.device, resume=given.resume
    )
    options = UdfOptions(
        width=given.width, output=given.output, gradient_weight=given.gradient_weight,
        optimizer=given.optimizer, field_rate=given.rate,
    )  # fmt: skip
    report = train_udf(load_dataset(given.data, given.category), given.out, run=run, options=options)
    figures = "  ".join(f"{name} {value:.3f}" for name, value in report.metrics.items())
    print(f"{report.steps} steps in {report.seconds:.0f} s: {figures}")


if __name__ == "__main__":
    main()
