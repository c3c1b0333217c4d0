"""Morph targets: how the positions and normals of one frame are stored as differences to the first frame.

Plain targets are float32. Packed targets (extension KHR_mesh_quantization) are
16-bit positions and 8-bit normals in units of a scale, and the animation sets
the target's weight to that scale instead of 1. So the base mesh stays float32
in metres, and a reader that knows no morph targets still sees the first frame.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .container import ARRAY_BUFFER, GlbFile, Spool, bounds_of, component_type

QUANTIZATION = "KHR_mesh_quantization"
_LONGEST_NORMAL_CHANGE = 2.0  # a normal can at most turn round


@dataclass(frozen=True)
class Encoding:
    """Element types of morph targets."""

    position: str = "f4"
    normal: str = "f4"

    @property
    def is_packed(self) -> bool:
        return self.position != "f4"

    def scale(self, change: Float[np.ndarray, "P 3"]) -> float:
        """Weight that the target is played with; its largest storable difference [m]."""
        return max(_LONGEST_NORMAL_CHANGE, float(np.abs(change).max())) if self.is_packed else 1.0


PLAIN = Encoding()
PACKED = Encoding("i2", "i1")


@dataclass(eq=False)
class MeshTargets:
    """The targets of one mesh, in frame order."""

    positions: list[dict[str, Any]] = field(default_factory=list)
    normals: list[dict[str, Any]] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)


class TargetStore:
    """Streams the targets of all meshes into two spools, one for positions and one for normals."""

    def __init__(self, encoding: Encoding, folder: Path) -> None:
        self._encoding = encoding
        self._spools = {"positions": Spool(folder), "normals": Spool(folder)}
        self._strides: dict[str, int] = {}

    def add(
        self, targets: MeshTargets, position: Float[np.ndarray, "P 3"], normal: Float[np.ndarray, "P 3"]
    ) -> None:
        """Append one frame's differences of positions [m] and of unit normals."""
        scale = self._encoding.scale(position)
        targets.positions.append(self._append("positions", position, self._encoding.position, scale))
        targets.normals.append(self._append("normals", normal, self._encoding.normal, scale))
        targets.scales.append(scale)

    def attach(self, file: GlbFile, meshes: list[MeshTargets]) -> list[list[dict[str, int]]]:
        """Move all targets into the file; returns every mesh's ``targets`` entry."""
        if not meshes[0].scales:
            return [[] for _ in meshes]
        if self._encoding.is_packed:
            file.document["extensionsUsed"] = file.document["extensionsRequired"] = [QUANTIZATION]
        views = {
            kind: file.view(spool, target=ARRAY_BUFFER, stride=self._strides[kind])
            for kind, spool in self._spools.items()
        }
        for mesh in meshes:
            for kind, entries in (("positions", mesh.positions), ("normals", mesh.normals)):
                for entry in entries:
                    entry["bufferView"] = views[kind]
        return [
            [
                {"POSITION": file.append("accessors", p), "NORMAL": file.append("accessors", n)}
                for p, n in zip(mesh.positions, mesh.normals, strict=True)
            ]
            for mesh in meshes
        ]

    def close(self) -> None:
        """Drop the temporary files."""
        for spool in self._spools.values():
            spool.close()

    def _append(self, kind: str, values: np.ndarray, element: str, scale: float) -> dict[str, Any]:
        stored = _stored(values, np.dtype("<" + element), scale)
        self._strides[kind] = stored.itemsize * stored.shape[1]
        entry: dict[str, Any] = {
            "byteOffset": self._spools[kind].append(stored.tobytes()),
            "componentType": component_type(stored.dtype),
            "count": len(stored),
            "type": "VEC3",
        }
        if self._encoding.is_packed:
            entry["normalized"] = True
        if kind == "positions":
            entry |= bounds_of(stored[:, :3])
        return entry


def _stored(values: np.ndarray, dtype: np.dtype, scale: float) -> np.ndarray:
    """Values as stored; short rows get a fourth component, for rows must start at multiples of 4 bytes."""
    if dtype.kind == "f":
        return values.astype(dtype)
    stored = np.zeros((len(values), 4), dtype)
    stored[:, :3] = np.rint(values * (np.iinfo(dtype).max / scale))
    return stored
