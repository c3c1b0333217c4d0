"""What displacement networks of several sizes learn in the same time, and what a frame of theirs costs.

Run:  python tests/bench/bench_drape_sizes.py --category trousers --minutes 5 --out outputs/drape_sizes

Minutes are those of one size, from nothing. Finished sizes are kept: run again to go on.
The paper's network has 98 % of its 125 million weights in one linear layer to maps of
200² texels. The curve tells what a budget buys, not what a size can reach.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle
from isp_assets.collection import Collection
from isp_assets.decode import decode_garment
from isp_assets.displacement import anchor_ramp, bind_displacement, displacements, panel_sampler
from isp_assets.evaluate.table import write_table
from isp_assets.networks.drape_field import DrapeField, DrapeFieldConfig
from isp_assets.train.cpu import prepare_cpu
from isp_assets.train.displacement import DisplacementOptions, DisplacementTask
from isp_assets.train.loop import RunOptions, train
from isp_assets.train.poses import PoseSource
from isp_assets.train.wardrobe import WardrobeOptions

SIZES: dict[str, DrapeFieldConfig] = {
    "128 wide, 16 maps": DrapeFieldConfig(width=128, depth=3, basis=16, map_size=32, coarse_size=8),
    "256 wide, 32 maps": DrapeFieldConfig(width=256, basis=32),
    "512 wide, 32 maps (shipped)": DrapeFieldConfig(basis=32),
    "512 wide, 128 maps": DrapeFieldConfig(basis=128),
    "linear to 200² (paper)": DrapeFieldConfig.paper(),
}

GARMENTS = 6
ENERGIES = ("strain", "bending", "gravity", "collision")

MEANINGS = {
    "parameters": "of the network",
    "mib": "their size at 16 bits",
    "steps": "taken in the minutes given; none for the built-in network, which was trained longer",
    "removed_mj": "energy that is removed from skinning's, held-out poses, mean [mJ]",
    "strain_p99": "99th percentile of the strain on held-out poses",
    "inside_percent": "vertices inside the body there",
    "map_ms": "a frame at 64 cells: make the map, sample it (median)",
    "bound_ms": "the same with the maps sampled once a garment (median)",
    "bind_ms": "what sampling them costs, once a garment",
}


def task_of(
    network: DrapeFieldConfig | None, bundle: GarmentBundle, options: argparse.Namespace
) -> DisplacementTask:
    """The training of a new network, or of the built-in one."""
    poses = PoseSource(options.motions, tuple(filter(None, options.hold_out.split(","))))
    sizes = {"network": network} if network else {}
    settings = DisplacementOptions(poses=poses, wardrobe=WardrobeOptions(garments=options.garments), **sizes)
    start = replace(bundle, drape_field=None) if network else bundle
    return DisplacementTask(start, Collection.load("default").skin, Body.load("default"), settings)


def row_of(name: str, steps: int | None, task: DisplacementTask, bundle: GarmentBundle) -> dict[str, Any]:
    """The row of a trained size."""
    field = task.module.eval()
    figures = task.measure_on(task.wardrobe[:GARMENTS])
    energy = {start: sum(figures[f"{start}{term}_mj"] for term in ENERGIES) for start in ("skin.", "")}
    parameters = sum(p.numel() for p in field.parameters())
    row = {
        "size": name, "parameters": parameters, "mib": 2 * parameters / 2**20, "steps": steps,
        "removed_mj": energy["skin."] - energy[""], "strain_p99": figures["strain_p99"],
        "inside_percent": figures["inside_percent"],
    }  # fmt: skip
    return row | frame_times(field, bundle)


def frame_times(field: DrapeField, bundle: GarmentBundle) -> dict[str, float]:
    """Milliseconds a frame, one at a time, and of binding."""
    garment = decode_garment(bundle.model, next(iter(bundle.codes.values())), resolution=64)
    sampler = panel_sampler(garment, bundle.model, resolution=field.config.map_size)
    ramp = anchor_ramp(garment)
    began = time.perf_counter()
    bound = bind_displacement(field, sampler, ramp)
    bind_ms = 1e3 * (time.perf_counter() - began)
    features = torch.randn(1, field.config.num_features, generator=torch.Generator().manual_seed(0))

    def through_maps() -> Tensor:
        return sampler.sample(field(features))

    def through_bound() -> Tensor:
        return displacements(bound, field, features)

    times = {"bind_ms": bind_ms}
    for name, call in (("map_ms", through_maps), ("bound_ms", through_bound)):
        seconds = []
        with torch.no_grad():
            for _ in range(12):
                began = time.perf_counter()
                call()
                seconds.append(time.perf_counter() - began)
        times[name] = 1e3 * float(np.median(seconds[2:]))
    return times


def draw(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Energy removed over the number of weights, and the time of a frame beside it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    trained = [row for row in rows if row["steps"]]
    size = [row["parameters"] / 1e6 for row in trained]
    left.plot(size, [row["removed_mj"] for row in trained], color="0.7", zorder=1)
    for row, x in zip(trained, size, strict=True):
        left.scatter(x, row["removed_mj"], label=f"{row['size']}: {row['steps']} steps", zorder=2)
    for row in rows:
        if not row["steps"]:
            left.axhline(row["removed_mj"], linestyle="--", color="0.5", label=row["size"])
    left.set(
        xscale="log", xlabel="million weights", ylabel="energy removed, held-out poses [mJ]", title=title
    )
    left.set_ylim(0, None)
    left.legend(fontsize=8, loc="lower left")
    for key, label in (("map_ms", "map made in every frame"), ("bound_ms", "maps sampled once a garment")):
        right.plot(size, [row[key] for row in trained], marker="o", label=label)
    right.set(
        xscale="log", yscale="log", xlabel="million weights", ylabel="ms", title="A frame of one garment"
    )
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--category", default="trousers", help="of the built-in collection")
    parser.add_argument("--minutes", type=float, default=5, help="training time of a size")
    parser.add_argument("--garments", type=int, default=40, help="garments to train on")
    parser.add_argument("--motions", type=Path, help="folder of further motions")
    parser.add_argument("--hold-out", default="", help="motions kept for the test, separated by commas")
    parser.add_argument("--out", type=Path, default=Path("outputs/drape_sizes"))
    options = parser.parse_args()
    prepare_cpu(1)
    collection = Collection.load("default")
    items = map(collection.item, collection.names())
    bundle = next(item.bundle for item in items if item.bundle.category == options.category)
    rows = []
    for name, network in SIZES.items():
        task = task_of(network, bundle, options)
        folder = options.out / "_".join(name.split(" (")[0].replace(",", "").replace("²", "").split())
        report = train(task, folder, RunOptions(minutes=options.minutes, resume=True))
        rows.append(row_of(name, report.steps, task, bundle))
    rows.append(row_of("built in, fully trained", None, task_of(None, bundle, options), bundle))
    for row in rows:
        print(row)
    details = {"category": options.category, "minutes": options.minutes, "garments": options.garments}
    write_table(options.out, "drape_sizes", rows, meanings=MEANINGS, details=details)
    title = f"D_s of {options.category}, {options.minutes:g} minutes of training a size"
    draw(rows, options.out / "drape_sizes.png", title)


if __name__ == "__main__":
    main()
