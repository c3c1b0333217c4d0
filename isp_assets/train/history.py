"""The table of a training run, and its drawing."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from isp_assets.files import write_text


class History:
    """Rows of numbers by column name, kept in a CSV file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float | int]] = []

    def take_up(self, step: int) -> None:
        """Read the rows that an earlier run wrote up to ``step``; later ones are forgotten."""
        if not self.path.is_file():
            return
        with self.path.open(newline="", encoding="utf-8") as file:
            rows = [
                {name: _number(value) for name, value in row.items() if value} for row in csv.DictReader(file)
            ]
        self.rows = [row for row in rows if row["step"] <= step]

    def add(self, row: Mapping[str, float | int]) -> None:
        """Append a row and write the file."""
        self.rows.append(dict(row))
        text = io.StringIO()
        writer = csv.DictWriter(text, self.columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.path, text.getvalue())

    @property
    def columns(self) -> list[str]:
        """Names of all columns, in the order they first appeared."""
        return list(dict.fromkeys(name for row in self.rows for name in row))

    def draw(self, path: Path, *, title: str) -> bool:
        """Draw losses and metrics over the steps; False if matplotlib is not installed."""
        try:
            from matplotlib.figure import Figure
        except ImportError:
            return False
        groups = [[c for c in self.columns if c.startswith(kind)] for kind in ("loss.", "metric.")]
        figure = Figure(figsize=(11, 4), layout="constrained")
        figure.suptitle(title)
        for axes, names in zip(figure.subplots(1, 2), groups, strict=True):
            for name in names:
                points = [(row["step"], row[name]) for row in self.rows if name in row]
                axes.plot(*zip(*points, strict=True), marker="." if len(points) < 20 else "", label=name)
            axes.set(xlabel="step", yscale="log")
            axes.grid(alpha=0.3)
            if names:
                axes.legend(fontsize=7)
        figure.savefig(path, dpi=110, metadata={"Software": None})
        return True


def _number(text: str) -> int | float:
    """A whole number stays one, so that a resumed table reads as an uninterrupted one."""
    return int(text) if text.lstrip("-").isdigit() else float(text)
