"""Drape every stress case, measure it, and find the value at which each sweep first fails.

Every finished case is kept in ``cases/`` of the output folder, so a run that was cut
off goes on where it stopped. Nothing is left out: a case that cannot be draped is a
row with its error, and the values of its sweep are then tried one by one.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import isp_assets
from isp_assets.errors import IspAssetsError
from isp_assets.evaluate.criteria import CRITERIA, failures
from isp_assets.evaluate.draping_pictures import Picture, draw
from isp_assets.evaluate.stress_case import StressCase, StressRun
from isp_assets.evaluate.stress_measures import Measured, measure
from isp_assets.files import write_text

LIMITS: dict[str, str] = {
    "parameter": "what is swept",
    "good_up_to": "last value before the first failure",
    "fails_at": "first value at which a criterion does not hold",
    "fails_first": "which ones, there",
    "each": "where every criterion that does not hold throughout first fails",
    "at_the_end": "what the hardest value gives",
    "end_value": "the hardest value",
}
"""What each column of the limits means, after ``test`` and ``case``."""


@dataclass
class DrapingTable:
    """All rows of all cases."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """A row for every value of every sweep; see `stress_measures.FIGURES`."""

    @property
    def limits(self) -> list[dict[str, Any]]:
        """Where every sweep first fails; see `LIMITS`."""
        return find_limits(self.rows)


def evaluate_draping(
    cases: Sequence[StressCase],
    out: Path,
    *,
    networks: str,
    pictures: bool = True,
    progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> DrapingTable:
    """Drape and measure cases.

    Args:
        cases: What to drape.
        out: Finished cases go to ``out/cases``, and are not draped again as long as
            nothing they depend on has changed; pictures of every test's worst frame to ``out/pictures``.
        networks: Digest of the collection; see `digest_of`.
        pictures: Whether to draw.
        progress: Called with (finished, total, name of the next case).
    """
    table, worst = DrapingTable(), dict[str, float]()
    for number, case in enumerate(cases):
        progress(number, len(cases), f"{case.test} {case.label}")
        path = out / "cases" / f"{case.key}.json"
        mark = case.fingerprint(f"{isp_assets.__version__} {networks}")
        found = _finished(path, mark)
        if found is None:
            found = _measured(case, worst.get(case.test, 0.0), out if pictures else None)
            write_text(path, json.dumps({"mark": mark, **found}, indent=1, allow_nan=False) + "\n")
        worst[case.test] = max(worst.get(case.test, 0.0), found["severity"])
        table.rows += found["rows"]
    progress(len(cases), len(cases), "done")
    return table


def digest_of(folder: Path) -> str:
    """Digest of the files of a collection."""
    digest = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        if path.suffix in (".safetensors", ".toml"):
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def find_limits(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For every sweep, the first row that fails, and what the last row gives.

    Args:
        rows: Rows of the draping table; a sweep's values in their order, from harmless to hard.
    """
    sweeps: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        sweeps.setdefault((row["test"], row["case"]), []).append(row)
    return [_limit(test, label, sweep) for (test, label), sweep in sweeps.items()]


def layer_times(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """A straight line through the seconds a frame over the number of mixed layers (T6).

    Returns:
        Slope [s a layer], offset [s], and the share of the variance that the line explains; or
        nothing where fewer than three numbers of layers were draped.
    """
    found = [
        (row["layers"], row["seconds"]) for row in rows if row["case"] == "mixed layers" and "seconds" in row
    ]
    if len(found) < 3:
        return {}
    layers, seconds = np.array(found, float).T
    slope, offset = np.polyfit(layers, seconds, 1)
    rest = seconds - slope * layers - offset
    return {
        "seconds_a_layer": float(slope),
        "offset_seconds": float(offset),
        "explained": float(1 - rest.var() / max(seconds.var(), 1e-30)),
    }


def _limit(test: str, label: str, sweep: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    bad = next((k for k, row in enumerate(sweep) if not row["passed"]), None)
    last = sweep[-1]
    if last.get("error"):
        end = f"stops: {last['error']}"
    else:
        end = f"finite; {last['failed']}" if last["failed"] else "all criteria hold"
    row: dict[str, Any] = {"test": test, "case": label, "parameter": last["parameter"]}
    if bad is not None:
        row |= {
            "good_up_to": sweep[bad - 1]["value"] if bad else None,
            "fails_at": sweep[bad]["value"],
            "fails_first": sweep[bad]["failed"],
        }
    else:
        row |= {"good_up_to": last["value"], "fails_at": None, "fails_first": ""}
    return row | {"each": _each(sweep), "end_value": last["value"], "at_the_end": end}


def _each(sweep: Sequence[Mapping[str, Any]]) -> str:
    first: dict[str, float] = {}
    for row in reversed(sweep):
        first |= {c.column: row["value"] for c in CRITERIA if c.severity(row) > 1}
        first |= {"error": row["value"]} if row.get("error") else {}
    return "; ".join(f"{column} at {value:g}" for column, value in first.items())


def _finished(path: Path, mark: str) -> dict[str, Any] | None:
    """What a case gave, if it has been draped with the same inputs."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {"rows": stored["rows"], "severity": stored["severity"]} if stored["mark"] == mark else None
    except (OSError, ValueError, KeyError):
        return None


def _measured(case: StressCase, worst: float, out: Path | None) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    bad = 0.0
    for part in _parts(case):
        if isinstance(part, dict):
            rows.append(part)
            continue
        done, run, found = part
        rows += found.rows
        if out is not None and found.severity > max(bad, worst) and not _broken(run, found.worst):
            draw(Picture.of(done, run, found.worst, found.severity), out / "pictures" / f"{case.test}.png")
        bad = max(bad, found.severity)
    return {"rows": rows, "severity": min(bad, 1e9)}


def _parts(case: StressCase) -> "list[dict[str, Any] | tuple[StressCase, StressRun, Measured]]":
    """The whole case; or, where it cannot be draped whole, value by value."""
    try:
        run = case.drape()
        return [(case, run, measure(case, run))]
    except Exception as error:  # any failure is a finding, also one that nobody raised on purpose
        values = np.array(case.values)
        different = list(dict.fromkeys(case.values))
        if len(different) > 1:
            return [found for value in different for found in _parts(case.part(values == value))]
        return [_error_row(case, error)]


def _error_row(case: StressCase, error: Exception) -> dict[str, Any]:
    text = str(error) if isinstance(error, IspAssetsError) else f"{type(error).__name__}: {error}"
    row: dict[str, Any] = {
        "test": case.test, "case": case.label, "parameter": case.parameter, "value": case.values[0],
        "frames": len(case.values), "layers": len(case.outfit), "error": text,
    }  # fmt: skip
    return row | {"passed": False, "failed": "; ".join(failures(row))}


def _broken(run: StressRun, frame: int) -> bool:
    return not all(np.isfinite(layer[frame]).all() for layer in run.layers)
