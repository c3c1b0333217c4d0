"""Time every stage of the main job, cold and warm, in batches of 1 and 16 frames, and record peak memory.

Run:  python tests/bench/bench_drape.py --out outputs/bench_drape.json

Every row is measured in a fresh process, so that "cold" means cold and the peak of
resident memory belongs to that row alone. Compare ratios within one run: machines
differ, and a busy one differs from itself.
"""

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

OUTFITS = {
    1: ["trousers"],
    2: ["tank_top", "trousers"],
    3: ["tank_top", "trousers", "open_jacket"],
    5: ["tank_top", "tee", "trousers", "open_vest", "long_cardigan"],
}
WRITERS = ("usd", "glb", "rerun", "sheet")


def measure(layers: int, chunk: int, frames: int, resolution: int, writers: bool) -> dict[str, Any]:
    """One row, in this process: load, prepare, first chunk (cold), other chunks (warm), writers."""
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    import torch

    from isp_assets import Body, Collection, FrameRange, Motion, Shot, make_writer
    from isp_assets.decode import decode_garment
    from isp_assets.drape import DrapeOptions, drape

    torch.set_num_threads(1)
    seconds["import"] = time.perf_counter() - start

    start = time.perf_counter()
    body = Body.load("default")
    outfit = Collection.load("default").outfit(OUTFITS[layers])
    motion = Motion.load("walk").select(FrameRange(1, frames))
    seconds["load"] = time.perf_counter() - start

    for name in ("decode cold", "decode warm"):
        start = time.perf_counter()
        for item in outfit:
            decode_garment(item.bundle.model, item.code, resolution=resolution)
        seconds[name] = time.perf_counter() - start

    start = time.perf_counter()
    draped = drape(outfit, Shot("bench", body, motion), DrapeOptions(chunk=chunk, resolution=resolution))
    seconds["dress"] = time.perf_counter() - start

    row: dict[str, Any] = {"layers": layers, "batch": chunk, "frames": frames, "resolution": resolution}
    stages: dict[str, list[float]] = {}
    chunks = []
    for part in draped:
        chunks.append(part)
        for stage, spent in part.times.seconds.items():
            stages.setdefault(stage, []).append(1000 * spent / len(part.frames))
    row["cold ms/frame"] = {s: round(v[0], 2) for s, v in stages.items()}
    row["warm ms/frame"] = {s: round(sum(v[1:]) / len(v[1:]), 2) for s, v in stages.items() if v[1:]}
    row["vertices"] = [layer.garment.num_vertices for layer in draped.scene.layers]
    row["peak MiB without writers"] = round(_peak_mib(), 1)
    if writers:
        with tempfile.TemporaryDirectory() as folder:
            for name in WRITERS:
                start = time.perf_counter()
                writer = make_writer(name)
                writer.begin(Path(folder) / f"bench{writer.suffix}", draped.scene)
                for part in chunks:
                    writer.add(part)
                writer.finish()
                seconds[f"write {name}"] = time.perf_counter() - start
        row["peak MiB with writers"] = round(_peak_mib(), 1)
    row["seconds"] = {stage: round(spent, 3) for stage, spent in seconds.items()}
    return row


def _peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _in_fresh_process(**options: Any) -> dict[str, Any]:
    command = [sys.executable, __file__, "--row", json.dumps(options)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_drape.json"))
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--row", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        print(json.dumps(measure(**json.loads(options.row))))
        return
    rows = []
    for layers, chunk in ((1, 1), (1, 16), (2, 16), (3, 1), (3, 16), (5, 16)):
        row = _in_fresh_process(
            layers=layers,
            chunk=chunk,
            frames=options.frames,
            resolution=options.resolution,
            writers=(layers, chunk) == (3, 16),
        )
        warm = sum(row["warm ms/frame"].values())
        print(f"{layers} layers, batch {chunk:2}: {warm:7.1f} ms a frame warm, {row['warm ms/frame']}")
        rows.append(row)
    import torch

    import isp_assets

    machine = {
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "isp_assets": isp_assets.__version__,
        "device": "cpu, 1 thread",
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
