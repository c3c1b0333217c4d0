"""Fewer fixed maps for a displacement network: the combinations that its displacements use most.

What the network gives is ``c M``: coefficients times maps. Over the coefficients of many
poses, a truncated singular value decomposition gives the closest product with fewer
maps; both factors stay linear in the old ones, so network and maps are replaced exactly.
"""

import copy
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle
from isp_assets.drape_features import drape_features
from isp_assets.errors import TrainError
from isp_assets.networks.drape_field import DrapeField
from isp_assets.train.poses import BETA_RANGE, PoseSource, draw_poses, load_clips

_POSES = 40  # a garment
_GARMENTS = 50


def keep_fewer_maps(bundle: GarmentBundle, count: int, *, seed: int = 0) -> tuple[GarmentBundle, float]:
    """The bundle with ``count`` fixed maps, fit to be trained further.

    Returns:
        The bundle, and the share of the mean square displacement that is lost.

    Raises:
        TrainError: If the bundle has no displacement network, or not that many maps.
    """
    field = bundle.drape_field
    if field is None or not 0 < count <= field.config.basis:
        have = 0 if field is None else field.config.basis
        raise TrainError(f"bundle {bundle.category!r} has {have} displacement maps; cannot keep {count}")
    fewer, lost = truncated(field, usual_coefficients(bundle, field, seed=seed), count)
    # The old figures are those of the old network; training it further gives new ones.
    metrics = {name: value for name, value in bundle.metrics.items() if name != "drape"}
    notes = {**bundle.provenance, "fewer_maps": {"kept": count, "lost": lost}}
    return replace(bundle, drape_field=fewer, metrics=metrics, provenance=notes), lost


@torch.no_grad()
def usual_coefficients(bundle: GarmentBundle, field: DrapeField, *, seed: int) -> Float[Tensor, "N K"]:
    """Coefficients of the network over random poses, body shapes and garments of the bundle."""
    body = Body.load(bundle.body_name)
    clips = list(load_clips(PoseSource()).train.values())
    generator = torch.Generator().manual_seed(seed)
    codes = torch.stack([torch.from_numpy(code).float() for code in bundle.codes.values()])
    rows = []
    for index in torch.linspace(0, len(codes) - 1, min(_GARMENTS, len(codes))).long().tolist():
        betas = BETA_RANGE * (2 * torch.rand(field.config.num_betas, generator=generator) - 1)
        posed = body.pose(draw_poses(clips, _POSES, generator), betas=betas)
        features = drape_features(posed, betas, codes[index], num_betas=field.config.num_betas)
        rows.append(field.coefficients(features))
    return torch.cat(rows)


@torch.no_grad()
def truncated(field: DrapeField, coefficients: Float[Tensor, "N K"], count: int) -> tuple[DrapeField, float]:
    """The network with the best ``count`` maps for some coefficients, and the share of squares lost."""
    basis = field.maps()[0].flatten(1).double()
    moment = (coefficients.double().T @ coefficients.double()) / len(coefficients)
    values, axes = torch.linalg.eigh(moment)
    root = (axes * values.clamp_min(0).sqrt()).T  # root.T @ root = moment
    left, spread, right = torch.linalg.svd(root @ basis, full_matrices=False)
    kept = slice(0, count)
    lost = float(1 - (spread[kept] ** 2).sum() / (spread**2).sum())
    # New maps are combinations of the old ones, right = to_new @ basis; c becomes c @ (basis @ right.T).
    size = spread[kept].clamp_min(1e-12)[:, None]
    to_new = (left.T[kept] @ root) / size
    to_coefficients = basis @ right[kept].T
    scale = to_coefficients.norm(dim=0).clamp_min(1e-12)  # keeps coefficients of the size that training knows
    scale = scale / (basis.norm(dim=1).mean() * len(basis) ** 0.5 / count**0.5)
    config = replace(field.config, basis=count)
    result, state = DrapeField(config), copy.deepcopy(field.state_dict())
    for name in ("coarse", "fine"):
        if name in state:
            old = state[name].double()
            fresh = torch.einsum("nk,kcyx->ncyx", to_new * scale[:, None], old[:-1])
            state[name] = torch.cat([fresh, old[-1:]]).float()
    last = f"mlp.layers.{field.config.depth - 1}."
    mix = (to_coefficients / scale).T
    state[last + "weight"] = (mix @ state[last + "weight"].double()).float()
    state[last + "bias"] = (mix @ state[last + "bias"].double()).float()
    result.load_state_dict(state)
    return result.eval().requires_grad_(False), lost
