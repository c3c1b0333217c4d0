"""Makes one training garment: parameters, pattern, rest shape, checks, file."""

import json
import os
import zipfile
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES, NUM_JOINTS, PANELS
from isp_assets.errors import DatasetError, GeometryError
from isp_assets.train.landmarks import RestBody
from isp_assets.train.pattern import Pattern, PatternCategory, SewnPattern, outline_samples, sew
from isp_assets.train.pattern_skirt import SKIRT
from isp_assets.train.pattern_top import TOP
from isp_assets.train.pattern_trousers import TROUSERS
from isp_assets.train.rest_drape import DrapeSettings, RestShape, drape_to_rest

CATEGORIES: dict[str, PatternCategory] = {c.name: c for c in (TOP, SKIRT, TROUSERS)}
FILE_VERSION = 2
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""What a missing or damaged garment file raises."""

_ATTEMPTS = 8
_OUTLINE_SPACING = 0.004
_LIMITS = {"body_intersects": 0.5, "self_intersects": 0.5, "strain_max": 0.5, "residual": 1.2, "speed": 0.05}
_REACH = 0.95  # of the network's coordinates


@dataclass(frozen=True)
class Draft:
    """Which garment of a recipe. Training and test garments are numbered apart: neither moves the other."""

    category: str
    index: int
    test: bool = False

    @property
    def name(self) -> str:
        """Name of a preset, or category and number."""
        presets = list(CATEGORIES[self.category].presets)
        if self.index < len(presets) and not self.test:
            return presets[self.index]
        return f"{self.category}_{'test_' if self.test else ''}{self.index:04d}"

    @property
    def file(self) -> str:
        """File name in the category's folder."""
        return f"{self.name}.npz" if self.test else f"{self.index:04d}_{self.name}.npz"

    def parameters(self, seed: int, attempt: int) -> Any:
        """A preset, the same at every attempt, or parameters drawn for this seed and attempt."""
        spec = CATEGORIES[self.category]
        if self.index < len(spec.presets) and not self.test:
            return list(spec.presets.values())[self.index]
        key = [seed, list(CATEGORIES).index(self.category), self.index, attempt, *([1] if self.test else [])]
        return spec.sample(np.random.default_rng(key))


@dataclass(frozen=True)
class Recipe:
    """What all garments of a data set share; plain values, so that it travels to worker processes."""

    out: str
    seed: int
    body: str
    edge_length: float


