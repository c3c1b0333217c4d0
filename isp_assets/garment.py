"""A garment: two flat panels, the seams that join them, and the mesh they make on the rest body.

A panel holds its own points in the plane. ``vertex_index`` says which vertex of
the sewn garment each point is: two points on a seam share one vertex. So flat
lengths, texture coordinates and the sewn surface stay consistent by construction.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from isp_assets.conventions import PANELS
from isp_assets.errors import GarmentError


@dataclass(frozen=True, eq=False)
class Panel:
    """One flat piece of cloth, triangulated."""

    panel_xy: Float[np.ndarray, "P 2"]
    """Flat positions in the plane of the pattern [m]."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles over the panel's own points; wound so that the sewn surface faces away from the body."""
    vertex_index: Int[np.ndarray, " P"]
    """Garment vertex of each panel point."""
    st: Float[np.ndarray, "P 2"]
    """Texture coordinates in 0..1; the two panels do not overlap in the texture."""
    border_label: Int[np.ndarray, " P"]
    """Edge label of a border point, 0 for an interior point. A corner carries that of the edge it starts."""


@dataclass(frozen=True, eq=False)
class Seam:
    """Points of the front panel and points of the back panel that are sewn together, in order."""

    labels: tuple[int, int]
    """Edge labels (front, back) that this seam joins."""
    front: Int[np.ndarray, " n"]
    back: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Garment:
    """A sewn garment on the rest body.

    Invariants, checked once here: indices in range, every vertex used, sewn
    points share their vertex, no degenerate index triple, finite positions.
    """

    name: str
    category: str
    code: Float[np.ndarray, " Z"]
    rest_vertices: Float[np.ndarray, "V 3"]
    """Positions on the body in ``rest_pose`` [m]."""
    rest_pose: Float[np.ndarray, "24 3"]
    """Axis-angle pose of the rest body [rad]; zero is the T-pose."""
    panels: Mapping[str, Panel]
    seams: tuple[Seam, ...]
    anchors: Int[np.ndarray, " A"]
    """Vertices held by the body itself (a waistband); may be empty."""

    def __post_init__(self) -> None:
        if tuple(self.panels) != PANELS:
            raise GarmentError(
                f"garment {self.name!r}: panels must be {PANELS} in this order, got {tuple(self.panels)}"
            )
        if not np.isfinite(self.rest_vertices).all():
            raise GarmentError(
                f"garment {self.name!r}: rest vertices hold NaN or infinity; "
                "the code lies outside the trained range"
            )
        used = np.zeros(self.num_vertices, bool)
        for side, panel in self.panels.items():
            self._check_panel(side, panel)
            used[panel.vertex_index[panel.faces.ravel()]] = True
        if not used.all():
            raise GarmentError(f"garment {self.name!r}: {int((~used).sum())} vertices belong to no face")
        for seam in self.seams:
            front, back = (
                self.panels[s].vertex_index[i] for s, i in zip(PANELS, (seam.front, seam.back), strict=True)
            )
            if not np.array_equal(front, back):
                raise GarmentError(
                    f"garment {self.name!r}: seam {seam.labels} is not sewn: "
                    "its panel points have different vertices"
                )

    def _check_panel(self, side: str, panel: Panel) -> None:
        where = f"garment {self.name!r}, {side} panel"
        for what, index, limit in (
            ("faces", panel.faces, len(panel.panel_xy)),
            ("vertex_index", panel.vertex_index, self.num_vertices),
        ):
            if index.size and (index.min() < 0 or index.max() >= limit):
                raise GarmentError(
                    f"{where}: {what} must lie in 0..{limit - 1}, got {index.min()}..{index.max()}"
                )
        corners = panel.vertex_index[panel.faces]
        if (corners == np.roll(corners, 1, axis=1)).any():
            raise GarmentError(f"{where}: a face uses one vertex twice; the sewing folded it away")

    @property
    def num_vertices(self) -> int:
        return len(self.rest_vertices)

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles of the sewn garment, front panel first."""
        return np.concatenate([p.vertex_index[p.faces] for p in self.panels.values()])

    @property
    def face_panel(self) -> Int[np.ndarray, " F"]:
        """0 for a face of the front panel, 1 for the back."""
        return np.repeat(np.arange(len(PANELS)), [len(p.faces) for p in self.panels.values()])

    @property
    def corner_xy(self) -> Float[np.ndarray, "F 3 2"]:
        """Flat positions of every face's corners [m], in the order of ``faces``."""
        return np.concatenate([p.panel_xy[p.faces] for p in self.panels.values()])

    @property
    def st(self) -> Float[np.ndarray, "P_all 2"]:
        """Texture coordinates of all panel points, front first."""
        return np.concatenate([p.st for p in self.panels.values()])

    @property
    def corner_st_index(self) -> Int[np.ndarray, "F 3"]:
        """Row of ``st`` for every face corner."""
        offset = len(self.panels["front"].panel_xy)
        return np.concatenate([p.faces + k * offset for k, p in enumerate(self.panels.values())])
