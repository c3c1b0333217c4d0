"""Tables of figures as files: CSV and JSON for programs, Markdown for people; and on the terminal."""

import csv
import io
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import isp_assets
from isp_assets.files import write_text

Row = Mapping[str, Any]


def write_table(
    folder: Path, name: str, rows: Sequence[Row], *, meanings: Mapping[str, str], details: Mapping[str, Any],
) -> None:  # fmt: skip
    """Write ``NAME.csv``, ``NAME.json`` and ``NAME.md``.

    Args:
        folder: Made if missing.
        name: Stem of the files.
        rows: Figures by column name; columns may be missing from some rows.
        meanings: What each column means, for the Markdown file and the JSON file.
        details: Whatever else the JSON file keeps; plain JSON values.
    """
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / f"{name}.csv", text.getvalue())
    content = {"machine": machine(), "meanings": dict(meanings), "rows": list(rows), **details}
    write_text(folder / f"{name}.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(cell(row.get(key)) for key in columns) + " |" for row in rows]
    notes = [f"- `{key}`: {meaning}" for key, meaning in meanings.items() if key in columns]
    where = ", ".join(f"{key} {value}" for key, value in machine().items())
    write_text(folder / f"{name}.md", "\n".join([*lines, "", *notes, "", f"Measured on: {where}."]) + "\n")


def cell(value: Any) -> str:
    """A value as a person reads it: four significant digits, nothing for None."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def machine(device: str = "cpu") -> dict[str, Any]:
    """What figures were measured on."""
    return {
        "device": device if device == "cpu" else torch.cuda.get_device_name(device),
        "threads": torch.get_num_threads(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "isp_assets": isp_assets.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
    }
