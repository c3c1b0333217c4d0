"""From two checkpoints to a garment bundle, with its provenance and its measured errors."""

import copy
import platform
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

import isp_assets
from isp_assets.bundle import GarmentBundle, Precision
from isp_assets.conventions import PANELS
from isp_assets.errors import TrainError
from isp_assets.garment_model import GarmentModel
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig
from isp_assets.train.atlas_metrics import measure_atlases
from isp_assets.train.dataset import GarmentDataset
from isp_assets.train.loop import read_checkpoint
from isp_assets.train.pattern_metrics import measure_fields


def assemble_bundle(
    dataset: GarmentDataset, patterns: Path, atlases: Path, *, body_name: str = "default",
    dtype: Precision = "float16",
) -> GarmentBundle:  # fmt: skip
    """Make a bundle of trained networks, rounded to the precision it will be stored at, and measure it.

    Args:
        dataset: The dataset that both were trained on.
        patterns: Checkpoint of the pattern training.
        atlases: Checkpoint of the atlas training.
        body_name: Name of the body, for people.
        dtype: Precision of the stored weights.

    Returns:
        The bundle. Its metrics hold "patterns" and "atlas" at the stored precision, the same under
        "float32" before rounding, and under "codes" how the latent codes spread.

    Raises:
        BundleError: If a checkpoint cannot be read.
        TrainError: If the two checkpoints do not belong together.
    """
    pattern_weights, pattern_manifest = read_checkpoint(patterns)
    maps, folds, atlas_manifest = _read_atlases(atlases)
    _check_pair(patterns, pattern_manifest, atlases, atlas_manifest)
    field_config = PanelFieldConfig.from_dict(pattern_manifest["config"]["field"])
    fields = {
        side: blind_to_folds(
            _load(PanelField(field_config), pattern_weights, f"fields.{side}."), folds.shape[1]
        )
        for side in PANELS
    }
    model = GarmentModel(
        category=dataset.category, panel_fields=fields, atlases=maps, edge_names=dict(dataset.edge_names),
        seam_pairs=tuple(dataset.seam_pairs), anchor_labels=tuple(dataset.anchor_labels),
        rest_pose=dataset.rest_pose, panel_center=dataset.panel_center, panel_scale=dataset.panel_scale,
    )  # fmt: skip
    codes = torch.cat([pattern_weights["codes"], folds], dim=1).numpy()
    stored = model if dtype == "float32" else _rounded(model)
    metrics = measure_model(stored, codes, dataset) | {"codes": _spread(codes)}
    if stored is not model:
        metrics["float32"] = measure_model(model, codes, dataset)
    return GarmentBundle(
        stored, {garment.name: code for garment, code in zip(dataset.garments, codes, strict=True)},
        dataset.body_sha256, body_name, metrics=metrics,
        provenance=_provenance(pattern_manifest, atlas_manifest),
    )  # fmt: skip


def renew_atlases(dataset: GarmentDataset, bundle: GarmentBundle, atlases: Path) -> GarmentBundle:
    """The bundle with its atlases replaced by those of a checkpoint, at 16 bits, and these measured anew.

    Args:
        dataset: The dataset that the atlases were trained on.
        bundle: Codes, panel fields and whatever else stays.
        atlases: Checkpoint of atlases trained for the bundle's codes.

    Raises:
        BundleError: If the checkpoint cannot be read.
    """
    maps, _, manifest = _read_atlases(atlases)
    model = replace(bundle.model, atlases=maps)
    stored = _rounded(model)
    codes = np.stack([bundle.code(garment.name) for garment in dataset.garments])
    notes = _run_notes(manifest) | {
        "dataset_sha256": manifest["config"]["dataset_sha256"],
        "rehearsed": manifest["config"].get("rehearsed", []),
        "earlier": bundle.provenance.get("atlas", {}),
    }
    table, every = torch.from_numpy(codes), range(len(dataset.garments))
    unrounded, rounded = (
        {"atlas": measure_atlases(one.atlases, table, dataset, garments=every)} for one in (model, stored)
    )
    return replace(
        bundle, model=stored, provenance={**bundle.provenance, "atlas": notes},
        metrics={**bundle.metrics, **rounded, "float32": {**bundle.metrics.get("float32", {}), **unrounded}},
    )  # fmt: skip


