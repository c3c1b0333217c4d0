"""Eq. 5 in float64, on trained networks: against finite differences, and against the zero level itself."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from isp_assets.collection import Collection
from isp_assets.decode import SLIVER, border_slopes, cut_panels, lift_points, weld_points
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.sewing import SewnPanels, sew_panels

RESOLUTION = 32


def in_double(model: GarmentModel) -> GarmentModel:
    def doubled(networks):
        return {side: copy.deepcopy(network).double() for side, network in networks.items()}

    return replace(model, panel_fields=doubled(model.panel_fields), atlases=doubled(model.atlases))


@pytest.fixture(scope="module", params=["top.safetensors", "skirt.safetensors"])
def garment(request) -> tuple[GarmentModel, SewnPanels, Tensor]:
    bundle = Collection.load("default").bundle(request.param)
    code = list(bundle.codes.values())[1]
    cut = cut_panels(bundle.model, code, resolution=RESOLUTION)
    sewn = sew_panels(cut.outlines, bundle.model.seam_pairs, spacing=2 / RESOLUTION, sliver=SLIVER)
    return in_double(bundle.model), sewn, torch.from_numpy(code).double()


def chosen(sewn: SewnPanels, count: int = 6) -> dict[str, np.ndarray]:
    """Some vertices inside the panels, on open borders, and on seams."""
    on_border = np.zeros(sewn.num_vertices, bool)
    for panel in sewn.panels.values():
        on_border[panel.vertex_index[panel.border_label > 0]] = True
    on_seam = np.zeros(sewn.num_vertices, bool)
    for seam in sewn.seams:
        on_seam[sewn.panels["front"].vertex_index[seam.front]] = True
    kinds = {"inside": ~on_border, "border": on_border & ~on_seam, "seam": on_seam}
    rows = {name: np.flatnonzero(kind) for name, kind in kinds.items()}
    return {name: every[:: max(1, len(every) // count)][:count] for name, every in rows.items()}


@pytest.mark.parametrize("kind", ["inside", "border", "seam"])
def test_gradients_agree_with_finite_differences(garment, kind):
    model, sewn, code = garment
    rows = torch.from_numpy(chosen(sewn)[kind])
    assert len(rows) >= 5

    def vertices(z: Tensor) -> Tensor:
        return weld_points(sewn, lift_points(model, sewn, z, border=border_slopes(model, sewn, code)))[rows]

    start = (code + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(vertices, start, eps=1e-6, atol=1e-7, rtol=1e-4)
    gradient = torch.autograd.functional.jacobian(vertices, start)
    assert (gradient.abs().amax(dim=(1, 2)) > 1e-3).all(), "every vertex follows the code"


@pytest.mark.parametrize("side", ["front", "back"])
def test_border_points_stay_on_the_zero_level(garment, side):
    """The border is found again for codes on both sides, and its lift differenced: the gradient of Eq. 5."""
    model, sewn, code = garment
    panel, field, atlas = sewn.panels[side], model.panel_fields[side], model.atlases[side]
    border = np.flatnonzero(panel.border_label)
    start = torch.from_numpy(panel.points[border])
    direction = torch.randn(len(code), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = 1e-4

    def on_level(z: Tensor, xy: Tensor, normal: Tensor, level: Tensor) -> Tensor:
        for _ in range(8):  # Newton along the border's normal
            x = xy.detach().requires_grad_()
            value = field.signed_distance(x, z)
            (slope,) = torch.autograd.grad(value.sum(), x)
            along = (slope * normal).sum(-1)
            xy = (x - normal * ((value - level) / along)[:, None]).detach()
        return xy

    x = start.clone().requires_grad_()
    level = field.signed_distance(x, code)
    (normal,) = torch.autograd.grad(level.sum(), x)
    steep = normal.norm(dim=-1) > 0.5
    normal, level = normal / normal.norm(dim=-1, keepdim=True), level.detach()
    with torch.no_grad():
        ends = []
        for sign in (-1, 1):
            z = code + sign * step * direction
            with torch.enable_grad():
                xy = on_level(z, start, normal, level)
            ends.append(atlas(xy, z))
        expected = (ends[1] - ends[0]) / (2 * step)

    slopes = border_slopes(model, sewn, code)

    def lifted(z: Tensor) -> Tensor:
        return lift_points(model, sewn, z, border=slopes)[side][torch.from_numpy(border)]

    _, found = torch.autograd.functional.jvp(lifted, code, direction)
    error = (found - expected).norm(dim=-1)[steep] / expected.norm(dim=-1).mean()
    assert steep.double().mean() > 0.9
    # Where the outline has a corner the zero level bends within the step.
    assert error.median() < 1e-3
    assert error.quantile(0.9) < 2e-2


def test_without_a_cut_code_the_outline_stays(garment):
    model, sewn, code = garment
    moved = lift_points(model, sewn, code + 0.02, border=border_slopes(model, sewn, code))
    kept = lift_points(model, sewn, code + 0.02)
    for side, panel in sewn.panels.items():
        inside = torch.from_numpy(panel.border_label == 0)
        torch.testing.assert_close(moved[side][inside], kept[side][inside])
        assert (moved[side][~inside] - kept[side][~inside]).abs().max() > 1e-4
