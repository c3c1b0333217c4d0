"""Frame figures on a synthetic shot whose answers are known, and their summary."""

import json
from dataclasses import replace

import numpy as np
import pytest

from isp_assets.errors import GeometryError
from isp_assets.evaluate.frames import FIGURES, FrameMeter, summarise
from isp_assets.frames import FrameChunk
from isp_assets.geometry.grading import edge_strain
from isp_assets.synthetic import SyntheticShot, synthetic_shot


@pytest.fixture(scope="module")
def shot() -> SyntheticShot:
    return synthetic_shot(frames="1001-1002")


@pytest.fixture(scope="module")
def chunk(shot: SyntheticShot) -> FrameChunk:
    return next(shot.chunks(2))


def _with_layers(chunk: FrameChunk, *layers: np.ndarray) -> FrameChunk:
    return replace(chunk, layers=layers)


def test_clear_layers_have_no_contact(shot: SyntheticShot, chunk: FrameChunk) -> None:
    figures = FrameMeter(shot.scene).measure(chunk, 0)
    for layer in ("L00_vest", "L01_coat"):
        for figure in (
            "body_area_percent",
            "inner_area_percent",
            "crossing_pairs",
            "deepest_mm",
            "flipped_faces",
        ):
            assert figures[f"final/{layer}/{figure}"] == 0, (layer, figure)


def test_every_figure_is_given_for_every_layer_and_explained(shot: SyntheticShot, chunk: FrameChunk) -> None:
    figures = FrameMeter(shot.scene).measure(chunk, 0)
    assert {tuple(key.split("/")) for key in figures} == {
        ("final", layer.name, figure) for layer in shot.scene.layers for figure in FIGURES
    }
    json.dumps(figures, allow_nan=False)


def test_swapped_layers_lie_beneath_one_another(shot: SyntheticShot, chunk: FrameChunk) -> None:
    """The coat drawn in to 1 cm beneath the vest: all of it is on the wrong side, by that depth."""
    vest = chunk.layers[0]
    beneath = vest.copy()
    beneath[..., [0, 2]] -= (
        0.01 * vest[..., [0, 2]] / np.linalg.norm(vest[..., [0, 2]], axis=-1, keepdims=True)
    )
    meter = FrameMeter(shot.scene)
    figures = meter.measure(_with_layers(chunk, vest, beneath), 0)
    assert figures["final/L01_coat/inner_area_percent"] > 75  # the borders are left out
    assert figures["final/L00_vest/inner_area_percent"] == 0
    assert 8 < figures["final/L01_coat/deepest_mm"] < 11


def test_a_layer_drawn_into_the_body_is_inside_it(shot: SyntheticShot, chunk: FrameChunk) -> None:
    vest, coat = chunk.layers
    centre = chunk.body[0].mean(0)
    figures = FrameMeter(shot.scene).measure(_with_layers(chunk, centre + 0.2 * (vest - centre), coat), 0)
    assert figures["final/L00_vest/body_area_percent"] == pytest.approx(100)


def test_stages_are_measured_on_request(shot: SyntheticShot, chunk: FrameChunk) -> None:
    kept = replace(chunk, stages={"skin": chunk.layers})
    meter = FrameMeter(shot.scene)
    plain, staged = meter.measure(kept, 1), meter.measure(kept, 1, stages=True)
    assert not any(key.startswith("skin/") for key in plain)
    assert staged["skin/L01_coat/strain_p99"] == staged["final/L01_coat/strain_p99"]


def test_strain_is_the_stretch_and_blind_to_rigid_motion() -> None:
    lengths = np.array([[1, np.sqrt(2), 1]])
    faces = np.array([[0, 1, 2]])
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    assert np.abs(edge_strain(points @ turn.T + 5, faces, lengths)).max() < 1e-12
    np.testing.assert_allclose(edge_strain(1.1 * points, faces, lengths), 0.1)


def test_strain_is_that_of_the_pattern_as_graded_to_the_wearer(
    shot: SyntheticShot, chunk: FrameChunk
) -> None:
    """Cloth a quarter larger than drawn is strained, unless its pattern was drawn anew for a larger body."""
    vest, count = shot.scene.layers[0], len(chunk.frames)
    rest = np.repeat(vest.garment.rest_vertices[None].astype(np.float32), count, axis=0)
    graded = replace(vest, graded_lengths=1.25 * vest.flat_lengths)
    for layer, size, strain in ((vest, 1, 0), (vest, 1.25, 0.25), (graded, 1.25, 0), (graded, 1, 0.2)):
        meter = FrameMeter(replace(shot.scene, layers=(layer,)))
        figures = meter.measure(_with_layers(chunk, np.float32(size) * rest), 0)
        assert figures["final/L00_vest/strain_p99"] == pytest.approx(strain, abs=0.01)


def test_a_face_folded_over_its_neighbours_is_counted(shot: SyntheticShot, chunk: FrameChunk) -> None:
    vest, coat = chunk.layers
    folded = coat.copy()
    faces = shot.scene.layers[1].garment.faces
    inner = np.flatnonzero(np.bincount(faces.reshape(-1)) == 6)[0]
    neighbour = faces[(faces == inner).any(1)][0]
    other = neighbour[neighbour != inner][0]
    folded[:, inner] = folded[:, other] + 1.6 * (folded[:, other] - folded[:, inner])
    meter = FrameMeter(shot.scene)
    assert meter.measure(_with_layers(chunk, vest, folded), 0)["final/L01_coat/flipped_faces"] > 0


def test_positions_that_are_not_finite_are_refused(shot: SyntheticShot, chunk: FrameChunk) -> None:
    vest, coat = chunk.layers
    broken = coat.copy()
    broken[0, 3] = np.nan
    with pytest.raises(GeometryError, match="L01_coat"):
        FrameMeter(shot.scene).measure(_with_layers(chunk, vest, broken), 0)


def test_summary_has_mean_and_maximum_over_frames() -> None:
    rows = [
        {"frame": 1, "steps": [], "final/L00_a/crossing_pairs": 2.0},
        {"frame": 2, "final/L00_a/crossing_pairs": 4.0, "skin/L00_a/crossing_pairs": 9.0},
    ]
    summary = summarise(rows)
    assert summary["final"]["L00_a"]["crossing_pairs"] == {"mean": 3.0, "max": 4.0, "frames": 2}
    assert summary["skin"]["L00_a"]["crossing_pairs"]["frames"] == 1
    assert summarise([]) == {}
