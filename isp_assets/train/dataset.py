"""The training data: parametric garments draped to rest on a body, and their files.

A data set is a folder::

    dataset.json                    categories, labels, statistics, counted rejections
    top/0000_tank_top.npz           one garment; arrays and a JSON text, nothing pickled
    top/top_test_0000.npz           one that no network learns from

Garments depend on (seed, category, training or test, index) alone, so a run that was cut off goes on
where it stopped, with any number of workers. The first garments of a category are its
named presets, the rest are random.
"""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from isp_assets.conventions import PANELS
from isp_assets.errors import DatasetError
from isp_assets.train.garment_maker import (
    CATEGORIES,
    FILE_VERSION,
    UNREADABLE,
    Draft,
    GarmentMaker,
    Recipe,
    read_garment_file,
)
from isp_assets.train.worker_pool import run_tasks

Progress = Callable[[int, int, str], None]

_SCHEMA = "isp-assets/dataset"
_VERSION = 2


@dataclass(frozen=True, eq=False)
class TrainingPanel:
    """One panel of a training garment."""

    xy: Float[np.ndarray, "P 2"]
    """Flat positions [m]; the outline's points come first."""
    faces: Int[np.ndarray, "F 3"]
    """Wound so that the sewn surface faces outwards: the front counter-clockwise in xy, the back not."""
    vertex_index: Int[np.ndarray, " P"]
    """Garment vertex of each panel point."""
    outline_xy: Float[np.ndarray, "M 2"]
    """Dense samples of the outline, about 4 mm apart [m]."""
    outline_label: Int[np.ndarray, " M"]
    """Label of the edge from each sample to the next."""
    outline_loop: Int[np.ndarray, " M"]
    """Closed loop of each sample; an open front has two."""


