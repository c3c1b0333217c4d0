"""Rest shapes against the garments they should be: the figures of the paper's Table 1, and more.

Training garments are decoded from their own codes; test garments are first fitted, code
only. Any method that decodes and fits takes part: ours, and peers to compare with.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 4.2 and Table 1.
"""

import runpy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from isp_assets.alignment import Alignment
from isp_assets.bundle import GarmentBundle
from isp_assets.decode import decode_with_report
from isp_assets.errors import DatasetError, GeometryError, InputError, IspAssetsError, PluginError
from isp_assets.evaluate.memory import PeakMemory
from isp_assets.fit import Fitter
from isp_assets.fit_options import FitOptions
from isp_assets.geometry.surface_distance import Surface, surface_distance
from isp_assets.train.dataset import GarmentDataset, TrainingGarment

Code = Float[np.ndarray, " Z"]

FIGURES: dict[str, str] = {
    "garments": "garments measured",
    "failures": "garments that could not be fitted or decoded",
    "mean_mm": "distance from samples to triangles, both ways: mean of the garments' means [mm]",
    "p95_mm": "mean of the garments' 95th percentiles [mm]",
    "max_mm": "largest of all garments [mm]",
    "chd_1e4": "Chamfer distance x 1e4, squares of both ways, in halves of the category's largest diagonal",
    "floor_1e4": "what two samplings of the true surface give for it",
    "nc_percent": "normal consistency, |cosine| at nearest samples [%]",
    "nc_signed_percent": "the same with its sign [%]",
    "seam_mm": "mean gap of the seams before sewing [mm]",
    "cold_s": "the first decode of the row [s]",
    "warm_s": "median of the others [s]",
    "peak_mib": "memory that a decode takes on top, at its peak [MiB]",
    "fit_s": "median time of a fit [s]",
}
"""What each figure of a row means."""


@dataclass(frozen=True, eq=False)
class Decoded:
    """A garment as a method gives it."""

    surface: Surface
    seam_gap: float | None = None
    """Mean gap of the seams before sewing [m], where there are seams."""


@runtime_checkable
class Reconstructor(Protocol):
    """A way to get surfaces from codes and codes from surfaces, for one category."""

    name: str

    @property
    def codes(self) -> Mapping[str, Code]:
        """Codes of the training garments, by name."""

    def decode(self, code: Code, resolution: int) -> Decoded:
        """The surface of a code in the rest pose [m]; raises GeometryError if there is none."""

    def fit(self, surface: Surface) -> Code:
        """The code of an unseen surface in the rest pose [m]."""


class IspReconstructor:
    """The method of this package."""

    name = "ISP"

    def __init__(self, bundle: GarmentBundle, options: FitOptions | None = None) -> None:
        self.bundle = bundle
        self._fitter = Fitter(bundle, options)

    @property
    def codes(self) -> Mapping[str, Code]:
        return self.bundle.codes

    def decode(self, code: Code, resolution: int) -> Decoded:
        garment, report = decode_with_report(self.bundle.model, code, resolution=resolution)
        return Decoded(Surface(garment.rest_vertices, garment.faces), report.seam_gap_mean)

    def fit(self, surface: Surface) -> Code:
        return self._fitter.fit(surface, alignment=Alignment()).code


@dataclass(frozen=True)
class ReconstructionOptions:
    """How much to measure."""

    resolutions: tuple[int, ...] = (128, 256, 512)
    garments: int = 20
    """Training garments and test garments measured, evenly drawn."""
    finest: int = 6
    """Of these, how many at the finest resolution."""
    samples: int = 100_000
    """Points on each surface."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.resolutions or min(*self.resolutions, self.garments, self.finest, self.samples) < 1:
            raise InputError(
                "evaluation: expected at least one resolution, garment, garment at the finest resolution "
                f"and sample; got {self}"
            )

    def resolutions_of(self, index: int, count: int) -> tuple[int, ...]:
        """Those measured for a garment; of several, the finest only for some garments, evenly drawn."""
        chosen = np.unique(np.linspace(0, count - 1, min(self.finest, count)).astype(int))
        if len(self.resolutions) == 1 or index in chosen:
            return self.resolutions
        return tuple(r for r in self.resolutions if r != max(self.resolutions))


@dataclass
class ReconstructionTable:
    """Rows of a comparison, and what they are means of."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """A row for every method, category, split and resolution; see `FIGURES`."""
    garments: list[dict[str, Any]] = field(default_factory=list)
    """A row for every garment."""


def evaluate_reconstruction(
    methods: Sequence[Reconstructor],
    data: Mapping[str, GarmentDataset],
    options: ReconstructionOptions | None = None,
    *,
    progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> ReconstructionTable:
    """Measure methods on one category.

    Args:
        methods: What to compare, all on the same garments.
        data: Garments by split, "train" and "test".
        options: How much to measure.
        progress: Called with (finished, total, text) after every garment.

    Raises:
        DatasetError: If a method has no code for one of the training garments chosen.
    """
    options = options or ReconstructionOptions()
    table = ReconstructionTable()
    unit = half_diagonal(data["train"])
    chosen = {split: _chosen(dataset, options.garments) for split, dataset in data.items()}
    _check_codes(methods, chosen["train"])
    total, done = len(methods) * sum(map(len, chosen.values())), 0
    for method in methods:
        for split, garments in chosen.items():
            measured: list[dict[str, Any]] = []
            for index, garment in enumerate(garments):
                resolutions = options.resolutions_of(index, len(garments))
                measured += _measure(method, garment, split, resolutions, options, unit)
                done += 1
                progress(done, total, f"{method.name}, {split}: {garment.name}")
            table.garments += measured
            table.rows += _rows(measured, options.resolutions)
    return table


def load_peer(text: str, category: str) -> Reconstructor:
    """A method from a Python file of the user's, given as ``FILE.py=ARGUMENT``.

    The file defines ``reconstructor(argument: str, category: str) -> Reconstructor``;
    ``{category}`` in the argument is filled in.

    Raises:
        PluginError: If the file is missing or broken.
    """
    file, _, argument = text.partition("=")
    try:
        make = runpy.run_path(file)["reconstructor"]
        return make(argument.replace("{category}", category), category)
    except IspAssetsError:
        raise
    except Exception as error:  # a foreign file may fail in any way
        raise PluginError(
            f"peer {file!r} cannot be used ({type(error).__name__}: {error}); expected a Python file with a "
            "function reconstructor(argument, category)"
        ) from error


def half_diagonal(dataset: GarmentDataset) -> float:
    """Half of the largest diagonal of a category's bounding boxes [m]: the unit of its Chamfer distances."""
    return 0.5 * max(float(np.linalg.norm(np.ptp(g.rest_vertices, axis=0))) for g in dataset.garments)


