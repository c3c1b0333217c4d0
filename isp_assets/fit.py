"""Recover the latent code of a garment from a surface: a mesh in the rest pose of its category.

The code alone is optimised, through the differentiable decode of Eq. 5. The panels are
cut a few times; between cuts the border follows the code to first order, and Gauss-Newton
steps with closest points found anew lower the distance. The search starts from the mean
code and from the garments most like the target, and goes on from the best of these.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 5 and Section 4.2.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from isp_assets.alignment import Alignment, detect_alignment
from isp_assets.bundle import GarmentBundle
from isp_assets.code_file import GarmentCode
from isp_assets.collection import Collection
from isp_assets.decode import RESOLUTIONS
from isp_assets.errors import DecodeError, GeometryError, MeshError
from isp_assets.fit_objective import Target
from isp_assets.fit_options import CodeSpace, FitOptions
from isp_assets.fit_search import Search, SearchState
from isp_assets.garment_clouds import GarmentClouds
from isp_assets.geometry.surface_distance import Surface, SurfaceDistance, surface_distance

_CHOICE_SAMPLES, _CHOICE_GARMENTS = 600, 50
_TRIALS = 0.4  # share of the progress when every start was tried


@dataclass(frozen=True, eq=False)
class Fit:
    """A recovered code, and how close it comes."""

    code: Float[np.ndarray, " Z"]
    alignment: Alignment
    """From the target's space to that of the rest body."""
    distance: SurfaceDistance
    """Of the decoded garment from the target."""
    start: str
    """Where the fit began: a garment of the bundle, or "mean"."""
    energy: float
    """What is left of the objective [mm^2]."""
    evaluations: int
    """Times that the objective was evaluated."""
    seconds: float
    surface: Surface
    """The decoded garment, in the space of the rest body [m]."""

    def as_code(self, bundle: GarmentBundle, name: str) -> GarmentCode:
        """The code as it is stored, with what is known of its fit."""
        notes = {
            "alignment": asdict(self.alignment), "distance_m": asdict(self.distance), "start": self.start,
            "energy_mm2": self.energy, "evaluations": self.evaluations, "seconds": self.seconds,
        }  # fmt: skip
        return GarmentCode(name, bundle.category, self.code, bundle.model_sha256, notes)

    def summary(self, category: str) -> list[str]:
        """Lines for a person."""
        found, place = self.distance, self.alignment
        moved = (
            "" if not any(place.translation) else f", moved by {np.round(place.translation, 3).tolist()} m"
        )
        return [
            f"{category}, read in {place.unit}, {place.up} up, turned by {place.turn} degrees{moved}",
            f"point to triangle: mean {1e3 * found.mean:.2f} mm, 95 % within {1e3 * found.p95:.2f} mm, "
            f"largest {1e3 * found.max:.1f} mm; normals agree to {100 * found.normal_consistency:.1f} %",
            f"from {self.start!r}, {self.evaluations} evaluations, {self.seconds:.1f} s",
        ]


def choose_bundle(
    collection: Collection,
    surface: Surface,
    *,
    category: str | None = None,
    alignment: Alignment | None = None,
) -> GarmentBundle:
    """The bundle that holds the garment most like a surface, of one category if it is given.

    Raises:
        MeshError: If the collection has no such category, or the surface the size of no garment.
    """
    bundles = {file: collection.bundle(file) for file in collection.bundle_files()}
    known = dict.fromkeys(bundle.category for bundle in bundles.values())
    if category is not None:
        bundles = {file: bundle for file, bundle in bundles.items() if bundle.category == category}
    if not bundles:
        raise MeshError(
            f"collection {collection.name!r} has no category {category!r}; it has {', '.join(known)}"
        )
    if len(bundles) == 1:
        return next(iter(bundles.values()))
    scores: dict[str, float] = {}
    for file, bundle in bundles.items():
        codes = np.stack(list(bundle.codes.values()))
        some = np.unique(np.linspace(0, len(codes) - 1, _CHOICE_GARMENTS).astype(int))
        clouds = GarmentClouds.build(bundle.model, codes[some])
        try:
            place = alignment or detect_alignment(surface, clouds)
        except MeshError:
            continue
        points, _ = place.apply(surface).sample(_CHOICE_SAMPLES, np.random.default_rng(0))
        scores[file] = float(clouds.distances(points).min())
    if not scores:
        raise MeshError(
            f"in no unit has the mesh the size of a garment ({', '.join(known)}); give --align, or scale it"
        )
    return bundles[min(scores, key=scores.__getitem__)]


