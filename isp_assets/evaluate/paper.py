"""Figures of the paper, to print beside ours. They were measured on other garments and another machine.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Table 1.
"""

from typing import Any

_TABLE_1 = (
    ("ISP", "train", (128, 0.454, 99.20, 0.025), (256, 0.290, 99.37, 0.077), (512, 0.250, 99.41, 0.261)),
    ("ISP", "test", (128, 0.579, 98.70, None), (256, 0.392, 98.83, None), (512, 0.349, 98.89, None)),
    ("UDF", "train", (128, 0.641, 98.86, 0.601), (256, 0.338, 99.20, 2.379), (512, 0.262, 98.77, 13.258)),
    ("UDF", "test", (128, 0.803, 97.71, None), (256, 0.493, 98.44, None), (512, 0.424, 98.09, None)),
)  # fmt: skip
PAPER_SHIRTS: tuple[dict[str, Any], ...] = tuple(
    {
        "method": f"{method} of the paper (quoted)", "category": "shirt", "split": split,
        "resolution": resolution, "chd_1e4": chd, "nc_percent": nc, "warm_s": seconds,
    }
    for method, split, *rows in _TABLE_1
    for resolution, chd, nc, seconds in rows
)  # fmt: skip
"""Table 1 of the paper, on its own data and on a V100: quoted, not measured here."""