def measure_model(model: GarmentModel, codes: np.ndarray, dataset: GarmentDataset) -> dict[str, Any]:
    """Errors of the pattern networks over every garment of a dataset."""
    every, table = range(len(dataset.garments)), torch.from_numpy(codes)
    return {
        "patterns": measure_fields(model.panel_fields, table, dataset, garments=every),
        "atlas": measure_atlases(model.atlases, table, dataset, garments=every),
    }


def _check_pair(patterns: Path, first: Mapping[str, Any], atlases: Path, second: Mapping[str, Any]) -> None:
    for key, one, two in (
        ("dataset", first["config"]["dataset_sha256"], second["config"]["dataset_sha256"]),
        ("step of the patterns", first["step"], second["config"]["patterns_step"]),
    ):
        if one != two:
            raise TrainError(
                f"{atlases} was trained on another {key} ({two}) than {patterns} has ({one}); "
                "train the atlas again"
            )


def blind_to_folds(field: PanelField, fold_size: int) -> PanelField:
    """A panel field that takes fold codes after the code, and ignores them."""
    if not fold_size:
        return field
    config = replace(field.config, code_size=field.config.code_size + fold_size)
    state = field.state_dict()
    for branch in ("shared", "distance", "label"):  # the code is the last input of each
        weight = state[f"{branch}.layers.0.weight"]
        state[f"{branch}.layers.0.weight"] = nn.functional.pad(weight, (0, fold_size))
    return _load(PanelField(config), state, "")


def _read_atlases(path: Path) -> tuple[dict[str, Atlas], Float[torch.Tensor, "G F"], dict[str, Any]]:
    """The atlases of a checkpoint by panel, the fold codes learnt with them, and its manifest."""
    weights, manifest = read_checkpoint(path)
    configs = {side: AtlasConfig.from_dict(manifest["config"]["atlas"][side]) for side in PANELS}
    maps = {side: _load(Atlas(configs[side]), weights, f"atlases.{side}.") for side in PANELS}
    return maps, weights.get("folds", torch.zeros(manifest["config"]["garments"], 0)), manifest


def _load(network: Any, weights: Mapping[str, torch.Tensor], prefix: str) -> Any:
    network.load_state_dict(
        {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}
    )
    return network.eval().requires_grad_(False)


def _rounded(model: GarmentModel) -> GarmentModel:
    """The model with 16-bit weights, in 32-bit arithmetic."""

    def rounded(networks: Mapping[str, nn.Module]) -> dict[str, Any]:
        copies = {side: copy.deepcopy(network) for side, network in networks.items()}
        for network in copies.values():
            for parameter in network.parameters():
                parameter.copy_(parameter.half())
        return copies

    with torch.no_grad():
        return replace(model, panel_fields=rounded(model.panel_fields), atlases=rounded(model.atlases))


def _spread(codes: np.ndarray) -> dict[str, Any]:
    """Mean and spread of the codes, for whoever draws codes at random."""
    radius = np.linalg.norm(codes - codes.mean(0), axis=1)
    return {
        "mean": codes.mean(0).tolist(),
        "std": codes.std(0).tolist(),
        "radius_mean": float(radius.mean()),
        "radius_max": float(radius.max()),
    }


def _provenance(patterns: Mapping[str, Any], atlas: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "dataset_sha256": patterns["config"]["dataset_sha256"],
        "patterns": _run_notes(patterns),
        "atlas": _run_notes(atlas),
        "versions": {
            "isp_assets": isp_assets.__version__, "torch": torch.__version__, "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }  # fmt: skip


def _run_notes(manifest: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("seed", "step", "seconds", "device", "threads")
    return {key: manifest.get(key) for key in keys} | {"options": manifest["config"]["options"]}
