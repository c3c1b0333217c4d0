"""Panel maps: exact on linear maps, adjoint to their gradient, drawn only inside the panels."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.panel_map import PanelSampler

LINEAR = torch.tensor([[0.3, -1.0, 0.2], [0.0, 2.0, 1.0], [0.5, 0.5, -0.7]])  # rows: 1, x, y


def _grid_panel(n: int, half: float) -> tuple[np.ndarray, np.ndarray]:
    axis = np.linspace(-half, half, n)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    return np.stack([x, y], -1).reshape(-1, 2), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _sampler(resolution: int = 32, half: float = 0.71, n: int = 9) -> tuple[PanelSampler, np.ndarray]:
    """Two equal squares sewn along x = -half; also the panel coordinates of every vertex."""
    xy, faces = _grid_panel(n, half)
    back = np.arange(n * n) + n * n
    back[:n] = np.arange(n)
    back = np.where(back >= n * n, back - n, back)
    sampler = PanelSampler.build([xy, xy], [faces, faces], [np.arange(n * n), back], resolution=resolution)
    return sampler, np.concatenate([xy, xy[n:]])


def _linear_maps(resolution: int) -> torch.Tensor:
    centre = (2 * torch.arange(resolution) + 1) / resolution - 1
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    basis = torch.stack([torch.ones_like(x), x, y], -1)
    return (basis @ LINEAR).permute(2, 0, 1).repeat(2, 1, 1)


def _linear_values(xy: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.concatenate([np.ones((len(xy), 1)), xy], 1), dtype=torch.float32) @ LINEAR


def test_sampling_is_exact_on_linear_maps() -> None:
    sampler, xy = _sampler()
    assert torch.allclose(sampler.sample(_linear_maps(32)), _linear_values(xy), atol=1e-5)


def test_rasterising_is_exact_on_linear_values_inside_and_zero_outside() -> None:
    sampler, xy = _sampler()
    drawn = sampler.rasterise(_linear_values(xy))
    inside = sampler.inside.repeat_interleave(3, 0)
    assert torch.allclose(drawn[inside], _linear_maps(32)[inside], atol=1e-5)
    assert torch.equal(drawn[~inside], torch.zeros_like(drawn[~inside]))


def test_inside_counts_every_centre_once_even_on_shared_edges() -> None:
    # With half = 0.75 and R = 32, texel centres fall on no panel edge, but many on triangle diagonals.
    sampler, _ = _sampler(half=0.75)
    centre = (2 * np.arange(32) + 1) / 32 - 1
    expected = (np.abs(centre) <= 0.75).sum() ** 2
    assert sampler.inside.sum(dim=(1, 2)).tolist() == [expected, expected]


def test_sewn_points_average_both_panels() -> None:
    sampler, xy = _sampler()
    maps = torch.cat([torch.ones(3, 32, 32), torch.full((3, 32, 32), 3.0)])
    value = sampler.sample(maps)[:, 0]
    on_seam = torch.tensor(np.isclose(xy[:, 0], -0.71))
    on_seam[81:] = False
    assert torch.allclose(value[on_seam], torch.tensor(2.0))
    assert torch.allclose(value[:81][~on_seam[:81]], torch.tensor(1.0))
    assert torch.allclose(value[81:], torch.tensor(3.0))


def test_round_trip_error_falls_with_resolution() -> None:
    errors = []
    for resolution in (16, 32, 64):
        sampler, xy = _sampler(resolution, half=0.8, n=129)
        smooth = torch.tensor(np.sin(3 * xy[:, :1] + 2 * xy[:, 1:]).repeat(3, 1), dtype=torch.float32)
        again = sampler.sample(sampler.rasterise(smooth))
        interior = torch.tensor((np.abs(xy) < 0.7).all(1))
        errors.append(float((again - smooth)[interior].abs().max()))
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(8, 40))
def test_batch_shape_and_linearity(batch: int, resolution: int) -> None:
    sampler, _ = _sampler(resolution)
    maps = torch.randn(batch, 2, 6, resolution, resolution)
    value = sampler.sample(maps)
    assert value.shape == (batch, 2, sampler.num_vertices, 3)
    assert torch.allclose(sampler.sample(maps[0] - 2 * maps[-1]), value[0] - 2 * value[-1], atol=1e-5)
    drawn = sampler.rasterise(value)
    assert drawn.shape == maps.shape
    assert torch.allclose(drawn[0, 1], sampler.rasterise(value[0, 1]))


def test_gradients_reach_exactly_the_sampled_texels() -> None:
    sampler, _ = _sampler()
    maps = torch.zeros(6, 32, 32, requires_grad=True)
    sampler.sample(maps).sum().backward()
    assert maps.grad is not None
    assert torch.isclose(maps.grad.sum(), torch.tensor(3.0 * sampler.num_vertices))
    assert not maps.grad[:, 0].any()
    assert maps.grad[:, 16, 16].all()


def test_bad_inputs_are_refused() -> None:
    xy, faces = _grid_panel(3, 1.2)
    index = np.arange(9)
    with pytest.raises(GeometryError, match=r"\[-1, 1\]"):
        PanelSampler.build([xy, xy], [faces, faces], [index, index], resolution=8)
    with pytest.raises(GeometryError, match="expected 2 panels"):
        PanelSampler.build([xy], [faces], [index], resolution=8)
    sampler, _ = _sampler()
    with pytest.raises(GeometryError, match=r"\[6, 32, 32\]"):
        sampler.sample(torch.zeros(6, 16, 16))