@dataclass(frozen=True, eq=False)
class TrainingGarment:
    """A pattern and its rest shape."""

    name: str
    category: str
    panels: Mapping[str, TrainingPanel]
    rest_vertices: Float[np.ndarray, "V 3"]
    """Positions on the body in the rest pose [m]."""
    anchors: Int[np.ndarray, " A"]
    """Vertices held by the body: the waist; may be empty."""
    parameters: Mapping[str, float]
    metrics: Mapping[str, float]

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles of the sewn garment, front panel first."""
        return np.concatenate([panel.vertex_index[panel.faces] for panel in self.panels.values()])


@dataclass(frozen=True, eq=False)
class GarmentDataset:
    """All training garments of a category, and what they share."""

    category: str
    garments: tuple[TrainingGarment, ...]
    edge_names: Mapping[int, str]
    seam_pairs: tuple[tuple[int, int], ...]
    """Labels (front, back) of edges that are sewn together."""
    anchor_labels: tuple[int, ...]
    rest_pose: Float[np.ndarray, "24 3"]
    """Axis-angle pose of the body that the rest shapes lie on [rad]."""
    panel_center: Float[np.ndarray, " 2"]
    panel_scale: float
    """Network coordinates = (xy - panel_center) / panel_scale, within [-.95, .95]."""
    body_sha256: str


def make_dataset(
    out: Path,
    *,
    counts: Mapping[str, int],
    test: int = 0,
    seed: int = 0,
    body: str = "default",
    workers: int = 2,
    edge_length: float = 0.018,
    progress: Progress | None = None,
) -> None:
    """Make or complete a data set.

    Args:
        out: Folder; garments of the same seed, body and edge length already there are kept.
        counts: Training garments per category ("top", "skirt", "trousers").
        test: Further garments of every category, all random, kept apart for testing.
        seed: Of the random garments.
        body: ``"default"`` or an SMPL file.
        workers: Processes, each with one thread; 1 works in this process.
        edge_length: Triangle side [m].
        progress: Called with (finished, total, message) after every garment.

    Raises:
        DatasetError: If a category is unknown, or ``out`` holds another data set.
        MissingExtraError: If numba or ipctk is not installed.
    """
    out = Path(out)
    unknown = set(counts) - set(CATEGORIES)
    if unknown or not counts or min(counts.values()) < 1 or workers < 1 or test < 0:
        raise DatasetError(
            f"expected counts >= 1 for categories among {sorted(CATEGORIES)}, test >= 0 and workers >= 1, "
            f"got {dict(counts)}, test={test}, workers={workers}"
        )
    recipe = Recipe(out=str(out), seed=seed, body=str(body), edge_length=edge_length)
    maker = GarmentMaker(recipe)
    drafts = {category: _drafts(category, count, test) for category, count in counts.items()}
    tasks = [draft for category in CATEGORIES for draft in drafts.get(category, ())]
    missing = [task for task in tasks if not maker.is_made(task)]
    done = len(tasks) - len(missing)

    def report(message: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, len(tasks), message)

    if workers == 1:
        for task in missing:
            report(maker.make(task))
    else:
        run_tasks(missing, partial(_start_maker, recipe), _make, workers=workers, report=report)
    _write_index(out, recipe, maker, drafts)


def load_dataset(folder: Path, category: str, *, test: bool = False) -> GarmentDataset:
    """Read the training garments of a category, or its test garments.

    Raises:
        DatasetError: If the folder holds no complete data set of this version, or lacks the category.
    """
    index = read_index(folder)
    if category not in index["categories"]:
        raise DatasetError(f"{folder} has no category {category!r}; it has {sorted(index['categories'])}")
    shared = index["categories"][category]
    files = shared["test_files" if test else "files"]
    if not files:
        raise DatasetError(f"{folder} has no test garments of {category!r}; make it with --test")
    return GarmentDataset(
        category=category,
        garments=tuple(_load_garment(Path(folder) / category / name) for name in files),
        edge_names={int(label): name for label, name in shared["edge_names"].items()},
        seam_pairs=tuple((front, back) for front, back in shared["seam_pairs"]),
        anchor_labels=tuple(shared["anchor_labels"]),
        rest_pose=np.array(shared["rest_pose"]),
        panel_center=np.array(shared["panel_center"]),
        panel_scale=float(shared["panel_scale"]),
        body_sha256=index["body_sha256"],
    )


def read_index(folder: Path) -> dict:
    """The parsed ``dataset.json`` of a folder, its version checked.

    Raises:
        DatasetError: If it is missing, damaged or of another version.
    """
    path = Path(folder) / "dataset.json"
    try:
        index = json.loads(path.read_text())
    except FileNotFoundError:
        raise DatasetError(
            f"{path} is missing; the folder holds no complete data set, run make_dataset on it"
        ) from None
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}") from error
    if (index.get("schema"), index.get("version")) != (_SCHEMA, _VERSION):
        raise DatasetError(
            f"{path}: expected schema {_SCHEMA} version {_VERSION}, "
            f"got {index.get('schema')} version {index.get('version')}"
        )
    return index


def _load_garment(path: Path) -> TrainingGarment:
    try:
        arrays, meta = read_garment_file(path)
    except UNREADABLE as error:
        raise DatasetError(
            f"{path} is missing or damaged ({error}); run make_dataset on the folder again"
        ) from error
    if meta["version"] != FILE_VERSION:
        raise DatasetError(
            f"{path}: expected version {FILE_VERSION}, got {meta['version']}; make the data set again"
        )
    fields = TrainingPanel.__dataclass_fields__
    return TrainingGarment(
        name=meta["name"],
        category=meta["category"],
        panels={
            side: TrainingPanel(**{name: arrays[f"{side}_{name}"] for name in fields}) for side in PANELS
        },
        rest_vertices=arrays["rest_vertices"],
        anchors=arrays["anchors"],
        parameters=meta["parameters"],
        metrics=meta["metrics"],
    )


_maker: GarmentMaker | None = None  # of a worker process


def _start_maker(recipe: Recipe) -> None:
    global _maker
    _maker = GarmentMaker(recipe)


def _make(task: Draft) -> str:
    assert _maker is not None
    return _maker.make(task)


def _drafts(category: str, count: int, test: int) -> list[Draft]:
    return [Draft(category, i) for i in range(count)] + [Draft(category, i, test=True) for i in range(test)]


def _write_index(out: Path, recipe: Recipe, maker: GarmentMaker, drafts: Mapping[str, list[Draft]]) -> None:
    categories = {}
    for name, category in CATEGORIES.items():
        if name not in drafts:
            continue
        metas = [read_garment_file(maker.path(draft))[1] for draft in drafts[name]]
        categories[name] = {
            "files": [draft.file for draft in drafts[name] if not draft.test],
            "test_files": [draft.file for draft in drafts[name] if draft.test],
            "edge_names": {str(label): text for label, text in category.edge_names.items()},
            "seam_pairs": category.seam_pairs,
            "anchor_labels": category.anchor_labels,
            "rest_pose": maker.rest_pose(name).tolist(),
            "panel_center": maker.panel_center(name).tolist(),
            "panel_scale": category.panel_scale,
            "statistics": _statistics([meta["metrics"] for meta in metas]),
            "rejections": [
                {"garment": m["name"], "reason": reason} for m in metas for reason in m["rejections"]
            ],
        }
    index = {
        "schema": _SCHEMA, "version": _VERSION, "body": recipe.body, "body_sha256": maker.body_sha256,
        "seed": recipe.seed, "edge_length": recipe.edge_length, "categories": categories,
    }  # fmt: skip
    draft = out / "dataset.json.partial"
    draft.write_text(json.dumps(index, indent=1) + "\n")
    os.replace(draft, out / "dataset.json")


def _statistics(metrics: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    return {
        key: {"min": float(min(v)), "median": float(np.median(v)), "max": float(max(v))}
        for key in metrics[0]
        for v in [[m[key] for m in metrics]]
    }
