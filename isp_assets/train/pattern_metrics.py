"""How close panel fields come to the patterns they were trained on."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.train.dataset import GarmentDataset
from isp_assets.train.sampling import Outline

_GRID = 96
_BORDER_POINTS = 1000
_NEAR, _CLOSE = 0.1, 0.03


def measure_fields(
    fields: Mapping[str, nn.Module],
    codes: Float[Tensor, "G Z"],
    dataset: GarmentDataset,
    *,
    garments: Sequence[int],
) -> dict[str, float]:
    """Mean errors over some garments, both panels.

    Returns:
        ``distance_mm``: mean error of the signed distance nearer than 0.1 network units to the border;
        ``border_mm``, ``border_p95_mm``: size of the field at exact border points, which is how far the
        border moved; ``iou``: overlap of the insides; ``label_accuracy``: share of right labels nearer than
        0.03 units; ``border_label_accuracy``: the same on the border itself.
    """
    axis = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(0)
    rows = []
    for index in garments:
        for side, panel in dataset.garments[index].panels.items():
            xy = (panel.outline_xy - dataset.panel_center) / dataset.panel_scale
            outline = Outline.from_loops(xy, panel.outline_loop, panel.outline_label)
            rows.append(_measure_panel(fields[side], codes[index], outline, grid, rng))
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    metric = {name: value * dataset.panel_scale * 1000 for name, value in mean.items() if name.endswith("mm")}
    return mean | metric


def _measure_panel(
    field: nn.Module, code: Float[Tensor, " Z"], outline: Outline, grid: Float[np.ndarray, "n 2"],
    rng: np.random.Generator,
) -> dict[str, float]:  # fmt: skip
    """Figures of one panel; lengths still in network units."""
    border = outline.draw(_BORDER_POINTS, rng)
    close = outline.draw(_BORDER_POINTS, rng) + rng.uniform(-_CLOSE, _CLOSE, (_BORDER_POINTS, 2))
    points = np.concatenate([grid, border, close])
    true, true_label = outline.distance(points)
    with torch.no_grad():
        distance, logits = field(torch.as_tensor(points, dtype=code.dtype, device=code.device), code)
    distance, label = distance.cpu().numpy(), logits.argmax(-1).cpu().numpy()
    on_grid, on_border = slice(0, len(grid)), slice(len(grid), len(grid) + _BORDER_POINTS)
    near, at_border = np.abs(true) < _NEAR, np.abs(distance[on_border])
    inside, truly_inside = distance[on_grid] < 0, true[on_grid] < 0
    right = label == true_label
    return {
        "distance_mm": np.abs(distance - true)[near].mean(),
        "border_mm": at_border.mean(),
        "border_p95_mm": np.quantile(at_border, 0.95),
        "iou": (inside & truly_inside).sum() / max((inside | truly_inside).sum(), 1),
        "label_accuracy": right[len(grid) + _BORDER_POINTS :].mean(),
        "border_label_accuracy": right[on_border].mean(),
    }
