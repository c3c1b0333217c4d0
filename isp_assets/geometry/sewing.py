"""Sewing of two flat panels along edges with matching labels. It knows labels, not garments.

Front and back lie in one plane, both outlines run counter-clockwise, and the back
is turned over. So sewn edges run alike, and the sewn surface is oriented.
Both sides of a seam get equally many points, at equal shares of their lengths.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from isp_assets.conventions import PANELS
from isp_assets.errors import GeometryError
from isp_assets.geometry.chords import split_chords
from isp_assets.geometry.edge_runs import EdgeRun, dissolve, join_alike
from isp_assets.geometry.outline import resample_open
from isp_assets.geometry.seam_fade import SeamFade, seam_fade
from isp_assets.geometry.topology import edges, weld
from isp_assets.geometry.triangulate import triangulate_panel

Loop = tuple[EdgeRun, ...]
_NONE = np.empty(0, dtype=np.int64)
_MIN_EDGES = 2
"""Fewest edges on a run: with one, the two sides of a short opening would close it."""


@dataclass(frozen=True, eq=False)
class FlatPanel:
    """One triangulated panel."""

    points: Float[np.ndarray, "P 2"]
    """Border points first, loop by loop."""
    faces: Int[np.ndarray, "F 3"]
    """Counter-clockwise on the front, clockwise on the back: outward once sewn."""
    vertex_index: Int[np.ndarray, " P"]
    """Sewn vertex of every point."""
    border_label: Int[np.ndarray, " P"]
    """Label of the edge that starts at or passes through a border point, 0 inside."""
    runs: tuple[tuple[int, Int[np.ndarray, " _"]], ...]
    """Label and points of every edge, both corners included."""


@dataclass(frozen=True, eq=False)
class FlatSeam:
    """Points sewn together, in order."""

    labels: tuple[int, int]
    front: Int[np.ndarray, " n"]
    back: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SewnPanels:
    """Two panels joined along their seams; still flat."""

    panels: Mapping[str, FlatPanel]
    seams: tuple[FlatSeam, ...]
    num_vertices: int
    spacing: float
    """Length of a triangle's side."""

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles over sewn vertices, front first."""
        return np.concatenate([p.vertex_index[p.faces] for p in self.panels.values()])

    @cached_property
    def fades(self) -> dict[str, SeamFade]:
        """By panel, how its inside follows its seams."""
        fades = {}
        for side, panel in self.panels.items():
            sewn = [seam.front if side == "front" else seam.back for seam in self.seams]
            fades[side] = seam_fade(panel.points, np.unique(np.concatenate([*sewn, _NONE])))
        return fades

    @property
    def seam_distance(self) -> Float[np.ndarray, " V"]:
        """Distance of every vertex from the nearest seam point; infinite far away and on open borders."""
        distance = np.full(self.num_vertices, np.inf)
        for seam in self.seams:
            distance[self.panels["front"].vertex_index[seam.front]] = 0.0
        for side, panel in self.panels.items():
            fade = self.fades[side]
            distance[panel.vertex_index[fade.points]] = fade.distance
        for side, panel in self.panels.items():
            sewn = {seam.labels[side != "front"] for seam in self.seams}
            for label, points in panel.runs:
                if label not in sewn:
                    distance[panel.vertex_index[points]] = np.inf
        return distance


@dataclass(frozen=True)
class _Match:
    """A run of the front and a run of the back that are sewn: (loop, run) each."""

    labels: tuple[int, int]
    front: tuple[int, int]
    back: tuple[int, int]


def sew_panels(
    outlines: Mapping[str, Sequence[Loop]],
    seam_pairs: Sequence[tuple[int, int]],
    *,
    spacing: float,
    sliver: float,
) -> SewnPanels:
    """Match, resample, triangulate and weld.

    An edge that neither panel has makes no seam. An edge that only one panel has is
    dissolved into a neighbour if it is a sliver, or if the other panel's outline runs
    alongside and calls that stretch by the neighbour's label.

    Args:
        outlines: Per panel ("front", "back"), its loops of labelled runs.
        seam_pairs: Labels (front, back) to sew.
        spacing: Length of a triangle's side.
        sliver: Longest unmatched edge that may be dissolved into its neighbours.

    Raises:
        GeometryError: If one side of a seam is missing or sewn to itself, an
            outline crosses itself, or the result is no surface.
    """
    loops = {
        side: [join_alike(loop, {pair[k] for pair in seam_pairs}) for loop in outlines[side]]
        for k, side in enumerate(PANELS)
    }
    matches = _match(loops, seam_pairs, sliver)
    counts = _counts(loops, matches, spacing)
    panels = {side: _triangulate(side, loops[side], counts[side], matches, spacing) for side in PANELS}
    seams = tuple(_seam(match, loops, panels) for match in matches)
    offset = len(panels["front"].points)
    pairs = [np.stack([seam.front, offset + seam.back], axis=1) for seam in seams]
    total = offset + len(panels["back"].points)
    vertex, count = weld(total, np.concatenate([*pairs, np.empty((0, 2), dtype=np.int64)]))
    index = {"front": vertex[:offset], "back": vertex[offset:]}
    sewn = SewnPanels(
        {side: replace(panels[side], vertex_index=index[side]) for side in PANELS}, seams, count, spacing
    )
    _check_surface(sewn)
    return sewn


def _match(
    loops: dict[str, list[Loop]], seam_pairs: Sequence[tuple[int, int]], sliver: float
) -> list[_Match]:
    """Pair the runs of every seam; dissolves those without a partner in ``loops``, in place."""
    while True:
        matches, spare = [], []
        for labels in seam_pairs:
            places = [_find(loops[side], label) for side, label in zip(PANELS, labels, strict=True)]
            paired, left = _pair(loops, places)
            matches += [_Match(labels, front, back) for front, back in paired]
            spare += [(loops[side][p[0]][p[1]].length, side, p, labels) for side, p in left]
        if not spare:
            return matches
        length, side, (loop, run), labels = min(spare, key=lambda entry: entry[0])
        other = PANELS[side == "front"]
        lone, runs = loops[side][loop][run], loops[side][loop]
        label = _label_across(lone, loops[other], _renaming(seam_pairs, other), reach=0.5 * sliver)
        disputed = label in {runs[run - 1].label, runs[(run + 1) % len(runs)].label}
        if len(runs) == 1 or not (disputed or length <= sliver):
            raise GeometryError(
                f"seam {labels}: the {side} panel has an edge of length {length:.3g} "
                f"that finds no partner on the {other} panel"
            )
        loops[side][loop] = dissolve(runs, run, label=label)


def _renaming(seam_pairs: Sequence[tuple[int, int]], side: str) -> dict[int, int]:
    """From the labels of one panel to those they are sewn to on the other."""
    return {pair[0]: pair[1] for pair in (p if side == "front" else p[::-1] for p in seam_pairs)}


def _label_across(
    lone: EdgeRun, others: Sequence[Loop], renaming: Mapping[int, int], *, reach: float
) -> int | None:
    """What the other panel calls the stretch of its outline that lies along a run; None if none does."""
    runs = [run for loop in others for run in loop]
    along = [resample_open(run.points, 2 + round(2 * run.length / reach)) for run in runs]
    places = np.concatenate(along)
    labels = np.repeat([renaming.get(run.label, run.label) for run in runs], [len(p) for p in along])
    samples = resample_open(lone.points, 22)[1:-1]
    distance = np.linalg.norm(samples[:, None] - places, axis=-1)
    if distance.min(axis=1).mean() > reach:
        return None
    return int(np.bincount(labels[distance.argmin(axis=1)]).argmax())


def _find(loops: Sequence[Loop], label: int) -> list[tuple[int, int]]:
    return [(i, k) for i, loop in enumerate(loops) for k, run in enumerate(loop) if run.label == label]


def _pair(loops: Mapping[str, list[Loop]], places: Sequence[list[tuple[int, int]]]):
    """Pairs of runs whose ends lie nearest, and the runs left over."""
    ends = [
        np.array([np.concatenate(loops[s][i][k].points[[0, -1]]) for i, k in spots]).reshape(-1, 4)
        for s, spots in zip(PANELS, places, strict=True)
    ]
    cost = np.linalg.norm(ends[0][:, None] - ends[1][None], axis=-1)
    rows, columns = linear_sum_assignment(cost)
    left = [("front", p) for k, p in enumerate(places[0]) if k not in rows]
    left += [("back", p) for k, p in enumerate(places[1]) if k not in columns]
    return [(places[0][a], places[1][b]) for a, b in zip(rows, columns, strict=True)], left


def _counts(
    loops: Mapping[str, list[Loop]], matches: Sequence[_Match], spacing: float
) -> dict[str, list[list[int]]]:
    """Number of edges of every run."""

    def edges_of(length: float, run: EdgeRun) -> int:
        closed = bool((run.points[0] == run.points[-1]).all())
        return max(3 * _MIN_EDGES if closed else _MIN_EDGES, round(length / spacing))

    counts = {side: [[edges_of(run.length, run) for run in loop] for loop in loops[side]] for side in PANELS}
    for match in matches:
        runs = [loops[side][i][k] for side, (i, k) in zip(PANELS, (match.front, match.back), strict=True)]
        if any(
            len(loops[side][p[0]]) == 1 for side, p in zip(PANELS, (match.front, match.back), strict=True)
        ):
            raise GeometryError(
                f"seam {match.labels}: a whole outline is sewn, which leaves no corner to begin at"
            )
        count = edges_of(0.5 * (runs[0].length + runs[1].length), runs[0])
        for side, (i, k) in zip(PANELS, (match.front, match.back), strict=True):
            counts[side][i][k] = count
    return counts


def _triangulate(
    side: str, loops: Sequence[Loop], counts: list[list[int]], matches: Sequence[_Match], spacing: float
) -> FlatPanel:
    """Resample and fill one panel; vertices are not known yet."""
    polygons, labels, runs, start = [], [], [], 0
    for loop, numbers in zip(loops, counts, strict=True):
        total, first = sum(numbers), 0
        for run, count in zip(loop, numbers, strict=True):
            labels.append(np.full(count, run.label))
            runs.append((run.label, start + (first + np.arange(count + 1)) % total))
            first += count
        parts = [resample_open(run.points, count + 1)[:-1] for run, count in zip(loop, numbers, strict=True)]
        polygons.append(np.concatenate(parts))
        start += total
    points, faces = triangulate_panel(polygons, spacing)
    sewn = np.zeros(len(points), dtype=bool)
    first_run = np.cumsum([0, *map(len, loops)])
    for match in matches:
        piece, position = match.front if side == "front" else match.back
        sewn[runs[first_run[piece] + position][1]] = True
    points, faces = split_chords(points, faces, sewn)
    border_label = np.concatenate([*labels, np.zeros(len(points) - start, dtype=np.int64)])
    if side == "back":
        faces = faces[:, ::-1]
    return FlatPanel(points, np.ascontiguousarray(faces), np.arange(len(points)), border_label, tuple(runs))


def _seam(match: _Match, loops: Mapping[str, list[Loop]], panels: Mapping[str, FlatPanel]) -> FlatSeam:
    ends = []
    for side, (loop, run) in zip(PANELS, (match.front, match.back), strict=True):
        number = sum(len(runs) for runs in loops[side][:loop]) + run
        ends.append(panels[side].runs[number][1])
    return FlatSeam(match.labels, *ends)


def _check_surface(sewn: SewnPanels) -> None:
    """Each panel is a surface already: an edge with too many faces runs between two vertices that both panels
    have, or from one that joins several points of a panel."""
    count = np.stack([np.bincount(p.vertex_index, minlength=sewn.num_vertices) for p in sewn.panels.values()])
    shared: Bool[np.ndarray, " V"] = np.asarray((count > 0).all(axis=0))
    joined: Bool[np.ndarray, " V"] = np.asarray((count > 1).any(axis=0))
    faces = sewn.faces
    faces = faces[(shared[faces].sum(axis=1) >= 2) | joined[faces].any(axis=1)]
    if (faces == np.roll(faces, 1, axis=1)).any():
        raise GeometryError("sewing folds a triangle onto one edge; two seams meet twice")
    count = edges(faces).num_faces
    if (count > 2).any():
        raise GeometryError(
            f"the sewn panels are no surface: {int((count > 2).sum())} edges have more than two faces"
        )
