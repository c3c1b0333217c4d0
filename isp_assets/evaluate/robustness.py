"""Does any code give a garment? Random, distant, mixed and odd codes, and every resolution.

A decode is good if it raises nothing, is sewn along every seam to a surface with the
openings that the category's garments have, and is hardly folded. What raises a
`DecodeError` is counted and kept with its message; any other exception is a defect and
is let through.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from isp_assets.bundle import GarmentBundle
from isp_assets.decode import decode_with_report
from isp_assets.errors import BundleError, DecodeError, GeometryError, InputError
from isp_assets.fit_options import CodeSpace
from isp_assets.garment import Garment
from isp_assets.geometry.folds import folded_faces
from isp_assets.geometry.topology import boundary_loops, hinges
from isp_assets.train.dataset import GarmentDataset

FOLDED_SHARE = 0.002
"""A garment counts as folded if more than this share of its faces is."""

FIGURES: dict[str, str] = {
    "test": "what the codes are",
    "decodes": "codes decoded",
    "errors": "decodes that ended in a DecodeError, with its reason in the JSON file",
    "unsewn": "garments whose openings are not those of any garment of the bundle",
    "folded": f"garments with more than {100 * FOLDED_SHARE:g} % of their faces folded over",
    "good_percent": "decodes without any of these [%]",
    "folded_percent": "mean share of faces folded over [%]",
    "seam_mm": "mean gap of the seams before sewing [mm]",
    "seconds": "median time of a decode [s]",
}
"""What each figure of a row means."""


@dataclass(frozen=True)
class RobustnessOptions:
    """How much to test."""

    pairs: int = 200
    """Pairs of garments to mix."""
    steps: int = 50
    """Mixtures of a pair, both ends included."""
    random: int = 100
    """Random codes at every radius."""
    radii: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
    """Whitened distance from the mean code, relative to the usual one of the training garments."""
    odd: int = 10
    """Garments whose parameters are pushed out of range, one by one; needs the training data."""
    push: float = 0.5
    """How far beyond the smallest and largest value, relative to the range."""
    resolution: int = 64
    resolutions: tuple[int, ...] = (32, 48, 64, 96, 128, 192, 256, 384, 512)
    garments: int = 5
    """Garments decoded at every resolution."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.pairs, self.random, self.odd, self.garments) < 0 or self.steps < 2:
            raise InputError(
                f"evaluation: counts must be 0 or more, and a pair has 2 mixtures or more; got {self}"
            )


