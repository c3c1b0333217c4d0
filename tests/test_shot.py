"""Job files: what they set, and how wrong ones are named."""

from pathlib import Path

import numpy as np
import pytest

from isp_assets.conventions import FrameRange
from isp_assets.errors import InputError, MotionError, ShotError
from isp_assets.motion import Motion
from isp_assets.shot import DEFAULT_WRITERS, ShotJob

GOOD = 'motion = "walk"\noutfit = ["tank_top", "trousers"]\n'


def load(folder: Path, text: str, **options: object) -> ShotJob:
    path = folder / "job.toml"
    path.write_text(text)
    return ShotJob.load(path, **options)


def test_defaults(tmp_path: Path) -> None:
    job = load(tmp_path, GOOD)
    assert job.shot.name == "walk"
    assert job.write == DEFAULT_WRITERS
    assert len(job.shot.motion) == len(Motion.load("walk"))
    assert not job.shot.betas.any()


def test_every_key(tmp_path: Path) -> None:
    text = GOOD + 'name = "a"\nframes = "3-9x2"\nbetas = [1, -0.5]\nresolution = 64\nwrite = ["usd"]\n'
    job = load(tmp_path, text)
    assert job.shot.name == "a"
    assert job.shot.motion.frames.tolist() == [3, 5, 7, 9]
    assert job.shot.betas.tolist() == [1.0, -0.5]
    assert (job.resolution, job.write) == (64, ("usd",))


def test_command_line_frames_override_the_file(tmp_path: Path) -> None:
    job = load(tmp_path, GOOD + 'frames = "1-40"\n', frames=FrameRange(5, 6))
    assert job.shot.motion.frames.tolist() == [5, 6]


def test_frame_rate_resamples(tmp_path: Path) -> None:
    job = load(tmp_path, GOOD + "fps = 60\n")
    assert job.shot.motion.fps == 60
    assert len(job.shot.motion) == 2 * len(Motion.load("walk")) - 1


def test_paths_start_at_the_file(tmp_path: Path) -> None:
    motion = Motion.load("walk")
    np.savez(
        tmp_path / "own.npz",
        poses=motion.poses.reshape(len(motion), 72),
        trans=motion.translation,
        mocap_framerate=motion.fps,
    )
    job = load(tmp_path, GOOD.replace('"walk"', '"own.npz"'))
    assert job.shot.name == "own"
    np.testing.assert_allclose(job.shot.motion.poses, motion.poses, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('motion = "walk"\n', "missing key outfit"),
        (GOOD + "colour = 1\n", "unknown key 'colour'"),
        (GOOD + "resolution = 8\n", r"resolution must lie in 32\.\.512, got 8"),
        (GOOD + 'betas = "giant"\n', "betas must be a list of numbers or one of"),
        (GOOD + 'betas = [1, "a"]\n', "betas must be numbers"),
        (GOOD + f"betas = {[0.0] * 11}\n", "has 10 betas, got 11"),
        (GOOD + "betas = [nan]\n", "NaN"),
        (GOOD + 'name = "a/b"\n', "usable as a file name"),
        (GOOD + 'collection = "none"\n', "no such file"),
        (GOOD + 'body = "none.npz"\n', "no such body file"),
        (GOOD.replace('"walk"', '"moonwalk"'), "no such motion"),
        (GOOD.replace('"trousers"', '"trousrs"'), "did you mean 'trousers'"),
        (GOOD.replace('"trousers"', "3"), "outfit must be a list of names"),
        (GOOD + 'frames = "9-3"\n', "ends before it starts"),
        (GOOD + 'frames = "1-9999"\n', "has frames"),
        (GOOD + "fps = 0\n", "fps must be above 0"),
    ],
)
def test_wrong_job_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load(tmp_path, text)


def test_pose_with_nan_is_named(tmp_path: Path) -> None:
    motion = Motion.load("walk")
    poses = motion.poses.reshape(len(motion), 72).copy()
    poses[7, 16 * 3] = np.nan
    np.savez(tmp_path / "own.npz", poses=poses, trans=motion.translation, mocap_framerate=30.0)
    with pytest.raises(MotionError, match="left_shoulder"):
        load(tmp_path, GOOD.replace('"walk"', '"own.npz"'))


def test_body_that_the_outfit_was_not_trained_on(tmp_path: Path) -> None:
    source = np.load(Path(__file__).parents[1] / "isp_assets/data/default_body.npz", allow_pickle=False)
    arrays = {k: source[k] for k in source.files if source[k].dtype.kind in "fiu"}
    arrays["v_template"] = arrays["v_template"] * 1.01
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ShotError, match="is not the body that the outfit was trained on"):
        load(tmp_path, GOOD + 'body = "other.npz"\n')
