"""Easing of stretched cloth: exact cases, invariances, and what must stay as it is."""

import numpy as np
import pytest
import torch
from collision_shapes import grid
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from isp_assets.errors import GeometryError
from isp_assets.geometry.energy import ClothRest, Fabric, cloth_rest
from isp_assets.geometry.grading import face_strain
from isp_assets.geometry.stretch import StretchLimit

COUNT = 9
FACES = grid(COUNT, COUNT)


def _flat() -> np.ndarray:
    axis = np.linspace(0, 0.16, COUNT)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)


def _rest() -> ClothRest:
    return cloth_rest(FACES, _flat()[FACES][..., :2], COUNT**2, Fabric())


def _limit(*, limit: float = 0.05, held: tuple[int, ...] = ()) -> StretchLimit:
    return StretchLimit.build(_rest(), held=np.isin(np.arange(COUNT**2), held), limit=limit)


def _strain(vertices: np.ndarray) -> np.ndarray:
    return face_strain(torch.from_numpy(vertices)[None], _rest())[0].numpy()


@pytest.mark.parametrize("factor", [0.96, 1.0, 1.04])
def test_cloth_within_the_limits_is_returned_as_it_is(factor: float) -> None:
    cloth = factor * _flat()
    assert _limit().ease(cloth, steps=5) is cloth


@pytest.mark.parametrize(("factor", "reached"), [(1.3, 1.05), (0.7, 0.95)])
def test_uniform_stretch_comes_back_to_the_limit(factor: float, reached: float) -> None:
    eased = _limit().ease(factor * _flat(), steps=400)
    width = eased[:, :2].max(0) - eased[:, :2].min(0)
    np.testing.assert_allclose(width, reached * 0.16, rtol=1e-3)
    # Nothing but the faces pulls on it, so its middle stays.
    np.testing.assert_allclose(eased.mean(0), factor * _flat().mean(0), atol=1e-9)


def test_stretch_in_one_direction_leaves_the_other_alone() -> None:
    eased = _limit().ease(_flat() * [1.2, 1.0, 1.0], steps=400)
    width = eased.max(0) - eased.min(0)
    np.testing.assert_allclose(width[:2], [1.05 * 0.16, 0.16], rtol=2e-3)


def test_crumpled_cloth_may_shrink_but_not_stretch() -> None:
    loose = _limit().loosened(np.ones(COUNT**2), least=0.75)
    shrunk = 0.8 * _flat()
    assert loose.ease(shrunk, steps=5) is shrunk
    stretched = loose.ease(1.3 * _flat(), steps=400)
    np.testing.assert_allclose(np.ptp(stretched[:, 0]), 1.05 * 0.16, rtol=1e-3)
    beside = _limit().loosened((np.arange(COUNT**2) < COUNT).astype(float), least=0.75)  # one row of vertices
    half = _limit().loosened(np.full(COUNT**2, 0.5), least=0.75)
    np.testing.assert_allclose(half.least, (0.75 + _limit().least) / 2)
    assert (beside.least == 0.75).sum() == (FACES < COUNT).any(1).sum()
    assert beside.ease(shrunk, steps=1) is not shrunk


def test_more_steps_strain_less() -> None:
    rng = np.random.default_rng(0)
    cloth = _flat() + 0.004 * rng.normal(size=(COUNT**2, 3))
    limit = _limit()
    worst = [_strain(limit.ease(cloth, steps=steps)).max() for steps in (0, 1, 3, 10)]
    assert worst == sorted(worst, reverse=True)
    assert worst[-1] < 0.4 * worst[0]


def test_folds_without_strain_stay() -> None:
    """A sheet rolled to a cylinder is not strained, however much it is bent."""
    flat, radius = _flat(), 0.05
    step = flat[1, 0]
    turn = 2 * np.arcsin(step / (2 * radius))  # chords of a circle keep the length of the edges
    angle = turn * flat[:, 0] / step
    rolled = np.stack([radius * np.sin(angle), flat[:, 1], radius * np.cos(angle)], -1)
    assert _limit().ease(rolled, steps=5) is rolled


def test_held_vertices_stay_where_they_are() -> None:
    held = tuple(range(COUNT))
    cloth = 1.3 * _flat()
    eased = _limit(held=held).ease(cloth, steps=20)
    np.testing.assert_allclose(eased[list(held)], cloth[list(held)], atol=1e-5)
    assert np.abs(eased - cloth).max() > 0.01


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_easing_moves_with_the_scene(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloth = _flat() + 0.003 * rng.normal(size=(COUNT**2, 3))
    turn, shift = Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(size=3)
    limit = _limit()
    there = limit.ease(cloth @ turn.T + shift, steps=3)
    np.testing.assert_allclose(there, limit.ease(cloth, steps=3) @ turn.T + shift, atol=1e-9)


def test_a_folded_over_face_and_a_point_do_no_harm() -> None:
    """Faces without area have no principal axes; nothing may become NaN."""
    assert np.isfinite(_limit().ease(np.zeros((COUNT**2, 3)), steps=3)).all()
    line = _flat() * [1, 0, 0]
    assert np.isfinite(_limit().ease(line, steps=3)).all()


def test_a_negative_limit_is_refused() -> None:
    with pytest.raises(GeometryError, match="limit must be >= 0"):
        _limit(limit=-0.1)
