"""Time a decode by stage, cold and warm, against the paper-size networks on the full grid.

Run:  python tests/bench/bench_decode.py --out outputs/bench_decode

The paper's way evaluates both panel fields, labels included, at every point of the grid,
and the atlases at every point inside; its networks are 256 wide. Tracing the outline and
triangulating would come on top, so the ratio is a lower bound. Weights are random: they
do not change the time. Everything is timed in one process on one thread.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isp_assets.collection import Collection
from isp_assets.conventions import PANELS
from isp_assets.decode import decode_with_report
from isp_assets.evaluate.memory import PeakMemory
from isp_assets.evaluate.table import machine, write_table
from isp_assets.garment_model import GarmentModel
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig
from isp_assets.train.cpu import prepare_cpu

MEANINGS = {
    "resolution": "grid cells across a panel",
    "vertices": "of the decoded garment, mean",
    "cold_ms": "the first decode at this resolution",
    "warm_ms": "median of the others",
    "cut_ms": "finding the outlines, median",
    "sew_ms": "sewing and triangulating, median",
    "lift_ms": "lifting to the body, median",
    "evaluated_percent": "grid points at which a panel field is evaluated",
    "full_grid_ms": "networks of the paper's size on the whole grid, both panels",
    "times_faster": "full_grid_ms / warm_ms",
    "peak_mib": "memory that a decode takes on top, at its peak",
}


def full_grid(model: GarmentModel, codes: dict[str, np.ndarray], resolution: int) -> float:
    """Seconds that the networks of the paper's size take for one garment on the full grid."""
    fields = {side: PanelField(PanelFieldConfig.paper(model.num_labels)).eval() for side in PANELS}
    atlases = {side: Atlas(AtlasConfig.paper()).eval() for side in PANELS}
    axis = torch.linspace(-1, 1, resolution + 1)
    xy = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).reshape(-1, 2)
    own_code = torch.from_numpy(next(iter(codes.values())))
    code = torch.randn(PanelFieldConfig.paper(model.num_labels).code_size)
    with torch.no_grad():
        inside = {side: xy[model.panel_fields[side].signed_distance(xy, own_code) < 0] for side in PANELS}
        began = time.perf_counter()
        for side in PANELS:
            for part in xy.split(2**16):
                fields[side](part, code)
            for part in inside[side].split(2**16):
                atlases[side](part, code)
        return time.perf_counter() - began


def measure(model: GarmentModel, codes: dict[str, np.ndarray], resolution: int) -> dict[str, Any]:
    """One row: every garment decoded once, the first of them cold."""
    times, reports, vertices = [], [], []
    with PeakMemory() as memory:
        for code in codes.values():
            began = time.perf_counter()
            garment, report = decode_with_report(model, code, resolution=resolution)
            times.append(time.perf_counter() - began)
            reports.append(report)
            vertices.append(garment.num_vertices)
    warm, whole = float(np.median(times[1:])), full_grid(model, codes, resolution)
    row: dict[str, Any] = {"category": model.category, "resolution": resolution}
    row |= {"vertices": int(np.mean(vertices)), "cold_ms": 1e3 * times[0], "warm_ms": 1e3 * warm}
    row |= {
        f"{s}_ms": 1e3 * float(np.median([r.seconds[s] for r in reports])) for s in ("cut", "sew", "lift")
    }
    row["evaluated_percent"] = 100 * float(np.mean([r.evaluated_share for r in reports]))
    return row | {"full_grid_ms": 1e3 * whole, "times_faster": whole / warm, "peak_mib": memory.mib}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_decode"))
    parser.add_argument("--collection", default="default")
    parser.add_argument("--garments", type=int, default=7, help="decoded at every resolution")
    options = parser.parse_args()
    prepare_cpu(1)
    collection, rows = Collection.load(options.collection), []
    for bundle in map(collection.bundle, collection.bundle_files()):
        codes = dict(list(bundle.codes.items())[: options.garments])
        for resolution in (32, 64, 128, 256, 512):
            rows.append(measure(bundle.model, codes, resolution))
            print({key: round(v, 1) if isinstance(v, float) else v for key, v in rows[-1].items()})
    write_table(options.out, "decode", rows, meanings=MEANINGS, details={})
    print(f"wrote {options.out} ({machine()['platform']})")


if __name__ == "__main__":
    main()
