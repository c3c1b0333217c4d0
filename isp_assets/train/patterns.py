"""Training of the panel fields and the latent codes, jointly (an auto-decoder).

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 1-2.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.conventions import PANELS
from isp_assets.errors import DatasetError
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig
from isp_assets.train.dataset import GarmentDataset, TrainingPanel
from isp_assets.train.loop import RunOptions, RunReport, train
from isp_assets.train.optimizers import LOOKUP, OptimizerName
from isp_assets.train.pattern_metrics import measure_fields
from isp_assets.train.sampling import Outline, SamplingOptions, sample_panel


@dataclass(frozen=True)
class PatternOptions:
    """Networks and losses of the pattern training."""

    code_size: int = 32
    code_spread: float = 0.01
    """Standard deviation of the random numbers that codes start from; what is left of them is noise."""
    width: int = 128
    depths: tuple[int, int, int] = (3, 6, 4)
    """Layers: shared, then of the distance branch, and of the label branch."""
    label_weight: float = 0.01
    """lambda_CE of Eq. 2."""
    code_weight: float = 1e-4
    """lambda_reg of Eq. 2; keeps codes close together, so that what lies between them is a garment too."""
    optimizer: OptimizerName = "soap"
    field_rate: float = 3e-3
    code_rate: float = 2e-3
    garments_per_step: int = 24
    points_per_step: int = 96
    """Points a garment and panel. Many small steps beat few large ones, by far."""
    sampling: SamplingOptions = field(default_factory=SamplingOptions)

    def field_config(self, num_labels: int) -> PanelFieldConfig:
        shared, distance, label = self.depths
        return PanelFieldConfig(
            num_labels, self.code_size, self.width, shared_depth=shared, distance_depth=distance,
            label_depth=label,
        )  # fmt: skip


def train_patterns(
    dataset: GarmentDataset, folder: Path, *, run: RunOptions, options: PatternOptions | None = None
) -> RunReport:
    """Train the panel fields of a category and a code for each of its garments.

    The result is the checkpoint in ``folder``; ``train_atlas`` makes a bundle of it.

    Raises:
        DatasetError: If the dataset holds no garment or a broken outline.
        TrainError: If training diverges or cannot resume.
    """
    return train(PatternTask(dataset, options or PatternOptions(), run), folder, run)


class PatternNetworks(nn.Module):
    """A panel field for each panel, and the codes that they share."""

    def __init__(self, config: PanelFieldConfig, num_garments: int, code_spread: float) -> None:
        super().__init__()
        self.fields = nn.ModuleDict({side: PanelField(config) for side in PANELS})
        self.codes = nn.Parameter(code_spread * torch.randn(num_garments, config.code_size))


class PatternTask:
    """Eq. 2 on random garments and points."""

    def __init__(self, dataset: GarmentDataset, options: PatternOptions, run: RunOptions) -> None:
        if not dataset.garments:
            raise DatasetError(f"category {dataset.category!r}: the dataset holds no garment")
        self.name = f"patterns {dataset.category}"
        self.options, self.dataset, self.device = options, dataset, torch.device(run.device)
        self.optimizer = options.optimizer
        torch.manual_seed(run.seed)
        config = options.field_config(max(dataset.edge_names))
        self.module: PatternNetworks = PatternNetworks(config, len(dataset.garments), options.code_spread).to(
            self.device
        )
        self.config: Mapping[str, Any] = {
            "options": asdict(options), "field": config.to_dict(), "category": dataset.category,
            "garments": [garment.name for garment in dataset.garments],
            "dataset_sha256": dataset_digest(dataset),
        }  # fmt: skip
        self.samples = _sample_dataset(dataset, options.sampling, run.seed, self.device)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [
            {"params": list(self.module.fields.parameters()), "lr": self.options.field_rate},
            {"params": [self.module.codes], "lr": self.options.code_rate, **LOOKUP},
        ]

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        options = self.options
        count = len(self.dataset.garments)
        size = (min(options.garments_per_step, count), options.points_per_step)
        garment = torch.randperm(count, generator=generator)[: size[0]].to(self.device)
        codes = self.module.codes[garment]
        distance, label = [], []
        for side, field_ in self.module.fields.items():
            points = torch.randint(options.sampling.points, size, generator=generator).to(self.device)
            batch = self.samples[side][garment[:, None], points]
            found, logits = field_(batch[..., :2], codes[:, None])
            distance.append((found - batch[..., 2]).abs().mean())
            label.append(nn.functional.cross_entropy(logits.flatten(0, 1), batch[..., 3].long().flatten()))
        return {
            "distance": torch.stack(distance).sum(),
            "label": options.label_weight * torch.stack(label).sum(),
            "code": options.code_weight * codes.square().sum(-1).mean(),
        }

    def measure(self) -> dict[str, float]:
        chosen = np.unique(np.linspace(0, len(self.dataset.garments) - 1, 8).astype(int)).tolist()
        fields = dict(self.module.fields.items())
        return measure_fields(fields, self.module.codes.detach(), self.dataset, garments=chosen)


def panel_outline(dataset: GarmentDataset, panel: TrainingPanel) -> Outline:
    """The border of a panel in network units."""
    xy = (panel.outline_xy - dataset.panel_center) / dataset.panel_scale
    return Outline.from_loops(xy, panel.outline_loop, panel.outline_label)


def dataset_digest(dataset: GarmentDataset) -> str:
    """SHA-256 of all that training reads of a dataset."""
    digest = hashlib.sha256(f"{dataset.category} {dataset.panel_scale!r}".encode())
    for garment in dataset.garments:
        digest.update(garment.name.encode())
        digest.update(np.ascontiguousarray(garment.rest_vertices).tobytes())
        for panel in garment.panels.values():
            for array in (panel.xy, panel.faces, panel.outline_xy, panel.outline_label):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _sample_dataset(
    dataset: GarmentDataset, options: SamplingOptions, seed: int, device: torch.device
) -> dict[str, Float[Tensor, "G N 4"]]:
    """By panel: x, y, signed distance and label of every sample of every garment."""
    rng = np.random.default_rng(seed)
    result = {}
    for side in PANELS:
        rows = []
        for garment in dataset.garments:
            found = sample_panel(panel_outline(dataset, garment.panels[side]), options, rng)
            rows.append(np.column_stack([found.xy, found.distance, found.label]).astype(np.float32))
        result[side] = torch.from_numpy(np.stack(rows)).to(device)
    return result