@dataclass(frozen=True, eq=False)
class RobustnessReport:
    """What came of all tests."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """A row a test; see `FIGURES`."""
    errors: list[dict[str, Any]] = field(default_factory=list)
    """Test, number and message of every DecodeError."""


Case = tuple[str, Float[np.ndarray, " Z"], int]
"""Name of the test, code, resolution."""


def evaluate_robustness(
    bundle: GarmentBundle,
    options: RobustnessOptions | None = None,
    *,
    data: GarmentDataset | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> RobustnessReport:
    """Decode many codes of a bundle and count what goes wrong.

    Args:
        bundle: At least two garments.
        options: How much to test.
        data: The training garments, for codes of odd parameters; left out without it.
        progress: Called with (finished, total, test).

    Raises:
        BundleError: If the bundle holds fewer than two garments.
    """
    if len(bundle.codes) < 2:
        raise BundleError(f"bundle {bundle.category!r} has {len(bundle.codes)} garments; mixing takes two")
    options = options or RobustnessOptions()
    cases = list(_cases(bundle, options, data))
    usual = _usual_openings(bundle, options.resolution)
    found: dict[str, list[dict[str, Any]]] = {}
    errors: list[dict[str, Any]] = []
    for number, (test, code, resolution) in enumerate(cases):
        began = time.perf_counter()
        try:
            garment, report = decode_with_report(bundle.model, code, resolution=resolution)
            row = _outcome(garment, usual) | {"seam_mm": 1e3 * report.seam_gap_mean}
        except DecodeError as error:
            row = {"error": True}
            errors.append(
                {"category": bundle.category, "test": test, "number": number, "message": str(error)}
            )
        found.setdefault(test, []).append(row | {"seconds": time.perf_counter() - began})
        progress(number + 1, len(cases), test)
    return RobustnessReport([_summary(bundle.category, test, rows) for test, rows in found.items()], errors)


def _cases(bundle: GarmentBundle, options: RobustnessOptions, data: GarmentDataset | None) -> Iterator[Case]:
    codes = np.stack(list(bundle.codes.values()))
    rng = np.random.default_rng(options.seed)
    size = options.resolution
    for code in codes:
        yield "own codes", code, size
    for _ in range(options.pairs):
        first, second = rng.choice(len(codes), 2, replace=False)
        for share in np.linspace(0, 1, options.steps):
            yield "mixtures", ((1 - share) * codes[first] + share * codes[second]).astype(np.float32), size
    space = CodeSpace.of(codes)
    white = np.stack([space.position(code) for code in codes])
    usual = np.sqrt((white**2).sum(axis=1).mean())
    for radius in options.radii:
        for _ in range(options.random):
            direction = rng.normal(size=codes.shape[1])
            position = radius * usual * direction / np.linalg.norm(direction)
            yield f"random, {radius:g} x radius", space.code(position).astype(np.float32), size
    if data is not None:
        yield from _odd_codes(bundle, data, options, rng)
    for resolution in options.resolutions:
        for code in codes[: options.garments]:
            yield f"{resolution} cells", code, resolution


def _odd_codes(
    bundle: GarmentBundle, data: GarmentDataset, options: RobustnessOptions, rng: np.random.Generator
) -> Iterator[Case]:
    """One parameter of the pattern pushed out of its range and no other, by a linear model of the codes."""
    garments = [g for g in data.garments if g.name in bundle.codes]
    names = [name for name, value in garments[0].parameters.items() if isinstance(value, float)]
    table = np.array([[float(g.parameters[name]) for name in names] for g in garments])
    codes = np.stack([bundle.codes[g.name] for g in garments])
    names = [name for name, spread in zip(names, np.ptp(table, axis=0), strict=True) if spread > 0]
    table = table[:, np.ptp(table, axis=0) > 0]
    design = np.column_stack([table, np.ones(len(table))])
    slopes = np.linalg.lstsq(design, codes.astype(float), rcond=None)[0][:-1]
    chosen = rng.choice(len(codes), min(options.odd, len(codes)), replace=False)
    low, high = table.min(axis=0), table.max(axis=0)
    for column, name in enumerate(names):
        reach = options.push * (high[column] - low[column])
        for end in (low[column] - reach, high[column] + reach):
            for index in chosen:
                code = codes[index] + (end - table[index, column]) * slopes[column]
                yield f"odd {name}", code.astype(np.float32), options.resolution


def _usual_openings(bundle: GarmentBundle, resolution: int) -> set[int]:
    """Numbers of border loops that the bundle's garments have; what fewer than three share is an accident."""
    counts: dict[int, int] = {}
    for code in list(bundle.codes.values())[:60]:
        try:
            garment, _ = decode_with_report(bundle.model, code, resolution=resolution)
        except DecodeError:
            continue
        loops = _openings(garment)
        counts[loops] = counts.get(loops, 0) + 1
    enough = min(3, len(bundle.codes))
    return {loops for loops, count in counts.items() if count >= enough} or set(counts)


def _openings(garment: Garment) -> int:
    """Number of border loops; -1 where two of them touch."""
    try:
        return len(boundary_loops(garment.faces))
    except GeometryError:
        return -1


def _outcome(garment: Garment, usual: set[int]) -> dict[str, Any]:
    folded = folded_faces(
        garment.rest_vertices.astype(np.float64), garment.faces, hinges(garment.faces).faces
    )
    return {
        "unsewn": _openings(garment) not in usual,
        "share": float(folded.mean()),
    }


def _summary(category: str, test: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    good: list[Mapping[str, Any]] = [row for row in rows if "error" not in row]
    unsewn = sum(row["unsewn"] for row in good)
    folded = sum(row["share"] > FOLDED_SHARE for row in good)
    bad = sum(row["unsewn"] or row["share"] > FOLDED_SHARE for row in good) + len(rows) - len(good)
    summary: dict[str, Any] = {
        "category": category, "test": test, "decodes": len(rows), "errors": len(rows) - len(good),
        "unsewn": unsewn, "folded": folded, "good_percent": 100 * (1 - bad / len(rows)),
    }  # fmt: skip
    if good:
        summary["folded_percent"] = 100 * float(np.mean([row["share"] for row in good]))
        summary["seam_mm"] = float(np.mean([row["seam_mm"] for row in good]))
    summary["seconds"] = float(np.median([row["seconds"] for row in rows]))
    return summary
