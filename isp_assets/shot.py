"""A shot: a body in motion over a range of frames, and the job file that describes one.

::

    name = "walk"
    motion = "walk"                 # a built-in motion, or an AMASS-style .npz (relative to this file)
    outfit = ["tank_top", "trousers", "open_jacket"]    # innermost first
    frames = "1-48"
    fps = 30.0
    collection = "default"          # or a folder
    body = "default"                # or an SMPL-format .npz or .pkl
    betas = "neutral"               # a preset, or a list of numbers
    resolution = 96                 # grid cells across a panel
    write = ["usd", "glb", "rerun", "sheet"]
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from isp_assets.body import BETA_PRESETS, Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.errors import ShotError
from isp_assets.motion import Motion, builtin_motions
from isp_assets.outfit import Outfit
from isp_assets.toml_file import check_keys, read_toml

MIN_RESOLUTION, MAX_RESOLUTION = 32, 512
DEFAULT_RESOLUTION = 96
DEFAULT_WRITERS = ("usd", "glb", "rerun", "sheet")

_KEYS = {
    "name": str, "collection": str, "body": str, "betas": (str, list), "motion": str, "frames": (str, int),
    "fps": (int, float), "outfit": list, "resolution": int, "write": list,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Shot:
    """A body of one shape in motion. Frame numbers and frame rate are the motion's."""

    name: str
    body: Body
    motion: Motion
    betas: Float[np.ndarray, " B"] = field(default_factory=lambda: np.zeros(10, np.float32))
    """Shape coefficients of ``body``, one set for the whole shot."""

    def __post_init__(self) -> None:
        count = self.body.shape_dirs.shape[-1]
        if len(self.betas) > count:
            raise ShotError(
                f"shot {self.name!r}: body {self.body.name!r} has {count} betas, got {len(self.betas)}"
            )
        if not np.isfinite(self.betas).all():
            raise ShotError(f"shot {self.name!r}: betas hold NaN or infinity: {self.betas.tolist()}")


@dataclass(frozen=True, eq=False)
class ShotJob:
    """A shot, what is worn in it, and which files to write."""

    shot: Shot
    outfit: Outfit
    resolution: int = DEFAULT_RESOLUTION
    write: tuple[str, ...] = DEFAULT_WRITERS

    def __post_init__(self) -> None:
        if not MIN_RESOLUTION <= self.resolution <= MAX_RESOLUTION:
            raise ShotError(
                f"shot {self.shot.name!r}: resolution must lie in {MIN_RESOLUTION}..{MAX_RESOLUTION}, "
                f"got {self.resolution}"
            )
        if self.shot.body.sha256 != self.outfit.body_sha256:
            raise ShotError(
                f"shot {self.shot.name!r}: body {self.shot.body.name!r} ({self.shot.body.sha256[:12]}) "
                "is not the body that "
                f"the outfit was trained on ({self.outfit.body_sha256[:12]}); use that body, "
                "or train a collection on yours"
            )

    @classmethod
    def load(cls, path: Path, *, frames: FrameRange | None = None) -> "ShotJob":
        """Read a job file; ``frames`` overrides the file's range.

        Raises:
            ShotError, CollectionError, MotionError, BodyError: Naming the file, the key and the remedy.
        """
        return cls.from_table(read_toml(path, ShotError), where=str(path), folder=path.parent, frames=frames)

    @classmethod
    def from_table(
        cls, table: Mapping[str, Any], *, where: str, folder: Path = Path(), frames: FrameRange | None = None
    ) -> "ShotJob":
        """Build the job from the tables of a job file; relative paths start at ``folder``."""
        check_keys(table, _KEYS, {"motion", "outfit"}, where, ShotError)
        for key in ("outfit", "write"):
            if not all(isinstance(v, str) for v in table.get(key, [])):
                raise ShotError(f"{where}: {key} must be a list of names, got {table[key]!r}")
        collection = Collection.load(_source(table.get("collection", "default"), ("default",), folder))
        outfit = collection.outfit(table["outfit"])
        body = Body.load(_source(table.get("body", "default"), ("default",), folder))
        motion = _motion(table, folder, frames)
        name = table.get("name", motion.name)
        if not name or any(c in name for c in '/\\:*?"<>|') or name.startswith("."):
            raise ShotError(f"{where}: name must be usable as a file name, got {name!r}")
        shot = Shot(name, body, motion, _betas(table.get("betas", "neutral"), where))
        write = tuple(table.get("write", DEFAULT_WRITERS))
        return cls(shot, outfit, table.get("resolution", DEFAULT_RESOLUTION), write)


def _source(text: str, builtin: tuple[str, ...], folder: Path) -> str | Path:
    return text if text in builtin else folder / text


def _motion(table: Mapping[str, Any], folder: Path, frames: FrameRange | None) -> Motion:
    motion = Motion.load(_source(table["motion"], builtin_motions(), folder))
    if "fps" in table and float(table["fps"]) != motion.fps:
        motion = motion.resample(float(table["fps"]))
    wanted = (
        frames
        if frames is not None
        else FrameRange.parse(str(table["frames"]))
        if "frames" in table
        else None
    )
    return motion if wanted is None else motion.select(wanted)


def _betas(value: str | list[Any], where: str) -> Float[np.ndarray, " B"]:
    if isinstance(value, str):
        if value not in BETA_PRESETS:
            raise ShotError(
                f"{where}: betas must be a list of numbers or one of {', '.join(BETA_PRESETS)}; got {value!r}"
            )
        return np.asarray(BETA_PRESETS[value], np.float32)
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value):
        raise ShotError(f"{where}: betas must be numbers, got {value!r}")
    return np.asarray(value, np.float32)
