"""Training of the atlases, with the codes of the garments' patterns held fixed.

The paper compares point clouds by Chamfer distance. Here each panel point's place
on the body is known exactly, so the distance to that place is minimised directly. An
error along the surface leaves the shape as it is and counts less than one across it.

Cloth of one pattern may come to rest in several ways. Codes therefore get further numbers,
the fold codes, which are learnt with the atlases and which the panel fields do not see.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 3-4.
"""

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.bundle import GarmentBundle
from isp_assets.conventions import PANELS
from isp_assets.errors import TrainError
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.train.assemble import assemble_bundle, renew_atlases
from isp_assets.train.atlas_metrics import measure_atlases
from isp_assets.train.atlas_samples import AtlasSamples, network_xy, places
from isp_assets.train.dataset import GarmentDataset
from isp_assets.train.loop import CHECKPOINT, RunOptions, RunReport, read_checkpoint, train
from isp_assets.train.optimizers import LOOKUP, OptimizerName
from isp_assets.train.patterns import dataset_digest
from isp_assets.train.rehearsal import rehearse

FURTHER_RATE = 1e-3
"""Peak learning rate of atlases that are trained already."""


@dataclass(frozen=True)
class AtlasOptions:
    """Networks and losses of the atlas training."""

    width: int = 128
    depth: int = 7
    skip: int | None = 3
    slip_weight: float = 0.35
    """Of an error along the surface, against one across it; corners on seams have no such freedom."""
    normal_weight: float = 0.01
    """lambda_n of Eq. 4."""
    seam_weight: float = 0.5
    """lambda_c of Eq. 4, but of the gap itself: its square, as in the paper, fades before the gap does."""
    fold_size: int = 16
    """Numbers of a fold code; 0 for none. Of new atlases: further training keeps whole codes."""
    fold_weight: float = 3e-5
    """Of a fold code's square [m]; keeps them close together, as lambda_reg of Eq. 2 does codes."""
    fold_rate: float = 2e-3
    rate: float = 3e-3
    optimizer: OptimizerName = "soap"
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


def train_atlas_further(
    dataset: GarmentDataset,
    bundle: GarmentBundle,
    folder: Path,
    *,
    run: RunOptions,
    options: AtlasOptions | None = None,
) -> RunReport:
    """Train a bundle's atlases further, and write the bundle, ``<category>.safetensors``.

    Codes and panel fields stay, and with them the displacements. Garments of the bundle that the dataset
    lacks, or holds in another shape, are trained on as the bundle decodes them.

    Args:
        dataset: The dataset that the bundle was trained on, or a part of it.
        bundle: Where to start.
        folder: Where the new bundle, the checkpoint and the history go.
        run: How long and where to train.
        options: Losses; the networks keep their size.

    Raises:
        TrainError: If ``bundle`` was trained on other garments, or training diverges or cannot resume.
    """
    task = FurtherAtlasTask(dataset, bundle, options or AtlasOptions(rate=FURTHER_RATE), run)
    report = train(task, folder, run)
    new = renew_atlases(task.known, bundle, folder / CHECKPOINT)
    new.save(folder / f"{dataset.category}.safetensors")
    return report


class AtlasNetworks(nn.Module):
    """The atlases of both panels, and the fold codes, if there are any to learn."""

    folds: nn.Parameter | None

    def __init__(self, atlases: Mapping[str, Atlas], num_garments: int, fold_size: int) -> None:
        super().__init__()
        self.atlases = nn.ModuleDict(dict(atlases))
        # They start equal: what tells garments apart is learnt, not drawn.
        folds = nn.Parameter(torch.zeros(num_garments, fold_size)) if fold_size else None
        self.register_parameter("folds", folds)

    def whole(self, codes: Float[Tensor, "G Z"], garment: Tensor | slice) -> Float[Tensor, "g C"]:
        """Whole codes of some garments, given the pattern codes of all."""
        if self.folds is None:
            return codes[garment]
        return torch.cat([codes[garment], self.folds[garment]], dim=1)


