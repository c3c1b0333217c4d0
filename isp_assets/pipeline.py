"""One job from start to end: drape, measure, feed the writers, report.

Writers get the frames chunk by chunk, so memory does not grow with the length
of the shot. If anything fails, every writer drops what it has begun.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from isp_assets.drape import DrapeOptions, drape
from isp_assets.errors import IspAssetsError, PluginError
from isp_assets.evaluate.frames import FrameMeter, summarise
from isp_assets.evaluate.job_warnings import job_warnings
from isp_assets.evaluate.table import machine
from isp_assets.files import write_text
from isp_assets.frames import DrapedFrames, FrameChunk
from isp_assets.plugin import ShotWriter, make_writer
from isp_assets.shot import ShotJob

REPORT_SCHEMA = "isp-assets/report"
REPORT_VERSION = 1

Progress = Callable[[int, int], None]
"""Called with (frames done, frames in all)."""


def run_job(
    job: ShotJob,
    out: Path,
    *,
    options: DrapeOptions,
    measure_stages_every: int = 8,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Drape a job and write its files and ``report.json`` into ``out``.

    Args:
        job: What to drape and which writers to run.
        out: Output folder; made if missing. Existing outputs are replaced whole.
        options: Device, steps and chunk size.
        measure_stages_every: Measure the earlier rungs of the ladder on every n-th frame; 0 never.

    Returns:
        The report, as written.

    Raises:
        IspAssetsError: With nothing half-written in ``out``.
    """
    started = time.perf_counter()
    writers = {name: make_writer(name) for name in job.write}
    clock: dict[str, float] = {}
    draped = drape(
        job.outfit,
        job.shot,
        replace(options, resolution=job.resolution, keep_stages=measure_stages_every > 0),
    )
    clock["prepare"] = time.perf_counter() - started
    paths = {name: out / f"{job.shot.name}{writer.suffix}" for name, writer in writers.items()}
    _check_paths(paths)
    out.mkdir(parents=True, exist_ok=True)
    rows = _write_all(draped, writers, paths, measure_stages_every, clock, progress)
    clock["total"] = time.perf_counter() - started
    text = json.dumps(_report(job, draped, options, rows, clock, paths), indent=1, allow_nan=False)
    write_text(out / "report.json", text + "\n")
    return json.loads(text)


def _check_paths(paths: dict[str, Path]) -> None:
    clash = [name for name, path in paths.items() if list(paths.values()).count(path) > 1]
    if clash:
        raise PluginError(f"writers {', '.join(clash)} all write {paths[clash[0]]}; choose one of them")


def _write_all(
    draped: DrapedFrames,
    writers: dict[str, ShotWriter],
    paths: dict[str, Path],
    stages_every: int,
    clock: dict[str, float],
    progress: Progress | None,
) -> list[dict[str, Any]]:
    meter = FrameMeter(draped.scene)
    rows: list[dict[str, Any]] = []
    total = len(draped.scene.frames)
    try:
        for name, writer in writers.items():
            _timed(clock, f"write {name}", name, writer.begin, paths[name], draped.scene)
        for raw in draped:
            for stage, seconds in raw.times.seconds.items():
                clock[stage] = clock.get(stage, 0.0) + seconds
            chunk = _measured(raw, meter, stages_every, clock, len(rows))
            rows.extend(
                {"frame": int(f), "steps": [list(s) for s in chunk.steps[i]], **chunk.metrics[i]}
                for i, f in enumerate(chunk.frames)
            )
            for name, writer in writers.items():
                _timed(clock, f"write {name}", name, writer.add, replace(chunk, stages={}))
            if progress is not None:
                progress(len(rows), total)
        for name, writer in writers.items():
            _timed(clock, f"write {name}", name, writer.finish)
    except BaseException:
        for writer in writers.values():
            writer.abort()
        raise
    return rows


def _measured(
    chunk: FrameChunk, meter: FrameMeter, stages_every: int, clock: dict[str, float], done: int
) -> FrameChunk:
    start = time.perf_counter()
    metrics = []
    for i in range(len(chunk.frames)):
        with_stages = stages_every > 0 and (done + i) % stages_every == 0
        metrics.append(meter.measure(chunk, i, stages=with_stages))
    clock["measure"] = clock.get("measure", 0.0) + time.perf_counter() - start
    return replace(chunk, metrics=tuple(metrics))


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
    options: DrapeOptions,
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
        "options": asdict(options),
        "machine": machine(options.device),
        "seconds": {stage: round(s, 4) for stage, s in clock.items()},
        "milliseconds_per_frame": {
            stage: round(1000 * s / count, 2)
            for stage, s in clock.items()
            if stage not in ("prepare", "total")
        },
        "peak_memory_mib": round(_peak_memory_mib(), 1),
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


def _peak_memory_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def split_names(text: str) -> tuple[str, ...]:
    """Split ``"usd,glb"``; empty parts are dropped, order is kept, doubles are merged."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
