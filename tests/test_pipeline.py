"""A whole job: what it writes, what the report says, and that a failure leaves nothing."""

import json
from pathlib import Path

import pytest

from isp_assets import pipeline
from isp_assets.drape import STEPS, DrapeOptions, Draper
from isp_assets.errors import DrapeError, PluginError, ShotError
from isp_assets.frames import FrameChunk, Scene
from isp_assets.pipeline import run_job, split_names
from isp_assets.shot import ShotJob

TABLE = {
    "name": "job",
    "motion": "walk",
    "frames": "4-6",
    "outfit": ["tank_top", "open_jacket"],
    "resolution": 40,
    "write": ["usd", "sheet"],
}


class Recorder:
    """A writer that notes its calls, and fails on request."""

    name, suffix, version = "recorder", ".txt", "1"

    def __init__(self, fail_at: str | None = None, error: type[BaseException] = OSError) -> None:
        self.calls: list[str] = []
        self.fail_at, self.error = fail_at, error

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self.fail_at:
            raise self.error("disk full")

    def begin(self, path: Path, scene: Scene) -> None:
        self.path = path
        self._note("begin")

    def add(self, chunk: FrameChunk) -> None:
        assert chunk.metrics
        assert chunk.stages == {}
        self._note("add")

    def finish(self) -> None:
        self._note("finish")
        self.path.write_text("done")

    def abort(self) -> None:
        self.calls.append("abort")


def job(**changes: object) -> ShotJob:
    return ShotJob.from_table(TABLE | changes, where="test")


def test_an_interrupted_job_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = DrapeOptions(chunk=1)
    whole = run_job(job(write=["sheet"]), tmp_path / "whole", options=options)
    assert not (tmp_path / "whole" / "job.frames").exists()
    with monkeypatch.context() as patch:
        stopped = Recorder("add", KeyboardInterrupt)
        patch.setattr(pipeline, "make_writer", lambda name: stopped)
        with pytest.raises(KeyboardInterrupt):
            run_job(job(write=["recorder"]), tmp_path / "cut", options=options)
    kept = tmp_path / "cut" / "job.frames"
    assert {path.name for path in kept.iterdir()} == {"key.txt", "00000000.npz"}
    with pytest.raises(ShotError, match="kept frames are of another job"):
        run_job(job(outfit=["tank_top"]), tmp_path / "cut", options=options, resume=True)
    draped = []
    monkeypatch.setattr(
        Draper, "chunk", lambda self, rows, plain=Draper.chunk: draped.append(rows.start) or plain(self, rows)
    )
    rest = run_job(job(write=["sheet"]), tmp_path / "cut", options=options, resume=True)
    assert draped == [1, 2]
    assert rest["frames"] == whole["frames"]
    assert rest["summary"] == whole["summary"]
    assert not kept.exists()


def test_smoothed_frames_cannot_be_resumed(tmp_path: Path) -> None:
    with pytest.raises(DrapeError, match="leave --resume or --smoothing out"):
        run_job(job(), tmp_path, options=DrapeOptions(smoothing=0.5), resume=True)


def test_two_processes_report_the_same_frames(tmp_path: Path) -> None:
    options = DrapeOptions(chunk=1)
    one, two = (run_job(job(write=["sheet"]), tmp_path / str(n), options=options, workers=n) for n in (1, 2))
    assert one["frames"] == two["frames"]
    assert one["summary"] == two["summary"]
    assert (one["options"]["workers"], two["options"]["workers"]) == (1, 2)
    assert one["peak_memory_worker_mib"] == 0 < two["peak_memory_worker_mib"]
    assert two["milliseconds_per_frame"]["measure"] > 0


def test_files_and_report(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    report = run_job(job(), tmp_path, options=DrapeOptions(chunk=2), progress=lambda *step: done.append(step))
    assert done == [(2, 3), (3, 3)]
    assert {p.name for p in tmp_path.iterdir()} >= {"job.usdc", "job.png", "report.json"}
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert (report["schema"], report["version"]) == ("isp-assets/report", 1)
    assert [row["frame"] for row in report["frames"]] == [4, 5, 6]
    assert [layer["name"] for layer in report["layers"]] == ["L00_tank_top", "L01_open_jacket"]
    assert {"skin", "displace", "project", "measure", "write usd"} <= set(report["milliseconds_per_frame"])
    for figure in ("body_area_percent", "inner_area_percent", "strain_p99", "crossing_pairs"):
        assert report["summary"]["final"]["L01_open_jacket"][figure]["frames"] == 3
    assert set(report["summary"]) == {"final", *STEPS} - {"relax"}
    assert report["files"]["usd"]["bytes"] == (tmp_path / "job.usdc").stat().st_size
    assert report["peak_memory_mib"] > 100
    for warning in report["warnings"]:
        assert {"kind", "subject", "worst", "limit", "message"} <= set(warning)
        assert warning["worst"] > warning["limit"]


@pytest.mark.parametrize("fail_at", ["begin", "add", "finish"])
def test_a_failing_writer_stops_all_and_leaves_nothing(
    fail_at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writers = {"good": Recorder(), "bad": Recorder(fail_at)}
    writers["good"].suffix = ".good"
    monkeypatch.setattr(pipeline, "make_writer", writers.__getitem__)
    with pytest.raises(PluginError, match="writer 'bad' failed: OSError: disk full"):
        run_job(job(write=["good", "bad"]), tmp_path, options=DrapeOptions())
    assert writers["good"].calls[-1] == "abort"
    assert writers["bad"].calls[-1] == "abort"
    assert not (tmp_path / "report.json").exists()


def test_interrupt_aborts_the_writers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = Recorder("add", KeyboardInterrupt)
    monkeypatch.setattr(pipeline, "make_writer", lambda name: writer)
    with pytest.raises(KeyboardInterrupt):
        run_job(job(write=["recorder"]), tmp_path, options=DrapeOptions())
    assert writer.calls == ["begin", "add", "abort"]
    # What was finished is whole, and kept.
    assert [path.name for path in tmp_path.iterdir()] == ["job.frames"]


def test_two_writers_of_one_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "make_writer", lambda name: Recorder())
    with pytest.raises(PluginError, match=r"writers one, two all write .*job\.txt"):
        run_job(job(write=["one", "two"]), tmp_path, options=DrapeOptions())


def test_unknown_writer_fails_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match="no writer plugin named 'fbx'"):
        run_job(job(write=["fbx"]), tmp_path / "new", options=DrapeOptions())
    assert not (tmp_path / "new").exists()


def test_split_names() -> None:
    assert split_names("usd, glb,,usd") == ("usd", "glb")