class _AtlasTask:
    """Eq. 4 on random garments, triangles and seam vertices.

    Args:
        dataset: Garments to learn from.
        codes: Their codes, without the fold codes that are to be learnt.
        atlases: Networks to train.
        fold_size: Numbers of a fold code.
        options: Losses.
        run: Where to train.
        origin: What the codes come from; a checkpoint must share it.
    """

    def __init__(
        self, dataset: GarmentDataset, codes: Float[Tensor, "G Z"], atlases: Mapping[str, Atlas],
        fold_size: int, options: AtlasOptions, run: RunOptions, origin: Mapping[str, Any],
    ) -> None:  # fmt: skip
        self.name = f"atlas {dataset.category}"
        self.options, self.dataset, self.device = options, dataset, torch.device(run.device)
        self.optimizer = options.optimizer
        self.codes = codes.to(self.device)
        self.module: AtlasNetworks = AtlasNetworks(atlases, len(dataset.garments), fold_size).to(self.device)
        self.config: Mapping[str, Any] = {
            "options": asdict(options),
            "atlas": {side: atlas.config.to_dict() for side, atlas in atlases.items()},
            "category": dataset.category, "garments": len(dataset.garments),
            "dataset_sha256": dataset_digest(dataset), **origin,
        }  # fmt: skip
        self.samples = AtlasSamples(dataset, self.device)

    def parameter_groups(self) -> list[dict[str, Any]]:
        groups = [{"params": list(self.module.atlases.parameters()), "lr": self.options.rate}]
        if self.module.folds is not None:
            groups.append({"params": [self.module.folds], "lr": self.options.fold_rate, **LOOKUP})
        return groups

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        options, count = self.options, len(self.dataset.garments)
        garment = torch.randperm(count, generator=generator)[: options.garments_per_step]
        codes = self.module.whole(self.codes, garment.to(self.device))[:, None]
        seam = self.samples.seams(garment, options.seams_per_step, generator)
        place, normal, sewn = [], [], []
        for side, atlas in self.module.atlases.items():
            corners = self.samples.triangles(side, garment, options.faces_per_step, generator)
            batch = torch.cat([corners.flatten(1, 2), seam[side]], dim=1)
            found = atlas(batch[..., :2], codes)
            on_faces, on_seam = found.split([3 * options.faces_per_step, options.seams_per_step], dim=1)
            faces, true = on_faces.unflatten(1, (-1, 3)), corners[..., 2:]
            off = weigh_slip(faces - true, _normal(true), options.slip_weight).flatten(1, 2)
            place.append(torch.cat([off, on_seam - seam[side][..., 2:]], dim=1).norm(dim=-1).mean())
            cosine = nn.functional.cosine_similarity(_normal(faces), _normal(true), dim=-1)
            normal.append(1 - cosine.mean())
            sewn.append(on_seam)
        folds = codes[..., self.codes.shape[1] :]
        return {
            "fold": options.fold_weight * folds.square().sum(-1).mean(),
            "place": torch.stack(place).sum(),
            "normal": options.normal_weight * torch.stack(normal).sum(),
            "seam": options.seam_weight * (sewn[0] - sewn[1]).norm(dim=-1).mean(),
        }

    def measure(self) -> dict[str, float]:
        chosen = np.unique(np.linspace(0, len(self.dataset.garments) - 1, 12).astype(int))
        codes = self.module.whole(self.codes, slice(None)).detach()
        atlases = dict(self.module.atlases.items())
        return measure_atlases(atlases, codes, self.dataset, garments=chosen.tolist())


class AtlasTask(_AtlasTask):
    """New atlases for the codes of a pattern training."""

    def __init__(
        self, dataset: GarmentDataset, patterns: Path, options: AtlasOptions, run: RunOptions
    ) -> None:
        weights, manifest = read_checkpoint(patterns)
        if manifest["config"].get("dataset_sha256") != dataset_digest(dataset):
            raise TrainError(
                f"{patterns}: these patterns were trained on another dataset; train patterns again"
            )
        torch.manual_seed(run.seed)
        size = weights["codes"].shape[1] + options.fold_size
        atlases = {side: Atlas(_atlas_config(dataset, side, options, size)) for side in PANELS}
        super().__init__(
            dataset, weights["codes"], atlases, options.fold_size, options, run,
            {"patterns_step": manifest["step"]},
        )  # fmt: skip


class FurtherAtlasTask(_AtlasTask):
    """The atlases of a bundle, for the bundle's codes."""

    def __init__(
        self, dataset: GarmentDataset, bundle: GarmentBundle, options: AtlasOptions, run: RunOptions
    ) -> None:
        if bundle.category != dataset.category:
            raise TrainError(f"the bundle holds {bundle.category!r}, the dataset {dataset.category!r}")
        missing = [garment.name for garment in dataset.garments if garment.name not in bundle.codes]
        if missing:
            raise TrainError(
                f"the bundle {bundle.category!r} has no codes for {len(missing)} of the dataset's "
                f"{len(dataset.garments)} {dataset.category!r} garments, {missing[:3]}...; give the dataset "
                "that it was trained on, or train patterns anew"
            )
        atlases = {side: copy.deepcopy(atlas).train() for side, atlas in bundle.model.atlases.items()}
        for atlas in atlases.values():
            atlas.requires_grad_(True)
        one = next(iter(atlases.values())).config
        options = replace(options, width=one.width, depth=one.depth, skip=one.skip)
        # Made again on another machine, a dataset differs in its last bits: its shapes tell, not its digest.
        found = rehearse(dataset, bundle)
        self.known = found.known
        codes = torch.from_numpy(np.stack([bundle.code(garment.name) for garment in found.all.garments]))
        origin = {"bundle_sha256": bundle.model_sha256, "rehearsed": found.rehearsed}
        super().__init__(found.all, codes, atlases, 0, options, run, origin)


def weigh_slip(
    error: Float[Tensor, "*batch 3 3"], normal: Float[Tensor, "*batch 3"], weight: float
) -> Float[Tensor, "*batch 3 3"]:
    """Errors of triangles' corners with the part along the triangle scaled."""
    unit = nn.functional.normalize(normal, dim=-1)[..., None, :]
    across = (error * unit).sum(-1, keepdim=True) * unit
    return across + weight * (error - across)


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
