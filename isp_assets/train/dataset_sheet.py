"""A picture of a random sample of training garments: flat panels, and the rest shape from both sides."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from isp_assets.conventions import PANELS
from isp_assets.errors import MissingExtraError
from isp_assets.geometry.closest import unit_face_normals
from isp_assets.train.dataset import GarmentDataset, TrainingGarment

_LIGHT = np.array([0.35, 0.5, 0.8]) / np.linalg.norm([0.35, 0.5, 0.8])
_CLOTH, _SHADE = np.array([0.45, 0.60, 0.92]), 0.35
_VIEWS = {"front": 1.0, "back": -1.0}


def draw_sheet(dataset: GarmentDataset, path: Path, *, count: int = 12, seed: int = 0) -> list[str]:
    """Draw some garments of a data set, a row of three pictures each, two garments abreast.

    Args:
        dataset: One category.
        path: The PNG to write.
        count: Garments to draw, at most.
        seed: Of the choice.

    Returns:
        Names of the garments drawn.

    Raises:
        MissingExtraError: If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "train", "the picture of a data set") from error
    from isp_assets.files import published

    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(dataset.garments), min(count, len(dataset.garments)), replace=False))
    rows = -(-len(chosen) // 2)
    figure = Figure(figsize=(13, 2.3 * rows), layout="constrained")
    grid = figure.subplots(rows, 6, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
        axes.set_aspect("equal")
    for place, index in enumerate(chosen):
        garment = dataset.garments[index]
        flat, front, back = grid[place // 2, 3 * (place % 2) : 3 * (place % 2) + 3]
        flat.set_title(garment.name, fontsize=8)
        for side, style in zip(PANELS, ("-", ":"), strict=True):
            _draw_outline(flat, garment, side, style)
        for axes, sign in zip((front, back), _VIEWS.values(), strict=True):
            _draw_view(axes, garment, sign)
    with published(path) as temporary:
        figure.savefig(temporary, dpi=90, metadata={"Software": None})
    return [dataset.garments[index].name for index in chosen]


def _draw_outline(axes, garment: TrainingGarment, side: str, style: str) -> None:
    """The outline of a panel, a colour a label."""
    from matplotlib.collections import LineCollection

    panel = garment.panels[side]
    for loop in np.unique(panel.outline_loop):
        rows = panel.outline_loop == loop
        points = panel.outline_xy[rows]
        segments = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
        colors = [f"C{label % 10}" for label in panel.outline_label[rows]]
        axes.add_collection(LineCollection(list(segments), colors=colors, linestyles=style, linewidths=1))
    axes.autoscale_view()


def _draw_view(axes, garment: TrainingGarment, sign: float) -> None:
    """The rest shape seen along z, its far faces drawn first."""
    from matplotlib.collections import PolyCollection

    turned = garment.rest_vertices * np.array([sign, 1.0, sign])
    corner = turned[garment.faces]
    order = np.argsort(corner[..., 2].mean(axis=1))
    colors = _shaded(unit_face_normals(turned, garment.faces))
    polygons = PolyCollection(list(corner[order][..., :2]), facecolors=colors[order], edgecolors="face")
    polygons.set_linewidth(0.2)
    axes.add_collection(polygons)
    axes.autoscale_view()


def _shaded(normal: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3"]:
    """Cloth lit from one side; its inside is darker."""
    light = np.abs(normal @ _LIGHT) * np.where(normal[:, 2] > 0, 1.0, 0.55)
    return _CLOTH * (_SHADE + (1 - _SHADE) * light)[:, None]
