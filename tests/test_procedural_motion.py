"""The shipped motions are what the script makes."""

import numpy as np
import pytest

from isp_assets.body import Body
from isp_assets.motion import Motion, builtin_motions
from isp_assets.train.procedural_motion import Gait, main, shipped_motions


@pytest.fixture(scope="module")
def made():
    return shipped_motions(Body.load())


def test_every_shipped_motion_is_made(made):
    assert sorted(made) == list(builtin_motions())


@pytest.mark.parametrize("name", builtin_motions())
def test_script_reproduces_the_shipped_files(made, name):
    shipped = Motion.load(name)
    np.testing.assert_allclose(made[name].poses, shipped.poses, atol=1e-5)
    np.testing.assert_allclose(made[name].translation, shipped.translation, atol=1e-5)


def test_files_are_byte_identical_on_a_second_run(tmp_path, monkeypatch):
    written = []
    for run in ("first", "second"):
        monkeypatch.setattr("sys.argv", ["procedural_motion", "--out", str(tmp_path / run)])
        main()
        written.append({path.name: path.read_bytes() for path in (tmp_path / run).iterdir()})
    assert written[0] == written[1]
    assert sorted(written[0]) == [f"{name}.npz" for name in builtin_motions()]


def test_walk_covers_its_distance(made):
    travelled = made["walk"].translation[-1] - made["walk"].translation[0]
    assert travelled[2] == pytest.approx(1.05 * 119 / 30, abs=0.01)


def test_turning_path_has_the_speed_and_heading_asked_for():
    gait = Gait(turn=0.9, speed=0.8)
    times = np.linspace(0, 3, 301)
    points = np.array([gait.path(t)[0] for t in times])
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1) / 0.01, 0.8, rtol=1e-4)
    middle, heading = gait.path(1.505)
    ahead = points[151] - points[150]
    np.testing.assert_allclose(np.arctan2(ahead[0], ahead[2]), heading, atol=1e-6)
    assert np.linalg.norm(middle - points[150]) < 0.01