def garment_surface(garment: TrainingGarment) -> Surface:
    """The sewn rest shape of a training garment."""
    return Surface(garment.rest_vertices, garment.faces.astype(np.int64))


def _chosen(dataset: GarmentDataset, count: int) -> list[TrainingGarment]:
    index = np.unique(np.linspace(0, len(dataset.garments) - 1, count).astype(int))
    return [dataset.garments[k] for k in index]


def _check_codes(methods: Sequence[Reconstructor], garments: Sequence[TrainingGarment]) -> None:
    for method in methods:
        if missing := [g.name for g in garments if g.name not in method.codes]:
            raise DatasetError(
                f"{method.name} has no code for the training garment {missing[0]!r} and {len(missing) - 1} "
                "others; was it trained on this data set?"
            )


def _measure(
    method: Reconstructor, garment: TrainingGarment, split: str, resolutions: Sequence[int],
    options: ReconstructionOptions, unit: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """Figures of one garment at every resolution."""
    truth = garment_surface(garment)
    head: dict[str, Any] = {
        "method": method.name,
        "category": garment.category,
        "split": split,
        "garment": garment.name,
    }
    try:
        began = time.perf_counter()
        if split == "train":
            code = method.codes[garment.name]
        else:
            code = method.fit(truth)
            head["fit_s"] = time.perf_counter() - began
    except GeometryError as error:
        return [{**head, "resolution": r, "error": str(error)} for r in resolutions]
    head["code"] = [float(value) for value in code]
    rows = []
    for resolution in resolutions:
        row = {**head, "resolution": resolution}
        try:
            with PeakMemory() as memory:
                began = time.perf_counter()
                decoded = method.decode(code, resolution)
                row["decode_s"] = time.perf_counter() - began
            row["peak_mib"] = memory.mib
            row |= _figures(decoded, truth, options, unit)
        except GeometryError as error:
            row["error"] = str(error)
        rows.append(row)
    return rows


def _figures(decoded: Decoded, truth: Surface, options: ReconstructionOptions, unit: float) -> dict[str, Any]:
    found = asdict(
        surface_distance(decoded.surface, truth, unit=unit, samples=options.samples, seed=options.seed)
    )
    return {
        "mean_mm": 1e3 * found["mean"],
        "p95_mm": 1e3 * found["p95"],
        "max_mm": 1e3 * found["max"],
        "chd_1e4": 1e4 * found["chamfer"],
        "floor_1e4": 1e4 * found["chamfer_floor"],
        "nc_percent": 100 * found["normal_consistency"],
        "nc_signed_percent": 100 * found["signed_normal_consistency"],
        "seam_mm": None if decoded.seam_gap is None else 1e3 * decoded.seam_gap,
        "vertices": len(decoded.surface.vertices),
    }


def _rows(measured: Sequence[Mapping[str, Any]], resolutions: Sequence[int]) -> list[dict[str, Any]]:
    """One row a resolution: means over the garments that came through, and the number that did not."""
    result = []
    for resolution in resolutions:
        every = [row for row in measured if row["resolution"] == resolution]
        good = [row for row in every if "error" not in row]
        if not every:
            continue
        row = {key: every[0][key] for key in ("method", "category", "split", "resolution")}
        row |= {"garments": len(every), "failures": len(every) - len(good)}
        if good:
            means = ("mean_mm", "p95_mm", "chd_1e4", "floor_1e4", "nc_percent", "nc_signed_percent")
            row |= {key: float(np.mean([g[key] for g in good])) for key in means}
            row["max_mm"] = max(g["max_mm"] for g in good)
            gaps = [g["seam_mm"] for g in good if g["seam_mm"] is not None]
            row["seam_mm"] = float(np.mean(gaps)) if gaps else None
            times = [g["decode_s"] for g in good]
            row |= {"cold_s": times[0], "warm_s": float(np.median(times[1:] or times))}
            memory = [g["peak_mib"] for g in good if g["peak_mib"] is not None]
            row["peak_mib"] = max(memory) if memory else None
            fits = [g["fit_s"] for g in good if "fit_s" in g]
            row["fit_s"] = float(np.median(fits)) if fits else None
        result.append(row)
    return result
