"""One job from start to end: drape, measure, feed the writers, report.

Writers get the frames chunk by chunk, so memory does not grow with the length
of the shot. If anything fails, every writer drops what it has begun.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from isp_assets.drape import DrapeOptions, chunk_rows
from isp_assets.drape_workers import Complete, drape_shot
from isp_assets.errors import DrapeError, IspAssetsError, PluginError
from isp_assets.evaluate.frames import FrameMeter, summarise
from isp_assets.evaluate.job_warnings import job_warnings
from isp_assets.evaluate.table import machine
from isp_assets.files import write_text
from isp_assets.frame_store import FrameStore, job_key
from isp_assets.frames import DrapedFrames, FrameChunk, Scene, StageTimes
from isp_assets.plugin import ShotWriter, make_writer
from isp_assets.shot import ShotJob

REPORT_SCHEMA = "isp-assets/report"
REPORT_VERSION = 1

Progress = Callable[[int, int], None]
"""Called with (frames done, frames in all)."""

_STAGES_EVERY = 8  # the earlier rungs of the ladder are measured on every n-th frame


def run_job(
    job: ShotJob,
    out: Path,
    *,
    options: DrapeOptions,
    workers: int = 1,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Drape a job and write its files and ``report.json`` into ``out``.

    Until all is written, finished frames are kept in ``NAME.frames``, unless they are smoothed over time.

    Args:
        job: What to drape and which writers to run.
        out: Output folder; made if missing. Existing outputs are replaced whole.
        options: Device, steps and chunk size.
        workers: Processes that drape and measure; see `drape_shot`.
        resume: Go on from the frames that an interrupted run of the same job kept.

    Returns:
        The report, as written.

    Raises:
        IspAssetsError: With nothing half-written in ``out``.
    """
    started = time.perf_counter()
    writers = {name: make_writer(name) for name in job.write}
    clock: dict[str, float] = {}
    paths = {name: out / f"{job.shot.name}{writer.suffix}" for name, writer in writers.items()}
    _check_paths(paths)
    options = replace(options, resolution=job.resolution, keep_stages=True)
    draped, store = _draped(job, options, out, workers=workers, resume=resume)
    clock["prepare"] = time.perf_counter() - started
    out.mkdir(parents=True, exist_ok=True)
    rows = _write_all(draped, writers, paths, clock, progress)
    clock["total"] = time.perf_counter() - started
    report = _report(job, draped, {**asdict(options), "workers": workers}, rows, clock, paths)
    text = json.dumps(report, indent=1, allow_nan=False)
    write_text(out / "report.json", text + "\n")
    if store is not None:
        store.clear()
    return json.loads(text)


def _draped(
    job: ShotJob, options: DrapeOptions, out: Path, *, workers: int, resume: bool
) -> tuple[DrapedFrames, FrameStore | None]:
    """The measured frames of a job, and where they are kept meanwhile."""
    finish = Measuring(_STAGES_EVERY)
    if options.smoothing:
        if resume:
            raise DrapeError(
                "frames that are smoothed over time depend on those before and cannot be resumed; "
                "leave --resume or --smoothing out"
            )
        return drape_shot(job.outfit, job.shot, options, workers=workers, finish=finish), None
    key = job_key(job, options, stages_every=_STAGES_EVERY)
    store = FrameStore(out / f"{job.shot.name}.frames", key, resume=resume)
    rows = chunk_rows(job.shot, options)
    missing = [part for part in rows if part.start not in store.finished]
    draped = drape_shot(job.outfit, job.shot, options, workers=workers, finish=finish, rows=missing)
    return store.complete(draped, rows), store


def _check_paths(paths: dict[str, Path]) -> None:
    clash = [name for name, path in paths.items() if list(paths.values()).count(path) > 1]
    if clash:
        raise PluginError(f"writers {', '.join(clash)} all write {paths[clash[0]]}; choose one of them")


