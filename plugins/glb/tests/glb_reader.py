"""A small, independent GLB reader for the tests; plays the animation by linear interpolation."""

import json
import struct
from pathlib import Path

import numpy as np

_DTYPE = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5122: "<i2", 5120: "<i1"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


class Glb:
    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, total = struct.unpack_from("<4sII", data)
        assert (magic, version, total) == (b"glTF", 2, len(data))
        length, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json = json.loads(data[20 : 20 + length])
        size, kind = struct.unpack_from("<I4s", data, 20 + length)
        assert kind == b"BIN\0"
        self.binary = data[28 + length :]
        assert len(self.binary) == size == self.json["buffers"][0]["byteLength"]

    def node(self, name: str) -> dict:
        return next(node for node in self.json["nodes"] if node["name"] == name)

    def primitive(self, name: str) -> dict:
        return self.json["meshes"][self.node(name)["mesh"]]["primitives"][0]

    def accessor(self, index: int) -> np.ndarray:
        entry = self.json["accessors"][index]
        view = self.json["bufferViews"][entry["bufferView"]]
        dtype, width = np.dtype(_DTYPE[entry["componentType"]]), _WIDTH[entry["type"]]
        stride = view.get("byteStride", dtype.itemsize * width)
        start = view["byteOffset"] + entry.get("byteOffset", 0)
        assert (
            start + stride * (entry["count"] - 1) + dtype.itemsize * width
            <= view["byteOffset"] + view["byteLength"]
        )
        rows = np.ndarray((entry["count"], width), dtype, self.binary, start, (stride, dtype.itemsize))
        if "min" in entry:
            assert rows.min(0).tolist() == entry["min"]
            assert rows.max(0).tolist() == entry["max"]
        if entry.get("normalized"):
            return np.maximum(rows / np.iinfo(dtype).max, -1.0)
        return rows.copy()

    def weights(self, name: str, time: float) -> np.ndarray:
        node = self.json["nodes"].index(self.node(name))
        (animation,) = self.json["animations"]
        (channel,) = (c for c in animation["channels"] if c["target"] == {"node": node, "path": "weights"})
        sampler = animation["samplers"][channel["sampler"]]
        assert sampler["interpolation"] == "LINEAR"
        times = self.accessor(sampler["input"])[:, 0]
        table = self.accessor(sampler["output"]).reshape(len(times), -1)
        return np.array([np.interp(time, times, column) for column in table.T])

    def attribute(self, name: str, kind: str, time: float) -> np.ndarray:
        """POSITION or NORMAL of a node at a time [s]."""
        primitive = self.primitive(name)
        value = self.accessor(primitive["attributes"][kind]).astype(np.float64)
        if "targets" in primitive:
            for weight, target in zip(self.weights(name, time), primitive["targets"], strict=True):
                value = value + weight * self.accessor(target[kind])
        return value