def read_garment_file(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Arrays and JSON part of a garment's file; raises one of ``UNREADABLE`` if it is not whole."""
    # numpy leaves a file that it opened itself open where it is damaged.
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        arrays = dict(file)
    return arrays, json.loads(str(arrays.pop("meta")))


class GarmentMaker:
    """Makes the garments of a recipe, each from its category and index alone."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self._rest: dict[float, RestBody] = {}

    @cached_property
    def _body(self) -> Body:
        return Body.load(self.recipe.body)

    @property
    def body_sha256(self) -> str:
        """Digest of the body's content."""
        return self._body.sha256

    def rest_pose(self, category: str) -> Float[np.ndarray, "24 3"]:
        """Axis-angle rest pose of a category [rad]: T-pose, legs turned outwards for trousers."""
        pose = np.zeros((NUM_JOINTS, 3))
        pose[JOINT_NAMES.index("left_hip"), 2] = CATEGORIES[category].leg_angle
        pose[JOINT_NAMES.index("right_hip"), 2] = -CATEGORIES[category].leg_angle
        return pose

    def rest_body(self, category: str) -> RestBody:
        """The body in a category's rest pose."""
        return self._rest_body(self.rest_pose(category))

    def panel_center(self, category: str) -> Float[np.ndarray, " 2"]:
        """Origin of the network's coordinates [m]."""
        return np.array(CATEGORIES[category].panel_center(self.rest_body(category).landmarks))

    def path(self, draft: Draft) -> Path:
        """File of a garment."""
        return Path(self.recipe.out) / draft.category / draft.file

    def is_made(self, draft: Draft) -> bool:
        """Whether the garment's file is there and whole.

        Raises:
            DatasetError: If it was made from another recipe.
        """
        path = self.path(draft)
        try:
            meta = read_garment_file(path)[1]
        except UNREADABLE:
            return False
        expected = self._provenance()
        if meta["version"] != FILE_VERSION or meta["provenance"] != expected:
            raise DatasetError(
                f"{path} was made as {meta['provenance']}, version {meta['version']}; "
                f"expected {expected}, version {FILE_VERSION}; choose another folder"
            )
        return True

    def make(self, draft: Draft) -> str:
        """Make one garment and its file; rejected drafts are drawn again and counted.

        Returns:
            A line for the user.

        Raises:
            DatasetError: If no draft is good.
        """
        rejections: list[str] = []
        for attempt in range(_ATTEMPTS):
            parameters = draft.parameters(self.recipe.seed, attempt)
            try:
                pattern, sewn, rest = self._try(draft.category, parameters, attempt)
            except GeometryError as error:
                rejections.append(str(error))
                continue
            fault = self._fault(draft.category, sewn, rest)
            if fault is None:
                break
            rejections.append(fault)
        else:
            raise DatasetError(f"garment {draft.name!r}: no good draft in {_ATTEMPTS}: {rejections}")
        meta = {
            "version": FILE_VERSION, "name": draft.name, "category": draft.category, "index": draft.index,
            "provenance": self._provenance(), "parameters": asdict(parameters), "metrics": rest.metrics,
            "rejections": rejections,
        }  # fmt: skip
        _save(self.path(draft), pattern, sewn, rest, meta)
        note = f", {len(rejections)} rejected" if rejections else ""
        size, strain = len(rest.vertices), rest.metrics["strain_mean"]
        return f"{draft.category} {draft.name}: {size} vertices, strain {strain:.1%}{note}"

    def _try(self, category: str, parameters, attempt: int) -> tuple[Pattern, SewnPattern, RestShape]:
        body = self.rest_body(category)
        standing = self._rest_body(np.zeros((NUM_JOINTS, 3))).landmarks
        pattern = CATEGORIES[category].draw(body, standing, parameters)
        sewn = sew(pattern, self.recipe.edge_length)
        # A preset cannot be drawn again: a repeated try differs by settling longer.
        settings = DrapeSettings(
            substeps=1000 + 250 * attempt,
            iterations=400 + 100 * attempt,
            margin=max(0.006, self.recipe.edge_length / 3),  # longer edges cut deeper into round shoulders
        )
        return pattern, sewn, drape_to_rest(sewn, body, settings)

    def _fault(self, category: str, sewn: SewnPattern, rest: RestShape) -> str | None:
        for key, limit in _LIMITS.items():
            if not rest.metrics[key] <= limit:
                return f"{key} {rest.metrics[key]:.3g} > {limit:g}"
        reach = np.abs(
            (sewn.vertex_xy - self.panel_center(category)) / CATEGORIES[category].panel_scale
        ).max()
        return None if reach <= _REACH else f"pattern reaches {reach:.3f} > {_REACH} of the panel"

    def _rest_body(self, pose: Float[np.ndarray, "24 3"]) -> RestBody:
        key = float(pose[1, 2])
        if key not in self._rest:
            with torch.no_grad():
                posed = self._body.pose(torch.as_tensor(pose[None], dtype=torch.float32))
            vertices = posed.vertices[0].numpy().astype(np.float64)
            self._rest[key] = RestBody(vertices=vertices, faces=self._body.faces.numpy().astype(np.int64))
        return self._rest[key]

    def _provenance(self) -> dict:
        return {
            "seed": self.recipe.seed,
            "body_sha256": self.body_sha256,
            "edge_length": self.recipe.edge_length,
        }


def _save(path: Path, pattern: Pattern, sewn: SewnPattern, rest: RestShape, meta: dict) -> None:
    arrays = {"rest_vertices": rest.vertices, "anchors": sewn.anchors, "meta": np.array(json.dumps(meta))}
    for side in PANELS:
        panel = sewn.panels[side]
        outline = outline_samples(pattern.panels[side], _OUTLINE_SPACING)
        fields = ("xy", "faces", "vertex_index", "outline_xy", "outline_label", "outline_loop")
        for name, value in zip(fields, (panel.xy, panel.faces, panel.vertex_index, *outline), strict=True):
            arrays[f"{side}_{name}"] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    with partial.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)