def _write_all(
    draped: DrapedFrames,
    writers: dict[str, ShotWriter],
    paths: dict[str, Path],
    clock: dict[str, float],
    progress: Progress | None,
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    total = len(draped.scene.frames)
    try:
        for name, writer in writers.items():
            _timed(clock, f"write {name}", name, writer.begin, paths[name], draped.scene)
        for chunk in draped:
            for stage, seconds in chunk.times.seconds.items():
                clock[stage] = clock.get(stage, 0.0) + seconds
            rows.extend(
                {"frame": int(f), "steps": [list(s) for s in chunk.steps[i]], **chunk.metrics[i]}
                for i, f in enumerate(chunk.frames)
            )
            for name, writer in writers.items():
                _timed(clock, f"write {name}", name, writer.add, chunk)
            if progress is not None:
                progress(len(rows), total)
        for name, writer in writers.items():
            _timed(clock, f"write {name}", name, writer.finish)
    except BaseException:
        for writer in writers.values():
            writer.abort()
        raise
    return rows


@dataclass(frozen=True)
class Measuring:
    """Measures every chunk, in the process that draped it."""

    stages_every: int
    """Also measure the earlier rungs on every n-th frame."""

    def __call__(self, scene: Scene) -> Complete:
        """What measures chunks of this scene; it drops the earlier rungs afterwards."""
        meter = FrameMeter(scene)

        def measured(chunk: FrameChunk, first: int) -> FrameChunk:
            start, every = time.perf_counter(), self.stages_every
            metrics = tuple(
                meter.measure(chunk, i, stages=(first + i) % every == 0) for i in range(len(chunk.frames))
            )
            seconds = {**chunk.times.seconds, "measure": time.perf_counter() - start}
            return replace(chunk, metrics=metrics, times=StageTimes(seconds), stages={})

        return measured


def _timed(clock: dict[str, float], stage: str, name: str, call: Callable[..., None], *args: object) -> None:
    start = time.perf_counter()
    try:
        call(*args)
    except IspAssetsError:
        raise
    except Exception as cause:  # a plugin may fail in any way: say which one it was
        raise PluginError(f"writer {name!r} failed: {type(cause).__name__}: {cause}") from cause
    clock[stage] = clock.get(stage, 0.0) + time.perf_counter() - start


def _report(
    job: ShotJob,
    draped: DrapedFrames,
    options: dict[str, Any],
    rows: list[dict[str, Any]],
    clock: dict[str, float],
    paths: dict[str, Path],
) -> dict[str, Any]:
    scene = draped.scene
    count = len(rows)
    return {
        "schema": REPORT_SCHEMA,
        "version": REPORT_VERSION,
        "shot": {
            "name": scene.name,
            "frames": str(scene.frames),
            "fps": scene.fps,
            "motion": job.shot.motion.name,
            "body": job.shot.body.name,
            "body_sha256": job.shot.body.sha256,
            "betas": [round(float(b), 6) for b in job.shot.betas],
            "resolution": job.resolution,
        },
        "layers": [_layer_row(layer) for layer in scene.layers],
        "options": options,
        "machine": machine(options["device"]),
        "seconds": {stage: round(s, 4) for stage, s in clock.items()},
        "milliseconds_per_frame": {
            stage: round(1000 * s / count, 2)
            for stage, s in clock.items()
            if stage not in ("prepare", "total")
        },
        "peak_memory_mib": round(_peak_memory_mib(resource.RUSAGE_SELF), 1),
        "peak_memory_worker_mib": (
            round(_peak_memory_mib(resource.RUSAGE_CHILDREN), 1) if options["workers"] > 1 else 0.0
        ),
        "warnings": job_warnings(rows, scene.layers, job.shot),
        "summary": summarise(rows),
        "frames": rows,
        "files": {name: {"path": p.name, "bytes": p.stat().st_size} for name, p in paths.items()},
    }


def _layer_row(layer: Any) -> dict[str, Any]:
    garment = layer.garment
    return {
        "name": layer.name,
        "category": garment.category,
        "vertices": garment.num_vertices,
        "faces": len(garment.faces),
        "seams": len(garment.seams),
    }


def _peak_memory_mib(who: int) -> float:
    peak = resource.getrusage(who).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def split_names(text: str) -> tuple[str, ...]:
    """Split ``"usd,glb"``; empty parts are dropped, order is kept, doubles are merged."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
