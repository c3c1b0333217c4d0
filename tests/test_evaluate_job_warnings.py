"""Warnings of a job: frames beyond the criteria, betas and poses beyond the training."""

from dataclasses import replace

import numpy as np
import pytest

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.evaluate import job_warnings as module
from isp_assets.evaluate.criteria import CRITERIA
from isp_assets.evaluate.frames import FIGURES
from isp_assets.evaluate.job_warnings import frame_list, job_warnings
from isp_assets.evaluate.trained_range import joint_angles, trained_angles
from isp_assets.motion import Motion
from isp_assets.shot import Shot
from isp_assets.synthetic import synthetic_shot


@pytest.fixture(autouse=True)
def _limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of the test's own: those of training change with its poses."""
    limits = np.full(24, 130.0)
    limits[0] = 60
    monkeypatch.setattr(module, "trained_angles", lambda: limits)


@pytest.fixture(scope="module")
def shot() -> Shot:
    return Shot("walk", Body.load(), Motion.load("walk"))


@pytest.fixture(scope="module")
def layers():
    return synthetic_shot().scene.layers


def row(frame: int, **figures: float) -> dict:
    return {"frame": frame} | {f"final/L01_coat/{name}": value for name, value in figures.items()}


def test_a_good_job_has_no_warnings(shot, layers):
    assert job_warnings([row(1, strain_p99=0.35, body_area_percent=0.1)], layers, shot) == []


def test_figures_beyond_their_limit_name_layer_and_frames(shot, layers):
    rows = [row(f, strain_p99=0.5 if f in (3, 4, 7) else 0.1) for f in range(1, 9)]
    (warning,) = job_warnings(rows, layers, shot)
    assert (warning["kind"], warning["worst"], warning["limit"]) == ("figure", 0.5, 0.35)
    assert warning["frames"] == "3-4, 7"
    assert warning["message"].startswith("L01_coat: 99th percentile of the strain: 0.5, limit 0.35; 3 frames")


def test_folded_faces_are_judged_by_their_share(shot, layers):
    count = len(layers[1].garment.faces)
    assert job_warnings([row(1, flipped_faces=0.001 * count)], layers, shot) == []
    (warning,) = job_warnings([row(1, flipped_faces=0.01 * count)], layers, shot)
    assert warning["worst"] == pytest.approx(1)


def test_unusual_bodies_are_named(shot, layers):
    betas = np.array([0, 2, -2.5, 0], np.float32)
    (warning,) = job_warnings([], layers, replace(shot, betas=betas))
    assert (warning["kind"], warning["subject"]) == ("shape", "beta 2 beyond training")
    assert warning["worst"] == 2.5


def test_unusual_poses_are_named_with_their_frames(shot, layers):
    poses = shot.motion.poses.copy()
    poses[4:6, JOINT_NAMES.index("left_elbow")] = [0, -2.5, 0]
    poses[9, 0] = [1.5, 0, 0]
    motion = replace(shot.motion, poses=poses, start_frame=1001)
    lean, elbow = job_warnings([], layers, replace(shot, motion=motion))
    assert (lean["kind"], lean["frames"]) == ("pose", "1010")
    assert lean["subject"].startswith("body leans")
    assert elbow["subject"].startswith("left_elbow turns")
    assert elbow["frames"] == "1005-1006"
    assert elbow["worst"] == pytest.approx(np.degrees(2.5), abs=0.01)


def test_the_heading_is_no_lean():
    poses = np.zeros((3, 24, 3))
    poses[1, 0], poses[2, 0] = [0, 3, 0], [0.3, 0, 0]
    np.testing.assert_allclose(joint_angles(poses)[:, 0], [0, 0, np.degrees(0.3)], atol=1e-6)


def test_the_trained_range_holds_the_built_in_motions():
    limits = trained_angles()
    for name in ("walk", "turn", "squat", "arm_raise", "arms_crossed"):
        within = joint_angles(Motion.load(name).poses) <= limits + 5
        assert within.mean() > 0.99, name
    cloth = np.isfinite(limits)
    assert (limits[cloth] > 5).all()
    assert (limits[cloth] <= 185).all()
    assert not cloth[JOINT_NAMES.index("head")]


def test_frame_lists():
    assert frame_list(np.array([1, 2, 3, 7, 9, 10])) == "1-3, 7, 9-10"
    assert frame_list(np.array([], int)) == ""


def test_criteria_name_figures_that_exist():
    assert {c.figure for c in CRITERIA if c.figure} <= {*FIGURES, "flipped_percent"}
