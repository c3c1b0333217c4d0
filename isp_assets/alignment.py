"""Units and axes of a foreign mesh: given, or found by comparison with known garments.

Our space is metres, Y up, facing +Z (see `conventions`).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from isp_assets.errors import MeshError
from isp_assets.garment_clouds import GarmentClouds
from isp_assets.geometry.surface_distance import Surface

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048}
"""Metres in a unit of length."""
UP_AXES = ("y", "z")
_SAMPLES = 400
_CLOUDS = 40  # garments that an orientation is tried against
_PREFERENCE = 0.85  # a less usual unit, turn or place must fit this much better than a usual one
_USUAL_UNITS = ("m", "cm", "mm")


@dataclass(frozen=True)
class Alignment:
    """How the coordinates of a file become ours."""

    unit: str = "m"
    up: str = "y"
    """Axis of the file that points up: "y" or "z"."""
    turn: int = 0
    """Degrees about our Y axis, after the up axis is in its place: 0, 90, 180 or 270."""
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added last [m]."""

    def __post_init__(self) -> None:
        if self.unit not in UNITS or self.up not in UP_AXES or self.turn not in (0, 90, 180, 270):
            raise MeshError(
                f"alignment: unit must be one of {', '.join(UNITS)}, up one of {', '.join(UP_AXES)} and turn "
                f"0, 90, 180 or 270; got {self.unit!r}, {self.up!r} and {self.turn}"
            )

    @classmethod
    def parse(cls, text: str) -> "Alignment":
        """Read ``"cm,z"`` or ``"mm,y,180"``: unit, up axis, turn.

        Raises:
            MeshError: If the text is no alignment.
        """
        match = re.fullmatch(r"\s*([a-z]+)\s*(?:,\s*([yz])\s*(?:,\s*(\d+)\s*)?)?", text.lower())
        if match is None:
            raise MeshError(f"not an alignment: {text!r}; expected UNIT[,UP[,TURN]], as in cm,z or mm,y,180")
        return cls(match[1], match[2] or "y", int(match[3] or 0))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Our axes from those of the file."""
        upright = np.eye(3) if self.up == "y" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        cosine, sine = np.round(np.cos(np.deg2rad(self.turn))), np.round(np.sin(np.deg2rad(self.turn)))
        return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]) @ upright

    def moved(self, shift: Float[np.ndarray, " 3"]) -> "Alignment":
        """The same with a further shift [m]."""
        x, y, z = np.add(self.translation, shift).tolist()
        return replace(self, translation=(x, y, z))

    def apply(self, surface: Surface) -> Surface:
        """The surface in our space."""
        vertices = UNITS[self.unit] * surface.vertices @ self.rotation.T + np.array(self.translation)
        return Surface(vertices, surface.faces)


def detect_alignment(surface: Surface, clouds: GarmentClouds) -> Alignment:
    """Find unit, axes and place of a surface by the garment cloud that it resembles most.

    A mesh that already fits where it is stays where it is. One that must be moved is put
    so that its centre is that of the most similar garment.

    Raises:
        MeshError: If in no unit the surface has the size of a garment, or no cloud has points.
    """
    usable = [cloud for cloud in clouds.points if len(cloud) > 10]
    if not usable:
        raise MeshError(
            "no garment to compare with has a shape, so nothing can be detected; give the alignment, "
            "or train the bundle"
        )
    chosen = GarmentClouds(
        tuple(usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, _CLOUDS).astype(int)))
    )
    points, _ = surface.sample(_SAMPLES, np.random.default_rng(0))
    found: list[tuple[float, Alignment]] = []
    for candidate in _candidates(points, chosen):
        turned = UNITS[candidate.unit] * points @ candidate.rotation.T
        for moved in (False, True):
            score, shift = _best(turned, chosen, moved=moved)
            unusual = (candidate.turn != 0) + (candidate.unit not in _USUAL_UNITS) + moved
            found.append((score / _PREFERENCE**unusual, candidate.moved(shift)))
    return min(found, key=lambda row: row[0])[1]


def _candidates(points: Float[np.ndarray, "n 3"], clouds: GarmentClouds) -> Iterator[Alignment]:
    """Units in which the surface is as large as the clouds, with every up axis and turn."""
    sizes = [float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in clouds.points]
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    units = [name for name, unit in UNITS.items() if 0.6 * min(sizes) < unit * size < 1.7 * max(sizes)]
    if not units:
        raise MeshError(
            f"the mesh is {size:.3g} units across; in none of {', '.join(UNITS)} does it have the size of a "
            f"garment of this category, {min(sizes):.2f} to {max(sizes):.2f} m; give its unit, or scale it"
        )
    return (Alignment(unit, up, turn) for unit, up, turn in product(units, UP_AXES, (0, 90, 180, 270)))


def _best(
    points: Float[np.ndarray, "n 3"], clouds: GarmentClouds, *, moved: bool
) -> tuple[float, Float[np.ndarray, " 3"]]:
    """Mean distance to the most similar cloud [m], and the shift that puts the points there."""
    best, shift = np.inf, np.zeros(3)
    for cloud in clouds.points:
        offset = _middle(cloud) - _middle(points) if moved else np.zeros(3)
        score = float(GarmentClouds((cloud,)).distances(points + offset)[0])
        if score < best:
            best, shift = score, offset
    return best, shift


def _middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"]:
    return 0.5 * (points.min(axis=0) + points.max(axis=0))
