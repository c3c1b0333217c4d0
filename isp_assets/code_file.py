"""A latent code as a file of its own: what a fit gives, until it joins a collection.

A code means something only with the networks it was found with, so the file names
them by a digest.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.errors import BundleError
from isp_assets.storage import load_tensors, save_tensors

_SCHEMA, _VERSION = "isp-assets/code", 1


@dataclass(frozen=True, eq=False)
class GarmentCode:
    """One garment of a category, outside any bundle."""

    name: str
    category: str
    code: Float[np.ndarray, " Z"]
    model_sha256: str
    """Digest of the pattern networks that the code belongs to."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """Where it comes from and how well it fits; plain JSON values."""

    def save(self, path: str | os.PathLike) -> None:
        """Write the code, whole or not at all.

        Raises:
            BundleError: If the notes hold what JSON cannot keep.
        """
        manifest = {
            "name": self.name, "category": self.category, "model_sha256": self.model_sha256,
            "notes": dict(self.notes),
        }  # fmt: skip
        tensors = {"code": torch.from_numpy(np.asarray(self.code, np.float32))}
        save_tensors(path, tensors, manifest, schema=_SCHEMA, version=_VERSION)

    @classmethod
    def load(cls, path: str | os.PathLike) -> "GarmentCode":
        """Read a code.

        Raises:
            BundleError: If the file is missing, damaged, too new or of another kind.
        """
        tensors, manifest = load_tensors(path, schema=_SCHEMA, version=_VERSION)
        try:
            return cls(
                manifest["name"], manifest["category"], tensors["code"].numpy(), manifest["model_sha256"],
                manifest["notes"],
            )  # fmt: skip
        except KeyError as error:
            raise BundleError(f"{path}: the file lacks {error}; it is damaged") from error
