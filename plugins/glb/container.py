"""The GLB container: one JSON document and one binary chunk, which may be larger than memory.

Reference: Khronos Group, "glTF 2.0 Specification", section 4 (binary glTF).
"""

import json
import shutil
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from isp_assets.errors import PluginError

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
_COMPONENT = {"f4": 5126, "u4": 5125, "u2": 5123, "i2": 5122, "i1": 5120}
_TYPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
_LARGEST = 2**32 - 1


def component_type(dtype: np.dtype) -> int:
    """The number glTF has for an element type."""
    return _COMPONENT[dtype.str[1:]]


class Spool:
    """Bytes on their way into the file, kept in a nameless temporary file: it vanishes when closed."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open until close)
        self.size = 0

    def append(self, data: bytes) -> int:
        """Add bytes; returns where they start."""
        start = self.size
        self._file.write(data)
        self.size += len(data)
        return start

    def copy_to(self, file: BinaryIO) -> None:
        self._file.seek(0)
        shutil.copyfileobj(self._file, file, 1 << 20)

    def close(self) -> None:
        self._file.close()


class GlbFile:
    """A GLB being put together. ``document`` holds the JSON; lists grow with ``append``."""

    def __init__(self, asset: Mapping[str, Any]) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", **asset}}
        self._parts: list[bytes | Spool] = []
        self._size = 0

    def append(self, group: str, entry: Mapping[str, Any]) -> int:
        """Add an entry to a list of the document, such as ``"meshes"``; returns its index."""
        entries = self.document.setdefault(group, [])
        entries.append(dict(entry))
        return len(entries) - 1

    def view(self, data: bytes | Spool, *, target: int | None = None, stride: int | None = None) -> int:
        """A stretch of the binary chunk; returns the index of its buffer view."""
        size = data.size if isinstance(data, Spool) else len(data)
        entry = {"buffer": 0, "byteOffset": self._size, "byteLength": size}
        if stride is not None:
            entry["byteStride"] = stride
        if target is not None:
            entry["target"] = target
        self._add(data, size)
        return self.append("bufferViews", entry)

    def array(self, values: np.ndarray, *, target: int | None = None, bounds: bool = False) -> int:
        """An array of scalars or short vectors; returns the index of its accessor."""
        values = np.ascontiguousarray(values)
        entry = {
            "bufferView": self.view(values.astype(values.dtype.newbyteorder("<")).tobytes(), target=target),
            "componentType": component_type(values.dtype),
            "count": len(values),
            "type": _TYPE[values[0].size],
        }
        if bounds:
            entry |= bounds_of(values)
        return self.append("accessors", entry)

    def write(self, path: Path) -> None:
        """Write everything.

        Raises:
            PluginError: If the file would pass the 4 GiB that the container can hold.
        """
        self.document["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self.document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self._size
        if total > _LARGEST:
            raise PluginError(
                f"glb: {path.name} would take {total / 2**30:.1f} GiB, but GLB ends at 4; "
                "write fewer frames, every second frame, or USD"
            )
        with path.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", self._size, b"BIN\0"))
            for part in self._parts:
                if isinstance(part, Spool):
                    part.copy_to(file)
                else:
                    file.write(part)

    def _add(self, data: bytes | Spool, size: int) -> None:
        padding = b"\0" * (-size % 4)
        self._parts += [data, padding]
        self._size += size + len(padding)


def bounds_of(values: np.ndarray) -> dict[str, list[Any]]:
    """``min`` and ``max`` of every component, as an accessor states them."""
    flat = values.reshape(len(values), -1)
    return {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