def _within(progress: Callable[[float, str], None], done: float, part: float) -> Callable[[float, str], None]:
    return lambda share, text: progress(done + share * part, text)


class Fitter:
    """Fits codes of one bundle; what no target changes is prepared once.

    Args:
        bundle: The category's networks, and the garments to start from.
        options: How thoroughly to fit.
    """

    def __init__(self, bundle: GarmentBundle, options: FitOptions | None = None) -> None:
        if not bundle.codes:
            raise GeometryError(
                f"bundle {bundle.category!r} holds no garment; a fit starts from its garments"
            )
        self.bundle, self.options = bundle, options or FitOptions()

    @cached_property
    def clouds(self) -> GarmentClouds:
        """A cloud of every garment of the bundle."""
        return GarmentClouds.build(self.bundle.model, np.stack(list(self.bundle.codes.values())))

    @cached_property
    def _space(self) -> CodeSpace:
        return CodeSpace.of(np.stack(list(self.bundle.codes.values())))

    def fit(
        self,
        surface: Surface,
        *,
        alignment: Alignment | None = None,
        progress: Callable[[float, str], None] = lambda share, text: None,
    ) -> Fit:
        """Find the code whose garment is closest to a surface.

        Args:
            surface: In any space if ``alignment`` is None, which lets it be detected.
            alignment: From the surface's space to that of the rest body [m].
            progress: Called with the share done (0 to 1) and a line of text.

        Raises:
            MeshError: If the surface has not the size of a garment in any unit.
            DecodeError: If no start decodes, or the code found decodes at its own resolution alone.
        """
        began, options = time.perf_counter(), self.options
        place = alignment or detect_alignment(surface, self.clouds)
        target = Target(place.apply(surface), samples=options.samples)
        # Where a mesh had to be moved, its place is known to a few centimetres only.
        search = Search(self.bundle.model, self._space, target, options, movable=any(place.translation))
        found = self._starts(search, progress)[: options.finalists]
        ends: list[Fit] = []
        faults: list[DecodeError] = []
        for index, start in enumerate(found):
            part = (1 - _TRIALS) / len(found)
            state = search.settle(start, _within(progress, _TRIALS + index * part, part))
            try:
                ends.append(self._finish(state, surface, place))
            except DecodeError as error:
                faults.append(error)
        if not ends:
            raise faults[0]
        # The energy also weighs normals, borders and the prior: of two ends the closer one is meant.
        best = min(ends, key=lambda end: end.distance.mean)
        progress(1.0, f"mean distance {1000 * best.distance.mean:.2f} mm")
        return replace(best, evaluations=search.evaluations, seconds=time.perf_counter() - began)

    def _finish(self, state: SearchState, surface: Surface, place: Alignment) -> Fit:
        code = self._space.code(state.position).astype(np.float32)
        garment = self.bundle.decode(code, resolution=min(2 * self.options.resolution, RESOLUTIONS[1]))
        made, place = Surface(garment.rest_vertices, garment.faces), place.moved(-state.shift)
        distance = surface_distance(made, place.apply(surface), samples=20_000)
        return Fit(code, place, distance, state.start, state.energy, 0, 0.0, made)

    def _starts(self, search: Search, progress: Callable[[float, str], None]) -> list[SearchState]:
        """Where a few short rounds lead from every start, the best first."""
        codes, options = list(self.bundle.codes.items()), self.options
        near = self.clouds.nearest(search.target.points, options.neighbours)
        starts: Mapping[str, np.ndarray] = {codes[k][0]: codes[k][1] for k in near}
        starts = {**starts, "mean": self._space.mean}
        found, faults = [], []
        for index, (name, code) in enumerate(starts.items()):
            progress(_TRIALS * index / len(starts), f"from {name}")
            state = search.begin(code, name)
            try:
                for _ in range(options.trial_rounds):
                    state = search.round(state, options.trial_iterations)
            except DecodeError as error:
                faults.append(f"{name}: {error}")
            else:
                found.append(state)
        if not found:
            raise DecodeError(
                f"no start of the fit decodes ({'; '.join(faults)}); "
                f"is the bundle {self.bundle.category!r} trained?"
            )
        return sorted(found, key=lambda state: state.energy)
