"""Kept frames: what is stored comes back, and what is damaged or of another job is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isp_assets.drape import DrapeOptions
from isp_assets.errors import ShotError
from isp_assets.frame_store import FrameStore, job_key
from isp_assets.frames import FrameChunk, StageTimes
from isp_assets.shot import ShotJob

TABLE = {"name": "job", "motion": "walk", "frames": "4-6", "outfit": ["trousers", "tee"]}


def chunk(first: int = 0) -> FrameChunk:
    rng = np.random.default_rng(first)
    return FrameChunk(
        frames=np.arange(first, first + 2),
        body=rng.normal(size=(2, 5, 3)).astype(np.float32),
        layers=tuple(rng.normal(size=(2, count, 3)).astype(np.float32) for count in (4, 7)),
        times=StageTimes({"skin": 0.25}),
        steps=((("skin",), ("skin", "project")), (("skin",), ("skin",))),
        metrics=({"a/b": 1.5}, {"a/b": 2.0}),
    )


def test_a_kept_chunk_comes_back_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "job.frames"
    FrameStore(folder, "key", resume=False).save(6, chunk(6))
    store = FrameStore(folder, "key", resume=True)
    assert store.finished == {6}
    found, expected = store.load(6), chunk(6)
    for name in ("frames", "body"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))
    for one, other in zip(found.layers, expected.layers, strict=True):
        assert np.array_equal(one, other)
        assert one.dtype == other.dtype
    assert (found.times, found.steps, found.metrics) == (expected.times, expected.steps, expected.metrics)


def test_nothing_is_resumed_unless_asked(tmp_path: Path) -> None:
    folder = tmp_path / "job.frames"
    FrameStore(folder, "key", resume=False).save(0, chunk())
    assert FrameStore(folder, "key", resume=False).finished == set()
    assert not folder.exists()
    assert FrameStore(folder, "key", resume=True).finished == set()


def test_frames_of_another_job_or_damaged_ones_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "job.frames"
    FrameStore(folder, "key", resume=False).save(0, chunk())
    with pytest.raises(ShotError, match=r"job\.frames: the kept frames are of another job"):
        FrameStore(folder, "other", resume=True)
    file = folder / "00000000.npz"
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ShotError, match=r"00000000\.npz: kept frames are damaged"):
        FrameStore(folder, "key", resume=True).load(0)


def test_a_key_stands_for_all_that_frames_depend_on() -> None:
    job, options = ShotJob.from_table(TABLE, where="test"), DrapeOptions()
    key = job_key(job, options)
    assert job_key(ShotJob.from_table(TABLE, where="test"), options) == key
    moved = replace(job.shot.motion, translation=job.shot.motion.translation + np.float32(1e-3))
    first, second = job.outfit.items
    other = replace(first, code=first.code * np.float32(1.01))
    bundle = replace(first.bundle, drape_field=second.bundle.drape_field)
    keys = {
        key,
        job_key(job, replace(options, chunk=3)),
        job_key(job, options, stages_every=3),
        job_key(replace(job, resolution=40), options),
        job_key(replace(job, shot=replace(job.shot, motion=moved)), options),
        job_key(replace(job, shot=replace(job.shot, betas=job.shot.betas + np.float32(1))), options),
        job_key(replace(job, outfit=replace(job.outfit, items=(second, first))), options),
        job_key(replace(job, outfit=replace(job.outfit, items=(other, second))), options),
        job_key(
            replace(job, outfit=replace(job.outfit, items=(replace(first, bundle=bundle), second))), options
        ),
    }
    assert len(keys) == 9
