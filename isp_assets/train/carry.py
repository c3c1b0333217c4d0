"""Carry a displacement network over to a bundle whose pattern networks were trained anew.

New training gives every garment a new code, which the old network does not know. A
linear map from new codes to old ones, fitted on the garments that both bundles hold, is
folded into the network's weights: for those garments it gives what it gave, and further
training starts from there instead of from nothing.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.bundle import GarmentBundle
from isp_assets.errors import TrainError
from isp_assets.garment_clouds import GarmentClouds
from isp_assets.networks.drape_field import DrapeField

_SAME = 0.005  # mean distance below which two garments of one name are one garment [m]
_FEWEST = 8
_RIDGES = np.logspace(-4, 2, 25)


@dataclass(frozen=True, eq=False)
class CodeMap:
    """``old = matrix @ new + offset``."""

    matrix: Float[np.ndarray, "Z_old Z_new"]
    offset: Float[np.ndarray, " Z_old"]
    unexplained: float
    """Share of the old codes' variance that it misses on garments left out of the fit."""


def carry_displacement(old: GarmentBundle, new: GarmentBundle) -> GarmentBundle:
    """The new bundle with the old one's displacement network; as it is where the codes are the same.

    Raises:
        TrainError: If the old bundle has no such network, or the two share too few garments.
    """
    if old.drape_field is None:
        raise TrainError(f"the old bundle {old.category!r} has no displacement network to carry over")
    if _same_codes(old, new):  # the atlas alone was trained further
        notes = {key: old.provenance[key] for key in ("drape", "carried") if key in old.provenance}
        metrics = {**new.metrics, "drape": old.metrics.get("drape", {})}
        return replace(
            new, drape_field=old.drape_field, provenance={**new.provenance, **notes}, metrics=metrics
        )
    names = shared_garments(old, new)
    if len(names) < _FEWEST:
        raise TrainError(
            f"the bundles share {len(names)} garments of {old.category!r}, expected at least {_FEWEST}; "
            "train the displacements anew"
        )
    found = fit_code_map(*(np.stack([b.codes[name] for name in names]).astype(float) for b in (old, new)))
    scale = float(1 / max(np.stack(list(new.codes.values())).std(), 1e-6))
    earlier = dict(old.provenance.get("drape", {}))
    notes = {"garments": len(names), "unexplained": found.unexplained, "earlier": earlier}
    return replace(
        new,
        drape_field=recoded(old.drape_field, found, code_scale=scale),
        provenance={**new.provenance, "carried": notes},
    )


def _same_codes(old: GarmentBundle, new: GarmentBundle) -> bool:
    return list(old.codes) == list(new.codes) and all(
        np.array_equal(code, new.codes[name]) for name, code in old.codes.items()
    )


def shared_garments(old: GarmentBundle, new: GarmentBundle) -> list[str]:
    """Names of garments that have the same name and rest shape in both bundles."""
    names = [name for name in old.codes if name in new.codes]
    clouds = [
        GarmentClouds.build(b.model, np.stack([b.codes[n] for n in names])) for b in (old, new) if names
    ]
    same = []
    for name, *pair in zip(names, *(c.points for c in clouds), strict=True):
        if all(map(len, pair)) and GarmentClouds((pair[0],)).distances(pair[1])[0] < _SAME:
            same.append(name)
    return same


def fit_code_map(old: Float[np.ndarray, "G Z_old"], new: Float[np.ndarray, "G Z_new"]) -> CodeMap:
    """Ridge regression; its weight is that with the least error on garments left out one by one."""
    center = [codes.mean(axis=0) for codes in (old, new)]
    y, x = old - center[0], new - center[1]
    left, spread, right = np.linalg.svd(x, full_matrices=False)
    best: tuple[float, Float[np.ndarray, " k"]] = (np.inf, spread)
    for ridge in _RIDGES * (spread**2).mean():
        kept = spread**2 / (spread**2 + ridge)
        residual = y - left @ (kept[:, None] * (left.T @ y))
        leverage = (left**2) @ kept + 1 / len(x)
        error = float(((residual / np.maximum(1 - leverage, 1e-6)[:, None]) ** 2).sum() / (y**2).sum())
        if error < best[0]:
            best = (error, spread / (spread**2 + ridge))
    matrix = ((right.T * best[1]) @ (left.T @ y)).T
    return CodeMap(matrix, center[0] - matrix @ center[1], best[0])


def recoded(field: DrapeField, code_map: CodeMap, *, code_scale: float) -> DrapeField:
    """A network that gives for a new code what ``field`` gives for the old code of the map; exact."""
    config = replace(field.config, code_size=code_map.matrix.shape[1], code_scale=code_scale)
    result = DrapeField(config)
    state = copy.deepcopy(field.state_dict())
    matrix = torch.from_numpy(code_map.matrix).float() * (field.config.code_scale / code_scale)
    offset = torch.from_numpy(code_map.offset).float() * field.config.code_scale
    width = field.config.code_size
    for layer in {0, config.skip} - {None}:
        weight, bias = (state[f"mlp.layers.{layer}.{name}"] for name in ("weight", "bias"))
        head, tail = weight.split([weight.shape[1] - width, width], dim=1)
        state[f"mlp.layers.{layer}.weight"] = torch.cat([head, tail @ matrix], dim=1)
        state[f"mlp.layers.{layer}.bias"] = bias + tail @ offset
    result.load_state_dict(state)
    return result.eval().requires_grad_(False)
