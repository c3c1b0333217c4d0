"""Garments of a bundle that a dataset lacks, as the bundle itself decodes them.

Networks that are trained further forget what they are no longer shown. A dataset made
again, on another machine or in part, lacks some garments, and may hold others under their names.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from isp_assets.bundle import GarmentBundle
from isp_assets.conventions import PANELS
from isp_assets.errors import DecodeError, TrainError
from isp_assets.train.atlas_metrics import measure_atlases
from isp_assets.train.dataset import GarmentDataset, TrainingGarment, TrainingPanel

_RESOLUTION = 128
_SAME_SHAPE = 10.0  # mean error of a bundle's atlases up to which a garment is the one it was trained on [mm]
_MOST_OTHERS = 0.1  # share of a dataset's garments


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """What to train a bundle further on."""

    known: GarmentDataset
    """The garments of the dataset that the bundle was trained on."""
    all: GarmentDataset
    """These, and the bundle's other garments as it decodes them."""

    @property
    def rehearsed(self) -> list[str]:
        """Names of the garments that the bundle itself gave."""
        return [garment.name for garment in self.all.garments[len(self.known.garments) :]]


def rehearse(dataset: GarmentDataset, bundle: GarmentBundle) -> Rehearsal:
    """Complete a dataset by what a bundle holds beyond it.

    Raises:
        TrainError: If more than a few garments of the dataset are not those the bundle was trained on.
    """
    errors = _errors(dataset, bundle)
    others = [name for name, error in errors.items() if error > _SAME_SHAPE]
    if len(others) > _MOST_OTHERS * len(errors):
        raise TrainError(
            f"the bundle {bundle.category!r} misses {len(others)} of the dataset's {len(errors)} garments by "
            f"more than {_SAME_SHAPE:g} mm, as {others[:3]}: they are other garments of the same names; give "
            "the dataset that it was trained on, or train patterns anew"
        )
    known = tuple(garment for garment in dataset.garments if garment.name not in others)
    names = {garment.name for garment in known}
    decoded = tuple(_decoded(dataset, bundle, [name for name in bundle.codes if name not in names]))
    return Rehearsal(replace(dataset, garments=known), replace(dataset, garments=known + decoded))


def _errors(dataset: GarmentDataset, bundle: GarmentBundle) -> dict[str, float]:
    """Mean error of the bundle's atlases by garment [mm]."""
    names = [garment.name for garment in dataset.garments]
    codes, atlases = torch.from_numpy(np.stack([bundle.code(name) for name in names])), bundle.model.atlases
    return {
        name: measure_atlases(atlases, codes, dataset, garments=[index])["vertex_mm"]
        for index, name in enumerate(names)
    }


def _decoded(dataset: GarmentDataset, bundle: GarmentBundle, names: list[str]) -> Iterator[TrainingGarment]:
    for name in names:
        try:
            garment = bundle.decode(name, resolution=_RESOLUTION)
        except DecodeError:  # what the bundle cannot show cannot be forgotten
            continue
        panels = {}
        for side in PANELS:
            panel = garment.panels[side]
            # Atlases learn from triangles alone: outlines are left empty.
            panels[side] = TrainingPanel(
                xy=panel.panel_xy.astype(np.float64),
                faces=panel.faces,
                vertex_index=panel.vertex_index,
                outline_xy=np.empty((0, 2)),
                outline_label=np.empty(0, np.int64),
                outline_loop=np.empty(0, np.int64),
            )
        yield TrainingGarment(
            name=name, category=dataset.category, panels=panels,
            rest_vertices=garment.rest_vertices.astype(np.float64), anchors=garment.anchors,
            parameters={}, metrics={},
        )  # fmt: skip
