"""Training of the atlases, with the garments' codes held fixed.

The paper compares point clouds by Chamfer distance. Here each panel point's place
on the body is known exactly, so the distance to that place is minimised directly.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 3-4.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.conventions import PANELS
from isp_assets.errors import TrainError
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.train.assemble import assemble_bundle
from isp_assets.train.atlas_metrics import measure_atlases
from isp_assets.train.atlas_samples import AtlasSamples, network_xy, places
from isp_assets.train.dataset import GarmentDataset
from isp_assets.train.loop import CHECKPOINT, RunOptions, RunReport, read_checkpoint, train
from isp_assets.train.patterns import dataset_digest


@dataclass(frozen=True)
class AtlasOptions:
    """Networks and losses of the atlas training."""

    width: int = 128
    depth: int = 7
    skip: int | None = 3
    normal_weight: float = 0.01
    """lambda_n of Eq. 4."""
    seam_weight: float = 0.5
    """lambda_c of Eq. 4, but of the gap itself: its square, as in the paper, fades before the gap does."""
    rate: float = 1.5e-3
    garments_per_step: int = 24
    faces_per_step: int = 24
    """Triangles a garment and panel; all three corners are evaluated."""
    seams_per_step: int = 24
    """Seam vertices a garment."""


def train_atlas(
    dataset: GarmentDataset,
    patterns: Path,
    folder: Path,
    *,
    run: RunOptions,
    options: AtlasOptions | None = None,
) -> RunReport:
    """Train the atlases of a category, and write its bundle, ``<category>.safetensors``.

    Args:
        dataset: The dataset that the patterns were trained on.
        patterns: Checkpoint of the pattern training; its codes are used as they are.
        folder: Where the bundle, the checkpoint and the history go.
        run: How long and where to train.
        options: Networks and losses.

    Raises:
        BundleError: If ``patterns`` cannot be read.
        TrainError: If ``patterns`` belongs to another dataset, or training diverges or cannot resume.
    """
    report = train(AtlasTask(dataset, patterns, options or AtlasOptions(), run), folder, run)
    bundle = assemble_bundle(dataset, patterns, folder / CHECKPOINT)
    bundle.save(folder / f"{dataset.category}.safetensors")
    return report


class AtlasTask:
    """Eq. 4 on random garments, triangles and seam vertices."""

    def __init__(
        self, dataset: GarmentDataset, patterns: Path, options: AtlasOptions, run: RunOptions
    ) -> None:
        weights, manifest = read_checkpoint(patterns)
        digest = dataset_digest(dataset)
        if manifest["config"].get("dataset_sha256") != digest:
            raise TrainError(
                f"{patterns}: these patterns were trained on another dataset; train patterns again"
            )
        self.name = f"atlas {dataset.category}"
        self.options, self.dataset, self.device = options, dataset, torch.device(run.device)
        self.codes = weights["codes"].to(self.device)
        torch.manual_seed(run.seed)
        configs = {side: _atlas_config(dataset, side, options, self.codes.shape[1]) for side in PANELS}
        self.module = nn.ModuleDict({side: Atlas(config) for side, config in configs.items()}).to(self.device)
        self.config: Mapping[str, Any] = {
            "options": asdict(options), "atlas": {side: config.to_dict() for side, config in configs.items()},
            "category": dataset.category, "dataset_sha256": digest, "patterns_step": manifest["step"],
        }  # fmt: skip
        self.samples = AtlasSamples(dataset, self.device)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.module.parameters()), "lr": self.options.rate}]

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        options, count = self.options, len(self.dataset.garments)
        garment = torch.randperm(count, generator=generator)[: options.garments_per_step]
        codes = self.codes[garment.to(self.device)][:, None]
        seam = self.samples.seams(garment, options.seams_per_step, generator)
        place, normal, sewn = [], [], []
        for side, atlas in self.module.items():
            corners = self.samples.triangles(side, garment, options.faces_per_step, generator)
            batch = torch.cat([corners.flatten(1, 2), seam[side]], dim=1)
            found = atlas(batch[..., :2], codes)
            place.append((found - batch[..., 2:]).norm(dim=-1).mean())
            on_faces, on_seam = found.split([3 * options.faces_per_step, options.seams_per_step], dim=1)
            faces = on_faces.unflatten(1, (-1, 3))
            cosine = nn.functional.cosine_similarity(_normal(faces), _normal(corners[..., 2:]), dim=-1)
            normal.append(1 - cosine.mean())
            sewn.append(on_seam)
        return {
            "place": torch.stack(place).sum(),
            "normal": options.normal_weight * torch.stack(normal).sum(),
            "seam": options.seam_weight * (sewn[0] - sewn[1]).norm(dim=-1).mean(),
        }

    def measure(self) -> dict[str, float]:
        chosen = np.unique(np.linspace(0, len(self.dataset.garments) - 1, 12).astype(int))
        return measure_atlases(dict(self.module.items()), self.codes, self.dataset, garments=chosen.tolist())


def _atlas_config(dataset: GarmentDataset, side: str, options: AtlasOptions, code_size: int) -> AtlasConfig:
    """The network's size, and the affine map that fits all garments best."""
    xy = np.concatenate([network_xy(dataset, garment, side) for garment in dataset.garments])
    place = np.concatenate([places(garment, side) for garment in dataset.garments])
    fitted, *_ = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), place, rcond=None)
    rows = [[float(np.float32(v)) for v in row] for row in fitted.T]
    return AtlasConfig(
        code_size=code_size, width=options.width, depth=options.depth, skip=options.skip,
        offset=(rows[0][2], rows[1][2], rows[2][2]), slope=tuple((row[0], row[1]) for row in rows),
    )  # fmt: skip


def _normal(triangles: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Normals of triangles, not of unit length; tiny triangles are scaled up so that float32 holds them."""
    first, second, third = (1000 * triangles).unbind(-2)
    return torch.linalg.cross(second - first, third - first)
