"""Implicit sewing patterns for asset pipelines: garments as codes, draped in layers over SMPL motion.

Names are imported when first used, so that ``import isp_assets`` is quick. The verbs live in
modules of their own name: ``from isp_assets.drape import drape``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from isp_assets.body import Body
    from isp_assets.bundle import GarmentBundle
    from isp_assets.collection import Collection
    from isp_assets.conventions import FrameRange
    from isp_assets.errors import IspAssetsError
    from isp_assets.garment import Garment
    from isp_assets.motion import Motion
    from isp_assets.outfit import Outfit
    from isp_assets.pipeline import run_job
    from isp_assets.plugin import find_writers, make_writer
    from isp_assets.shot import Shot, ShotJob

__version__ = "0.1.0"

__all__ = [
    "Body", "Collection", "FrameRange", "Garment", "GarmentBundle", "IspAssetsError", "Motion",
    "Outfit", "Shot", "ShotJob", "find_writers", "make_writer", "run_job",
]  # fmt: skip

_HOME = {
    "Body": "body", "Collection": "collection", "FrameRange": "conventions",
    "Garment": "garment", "GarmentBundle": "bundle", "IspAssetsError": "errors", "Motion": "motion",
    "Outfit": "outfit", "Shot": "shot", "ShotJob": "shot", "find_writers": "plugin",
    "make_writer": "plugin", "run_job": "pipeline",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'isp_assets' has no attribute {name!r}")
    value = getattr(import_module(f"isp_assets.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
