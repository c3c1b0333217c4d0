"""Cutting an outline into labelled edges: crisp corners, noise, slivers."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from isp_assets.geometry.edge_runs import EdgeRun, dissolve, join_alike, split_edges
from isp_assets.geometry.outline import resample_closed

CORNERS = np.array([[-0.5, -0.6], [0.55, -0.6], [0.4, 0.5], [-0.3, 0.7]])
STEP = 2 / 256


def _polygon(offset: float = 0.0):
    """A quadrilateral sampled from somewhere on its first side, and logits of its labels 1 to 4."""
    start = CORNERS[0] + (0.2 + offset) * (CORNERS[1] - CORNERS[0])
    outline = np.concatenate([[start], CORNERS[1:], CORNERS[:1]])
    length = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).sum()
    points = resample_closed(outline, round(length / STEP))
    ends = np.roll(CORNERS, -1, axis=0)
    along = ends - CORNERS
    share = (((points[:, None] - CORNERS) * along).sum(-1) / (along**2).sum(-1)).clip(0, 1)
    distance = np.linalg.norm(points[:, None] - CORNERS - share[..., None] * along, axis=-1)
    return points, np.concatenate([np.full((len(points), 1), 9.0), -200 * distance], axis=1)


def _check(runs: tuple[EdgeRun, ...], tolerance: float) -> None:
    assert sorted(run.label for run in runs) == [1, 2, 3, 4]
    for run, following in zip(runs, runs[1:] + runs[:1], strict=True):
        assert following.label == run.label % 4 + 1
        np.testing.assert_array_equal(run.points[-1], following.points[0])
        np.testing.assert_allclose(run.points[0], CORNERS[run.label - 1], atol=tolerance)
        steps = np.linalg.norm(np.diff(run.points, axis=0), axis=1)
        assert steps.min() > 0.1 * STEP


@given(st.integers(0, 600))
@settings(max_examples=30, deadline=None)
def test_corners_are_exact_wherever_the_samples_fall(offset):
    """Samples straddle every corner; the lines through both sides meet in it."""
    _check(split_edges(*_polygon(offset / 1000)), 1e-9)


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_noise_in_the_labels_moves_no_corner(seed):
    points, logits = _polygon()
    noisy = logits + np.random.default_rng(seed).normal(0, 3.0, logits.shape)
    _check(split_edges(points, noisy), 1e-9)


@given(st.integers(0, 1000), st.integers(1, 3), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_a_short_stretch_of_a_wrong_label_is_noise(start, length, label):
    """Two points anywhere; three not next to a corner, where they belong to the edge beyond it."""
    points, logits = _polygon()
    rows = (start + np.arange(length)) % len(points)
    away = np.linalg.norm(points[rows, None] - CORNERS, axis=2).min()
    assume(length < 3 or away > 8 * STEP)
    logits[rows] = 0.0
    logits[rows, label] = 50.0
    _check(split_edges(points, logits), 1e-9)


def test_rounded_corners_are_sharpened():
    """A contour cuts corners; one cut by less than a sample's step comes back."""
    points, logits = _polygon()
    blunt = (np.roll(points, 1, axis=0) + 2 * points + np.roll(points, -1, axis=0)) / 4
    _check(split_edges(blunt, logits), 1e-9)


def test_a_smooth_meeting_point_stays_where_the_labels_change():
    angle = np.arange(400) * 2 * np.pi / 400 + 0.01
    points = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    y = 100 * points[:, 1]
    runs = split_edges(points, np.stack([0 * y, y, -y], axis=1))
    assert [run.label for run in runs] == [1, 2]
    np.testing.assert_allclose(runs[0].points[0], [0.5, 0.0], atol=1e-4)
    np.testing.assert_allclose(runs[1].points[0], [-0.5, 0.0], atol=1e-4)


def test_sharp_corners_split_a_run_of_one_label():
    """The tip of a V-neck stays sharp though the label does not change there."""
    points, logits = _polygon()
    logits[:, 2] = np.maximum(logits[:, 2], logits[:, 3])
    logits[:, 3] = -999
    runs = split_edges(points, logits)
    assert sorted(run.label for run in runs) == [1, 2, 2, 4]
    for corner in CORNERS:
        assert min(np.linalg.norm(run.points[0] - corner) for run in runs) < 1e-9
    joined = join_alike(runs, {2})
    assert sorted(run.label for run in joined) == [1, 2, 4]
    assert sum(run.length for run in joined) == pytest.approx(sum(run.length for run in runs))
    assert join_alike(runs, {1}) == runs


def test_one_label_gives_one_closed_run():
    angle = np.arange(300) * 2 * np.pi / 300
    points = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    (run,) = split_edges(points, np.array([[0.0, -9.0, 5.0]]).repeat(300, axis=0))
    assert run.label == 2
    np.testing.assert_array_equal(run.points[0], run.points[-1])
    assert len(run.points) == len(points) + 1


def test_a_polygon_of_one_label_is_joined_to_one_closed_run():
    points, logits = _polygon()
    logits[:, 2] += 1000
    runs = split_edges(points, logits)
    assert [run.label for run in runs] == [2, 2, 2, 2]
    (run,) = join_alike(runs, {2})
    np.testing.assert_array_equal(run.points[0], run.points[-1])


def test_turning_the_samples_round_changes_nothing():
    points, logits = _polygon()
    runs = split_edges(points, logits)
    turned = split_edges(np.roll(points, 57, axis=0), np.roll(logits, 57, axis=0))
    by_label = {run.label: run.points for run in turned}
    for run in runs:
        np.testing.assert_allclose(by_label[run.label], run.points, atol=1e-12)


def test_dissolving_gives_a_run_to_its_longer_neighbour():
    square = [
        EdgeRun(k, np.array([[0.0, 0.0], [length, 0.0]])) for k, length in ((1, 5.0), (2, 0.1), (3, 2.0))
    ]
    runs = dissolve(tuple(square), 1)
    assert sorted(run.label for run in runs) == [1, 3]
    assert {run.label: len(run.points) for run in runs} == {1: 3, 3: 2}


def test_dissolving_into_a_chosen_neighbour():
    loop = tuple(
        EdgeRun(k, np.array([[0.0, 0.0], [length, 0.0]])) for k, length in ((1, 5.0), (2, 0.1), (3, 2.0))
    )
    assert {run.label: len(run.points) for run in dissolve(loop, 1, label=3)} == {1: 2, 3: 3}
    assert {run.label: len(run.points) for run in dissolve(loop, 1, label=8)} == {1: 3, 3: 2}


def test_dissolving_between_equal_labels_joins_them():
    ends = [[0.0, 0.0], [1.0, 0.0], [1.1, 0.0], [2.0, 0.0], [1.0, 3.0]]
    labels = [1, 2, 1, 3, 4]
    loop = tuple(EdgeRun(label, np.array([ends[k], ends[(k + 1) % 5]])) for k, label in enumerate(labels))
    runs = dissolve(loop, 1)
    assert sorted(run.label for run in runs) == [1, 3, 4]
    joined = next(run for run in runs if run.label == 1)
    np.testing.assert_array_equal(joined.points, ends[:4])


def test_a_lone_run_cannot_be_dissolved():
    loop = (EdgeRun(1, np.zeros((2, 2))),)
    assert dissolve(loop, 0) is loop
