"""Draping: chunks, symmetries, and what the report of steps says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import STEPS, DrapeOptions, drape
from isp_assets.errors import DrapeError
from isp_assets.evaluate.frames import FrameMeter
from isp_assets.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from isp_assets.motion import Motion
from isp_assets.outfit import Outfit
from isp_assets.shot import Shot

NETWORKS = ("skin", "displace", "layering")
QUICK = DrapeOptions(resolution=40)


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load("default")


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Collection.load("default").outfit(["tank_top", "trousers", "open_jacket"])


@pytest.fixture(scope="module")
def shot(body: Body) -> Shot:
    return Shot("test", body, Motion.load("walk").select(FrameRange(10, 15)))


def positions(outfit: Outfit, shot: Shot, options: DrapeOptions) -> list[np.ndarray]:
    chunks = list(drape(outfit, shot, options))
    return [np.concatenate([c.layers[k] for c in chunks]) for k in range(len(outfit))]


def turned(shot: Shot, angle: float, offset: np.ndarray) -> Shot:
    """The same motion, turned about the vertical through the origin and moved."""
    motion, yaw = shot.motion, torch.tensor([0.0, angle, 0.0])
    turn = axis_angle_to_matrix(yaw)
    root = matrix_to_axis_angle(turn @ axis_angle_to_matrix(torch.as_tensor(motion.poses[:, 0])))
    poses = motion.poses.copy()
    poses[:, 0] = root.numpy()
    pelvis = shot.body.pose(torch.zeros(1, 24, 3)).joints[0, 0].numpy()
    matrix = turn.numpy()
    translation = (motion.translation + pelvis) @ matrix.T - pelvis + offset
    return replace(shot, motion=replace(motion, poses=poses, translation=translation.astype(np.float32)))


def test_all_rungs_give_finite_layers_in_order(outfit: Outfit, shot: Shot) -> None:
    draped = drape(outfit, shot, QUICK)
    assert [layer.name for layer in draped.scene.layers] == [
        "L00_tank_top",
        "L01_trousers",
        "L02_open_jacket",
    ]
    frames = []
    for chunk in draped:
        frames += chunk.frames.tolist()
        for layer, vertices in zip(draped.scene.layers, chunk.layers, strict=True):
            assert vertices.shape == (len(chunk.frames), layer.garment.num_vertices, 3)
            assert np.isfinite(vertices).all()
        assert all("displace" in steps for frame in chunk.steps for steps in frame)
    assert frames == list(range(10, 16))


def test_chunk_size_does_not_matter(outfit: Outfit, shot: Shot) -> None:
    one = positions(outfit, shot, replace(QUICK, chunk=1, steps=NETWORKS))
    many = positions(outfit, shot, replace(QUICK, chunk=4, steps=NETWORKS))
    for a, b in zip(one, many, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_heading_and_place_do_not_matter(outfit: Outfit, shot: Shot) -> None:
    angle, offset = 2.1, np.array([3.0, 0.0, -2.0])
    here = positions(outfit, shot, replace(QUICK, steps=NETWORKS))
    there = positions(outfit, turned(shot, angle, offset), replace(QUICK, steps=NETWORKS))
    matrix = axis_angle_to_matrix(torch.tensor([0.0, angle, 0.0])).numpy()
    for a, b in zip(here, there, strict=True):
        difference = np.linalg.norm(a @ matrix.T + offset - b, axis=-1)
        # A vertex between two equally near samples may take either: a rare, small difference.
        assert np.quantile(difference, 0.99) < 1e-4
        assert difference.max() < 5e-3


def test_steps_can_be_left_out_and_say_so(outfit: Outfit, shot: Shot) -> None:
    options = replace(QUICK, steps=("skin",), keep_stages=True)
    (chunk,) = list(drape(outfit, shot, options))
    assert all(steps == ("skin",) for frame in chunk.steps for steps in frame)
    for skinned, final in zip(chunk.stages["skin"], chunk.layers, strict=True):
        np.testing.assert_array_equal(skinned, final)


def test_stages_are_kept_on_request_only(outfit: Outfit, shot: Shot) -> None:
    (chunk,) = list(drape(outfit, shot, QUICK))
    assert chunk.stages == {}
    (chunk,) = list(drape(outfit, shot, replace(QUICK, keep_stages=True)))
    assert set(chunk.stages) == set(STEPS) - {"relax"}


def test_projection_moves_nothing_far(outfit: Outfit, shot: Shot) -> None:
    (chunk,) = list(drape(outfit, shot, replace(QUICK, keep_stages=True)))
    for before, after in zip(chunk.stages["layering"], chunk.layers, strict=True):
        assert np.linalg.norm(after - before, axis=-1).max() < 0.08


def test_a_tucked_shirt_stays_in_the_trousers_when_the_hips_bend(body: Body) -> None:
    """A hand's breadth into the built-in squat the hem stays beneath, and does not blow the trousers up."""
    outfit = Collection.load("default").outfit(["long_sleeved_shirt", "trousers"])
    motion = Motion.load("squat")
    depth = motion.translation[0, 1] - motion.translation[:, 1]
    frame = int(motion.frames[np.argmax(depth > 0.1)])
    draped = drape(
        outfit, Shot("squat", body, motion.select(FrameRange(frame, frame))), DrapeOptions(resolution=64)
    )
    figures = FrameMeter(draped.scene).measure(next(iter(draped)), 0)
    assert figures["final/L01_trousers/inner_area_percent"] < 0.1
    assert figures["final/L01_trousers/strain_p99"] < 0.3


def test_wrong_options_and_body(outfit: Outfit, shot: Shot) -> None:
    with pytest.raises(DrapeError, match="steps must be some of skin, displace, tuck, layering, project"):
        DrapeOptions(steps=("displace",))
    with pytest.raises(DrapeError, match="chunk must be at least 1"):
        DrapeOptions(chunk=0)
    with pytest.raises(DrapeError, match="smoothing"):
        DrapeOptions(smoothing=1.0)
    with pytest.raises(DrapeError, match=r"strain must be \.1 to \.5, got 0\.05"):
        DrapeOptions(strain=0.05)
    other = replace(shot, body=replace(shot.body, sha256="0" * 64))
    with pytest.raises(DrapeError, match="is not the body that the outfit"):
        drape(outfit, other)


def test_smoothing_lowers_the_jerk_that_projection_adds(outfit: Outfit, shot: Shot) -> None:
    def jerk(smoothing: float) -> float:
        layers = positions(outfit, shot, replace(QUICK, smoothing=smoothing))
        return float(np.mean([np.square(np.diff(layer, n=3, axis=0)).mean() for layer in layers]))

    assert jerk(0.75) < jerk(0.0)
