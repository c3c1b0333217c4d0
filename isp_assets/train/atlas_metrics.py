"""How close atlases come to the rest shapes they were trained on."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.conventions import PANELS
from isp_assets.train.atlas_samples import network_xy, places, seam_indices
from isp_assets.train.dataset import GarmentDataset


def measure_atlases(
    atlases: Mapping[str, nn.Module], codes: Float[Tensor, "G Z"], dataset: GarmentDataset, *,
    garments: Sequence[int],
) -> dict[str, float]:  # fmt: skip
    """Errors over all vertices of some garments [mm].

    Returns:
        ``vertex_mm``, ``vertex_p95_mm``, ``vertex_max_mm``: distance from the place of each panel point;
        ``seam_mm``, ``seam_p95_mm``: gap between the panels at seam vertices, before sewing closes it.
    """
    errors, gaps = [], []
    for index in garments:
        garment, found = dataset.garments[index], {}
        for side in PANELS:
            xy = torch.as_tensor(network_xy(dataset, garment, side), dtype=codes.dtype, device=codes.device)
            with torch.no_grad():
                found[side] = atlases[side](xy, codes[index]).cpu().numpy()
            errors.append(np.linalg.norm(found[side] - places(garment, side), axis=1))
        seam = seam_indices(garment)
        gaps.append(np.linalg.norm(found["front"][seam["front"]] - found["back"][seam["back"]], axis=1))
    error, gap = 1000 * np.concatenate(errors), 1000 * np.concatenate(gaps)
    return {
        "vertex_mm": float(error.mean()),
        "vertex_p95_mm": float(np.quantile(error, 0.95)),
        "vertex_max_mm": float(error.max()),
        "seam_mm": float(gap.mean()),
        "seam_p95_mm": float(np.quantile(gap, 0.95)),
    }
