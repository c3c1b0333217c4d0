"""Accuracy against decode time for networks of several sizes, each trained as long as the others.

Run:  python tests/bench/bench_sizes.py --data DATA --category trousers --minutes 30 --out outputs/sizes

Minutes are those of one size, a quarter for the patterns and the rest for the atlas. Finished
sizes are kept: run again to go on. A size that has not converged in its minutes says so by its
number of steps; the curve tells what a budget buys, not what a size can reach.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from isp_assets.bundle import GarmentBundle
from isp_assets.decode import decode_garment
from isp_assets.evaluate.reconstruction import (
    IspReconstructor,
    ReconstructionOptions,
    evaluate_reconstruction,
)
from isp_assets.evaluate.table import write_table
from isp_assets.train.atlas import AtlasOptions, train_atlas
from isp_assets.train.cpu import prepare_cpu
from isp_assets.train.dataset import load_dataset
from isp_assets.train.loop import CHECKPOINT, RunOptions
from isp_assets.train.patterns import PatternOptions, train_patterns

SIZES: dict[str, tuple[int, tuple[int, int, int], int]] = {
    "64 wide, shallow": (64, (2, 4, 3), 5),
    "96 wide": (96, (3, 6, 4), 7),
    "128 wide": (128, (3, 6, 4), 7),
    "256 wide (paper)": (256, (3, 6, 4), 7),
}
"""Width, layers of the panel field (shared, distance, label), layers of the atlas."""

MEANINGS = {
    "parameters": "of both panel fields and both atlases",
    "kib": "their size at 16 bits",
    "steps": "of patterns and atlas together",
    "border_mm": "how far the border is off, mean",
    "vertex_mm": "how far rest positions are off at known pattern points, mean",
    "seam_mm": "gap of the seams before sewing, mean",
    "decode_ms": "decode at 256 cells, median over garments of the shortest of three",
    "train_mm": "point to triangle, both ways, training garments at 256 cells, mean",
    "train_chd_1e4": "their Chamfer distance x 1e4 at 100 000 samples, as in `evaluate reconstruction`",
    "train_nc_percent": "their normal consistency",
    "test_mm": "point to triangle, test garments, whose codes are fitted",
    "test_chd_1e4": "their Chamfer distance",
    "test_nc_percent": "their normal consistency",
}


def train_size(name: str, options: argparse.Namespace) -> GarmentBundle:
    """Train a size, or take it up where an earlier run left it."""
    width, depths, atlas_depth = SIZES[name]
    folder = options.out / name.split(" (")[0].replace(", ", "_").replace(" ", "_")
    data = load_dataset(options.data, options.category)
    run = RunOptions(minutes=options.minutes / 4, resume=True)
    train_patterns(data, folder / "patterns", run=run, options=PatternOptions(width=width, depths=depths))
    run = replace(run, minutes=options.minutes * 3 / 4)
    sizes = replace(AtlasOptions(), width=width, depth=atlas_depth)
    train_atlas(data, folder / "patterns" / CHECKPOINT, folder / "atlas", run=run, options=sizes)
    return GarmentBundle.load(folder / "atlas" / f"{options.category}.safetensors")


def decode_seconds(bundles: dict[str, GarmentBundle], rounds: int = 3, garments: int = 8) -> dict[str, float]:
    """Median over garments of the shortest decode at 256 cells; sizes take turns, under one load."""
    times = {name: np.full(garments, np.inf) for name in bundles}
    for _ in range(rounds):
        for index in range(garments):
            for name, bundle in bundles.items():
                code = list(bundle.codes.values())[index]
                began = time.perf_counter()
                decode_garment(bundle.model, code, resolution=256)
                times[name][index] = min(times[name][index], time.perf_counter() - began)
    return {name: float(np.median(values)) for name, values in times.items()}


def measure(name: str, bundle: GarmentBundle, options: argparse.Namespace) -> dict[str, Any]:
    """The row of a trained size, but for its decode time."""
    networks = [*bundle.model.panel_fields.values(), *bundle.model.atlases.values()]
    parameters = sum(p.numel() for network in networks for p in network.parameters())
    data = {
        split: load_dataset(options.data, options.category, test=split == "test")
        for split in ("train", "test")
    }
    few = ReconstructionOptions(resolutions=(256,), garments=options.garments)
    table = evaluate_reconstruction([IspReconstructor(bundle)], data, few)
    figures = {
        f"{row['split']}_{name}": row[key]
        for row in table.rows
        for name, key in (("mm", "mean_mm"), ("chd_1e4", "chd_1e4"), ("nc_percent", "nc_percent"))
    }
    return {
        "size": name, "parameters": parameters, "kib": 2 * parameters // 1024,
        "steps": bundle.provenance["patterns"]["step"] + bundle.provenance["atlas"]["step"],
        "border_mm": bundle.metrics["patterns"]["border_mm"],
        "vertex_mm": bundle.metrics["atlas"]["vertex_mm"], "seam_mm": bundle.metrics["atlas"]["seam_mm"],
        **figures,
    }  # fmt: skip


def draw(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Accuracy over decode time, a point a size."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for key in ("train_mm", "test_mm", "vertex_mm", "border_mm"):
        axes.plot([r["decode_ms"] for r in rows], [r[key] for r in rows], marker="o", label=MEANINGS[key])
    for row in rows:
        axes.annotate(row["size"], (row["decode_ms"], row["train_mm"]), xytext=(4, 6),
                      textcoords="offset points", fontsize=8)  # fmt: skip
    axes.set(xlabel="decode at 256 cells [ms]", ylabel="mm", title=title, ylim=(0, None))
    axes.margins(x=0.18)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--category", default="trousers")
    parser.add_argument("--minutes", type=float, default=6, help="training time of a size")
    parser.add_argument("--garments", type=int, default=20, help="measured of each split")
    parser.add_argument("--out", type=Path, default=Path("outputs/sizes"))
    options = parser.parse_args()
    prepare_cpu(1)
    bundles = {name: train_size(name, options) for name in SIZES}
    seconds = decode_seconds(bundles)
    rows = [
        {**measure(name, bundle, options), "decode_ms": 1e3 * seconds[name]}
        for name, bundle in bundles.items()
    ]
    for row in rows:
        print(row)
    details = {"category": options.category, "minutes": options.minutes}
    write_table(options.out, "sizes", rows, meanings=MEANINGS, details=details)
    draw(
        rows, options.out / "sizes.png", f"{options.category}, {options.minutes:g} minutes of training a size"
    )


if __name__ == "__main__":
    main()
