"""All that turns a latent code into a garment: a category's networks and the facts of its pattern."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from isp_assets.conventions import PANELS
from isp_assets.errors import BundleError
from isp_assets.networks.atlas import Atlas
from isp_assets.networks.panel_field import PanelField

Points = TypeVar("Points", np.ndarray, Tensor)


@dataclass(frozen=True, eq=False)
class GarmentModel:
    """Pattern networks of one category and what its edges mean."""

    category: str
    panel_fields: Mapping[str, PanelField]
    """Signed distance and edge labels, by panel ("front", "back")."""
    atlases: Mapping[str, Atlas]
    """Map to the rest body, by panel."""
    edge_names: Mapping[int, str]
    """Name of every edge label; labels count from 1."""
    seam_pairs: tuple[tuple[int, int], ...]
    """Edge labels (front, back) that are sewn together."""
    anchor_labels: tuple[int, ...]
    """Edge labels whose points are held by the body, as a waistband is."""
    rest_pose: Float[np.ndarray, "24 3"]
    """Axis-angle pose of the body that rest positions belong to [rad]."""
    panel_center: Float[np.ndarray, "2"]
    """Pattern point at the origin of network coordinates [m]."""
    panel_scale: float
    """Metres a network unit."""

    def __post_init__(self) -> None:
        for what, networks in (("panel_fields", self.panel_fields), ("atlases", self.atlases)):
            if tuple(networks) != PANELS:
                raise BundleError(
                    f"category {self.category!r}: {what} must be keyed {PANELS}, got {tuple(networks)}"
                )
        both: Any = [*self.panel_fields.values(), *self.atlases.values()]
        sizes = {network.config.code_size for network in both}
        if len(sizes) != 1:
            raise BundleError(
                f"category {self.category!r}: networks disagree on the code size: {sorted(sizes)}"
            )
        labels = {label for pair in self.seam_pairs for label in pair} | set(self.anchor_labels)
        if unknown := labels - set(self.edge_names):
            raise BundleError(f"category {self.category!r}: labels {sorted(unknown)} have no edge name")
        if self.edge_names and max(self.edge_names) > self.num_labels:
            raise BundleError(
                f"category {self.category!r}: the panel fields know labels 1..{self.num_labels}, "
                f"but edge names go to {max(self.edge_names)}"
            )
        if not self.panel_scale > 0:
            raise BundleError(
                f"category {self.category!r}: panel_scale must be > 0 m, got {self.panel_scale}"
            )

    @property
    def code_size(self) -> int:
        return self.panel_fields["front"].config.code_size

    @property
    def num_labels(self) -> int:
        """Number of edge labels, 0 ("no edge") not counted."""
        return self.panel_fields["front"].config.num_labels

    def to_network(self, panel_xy: Points) -> Points:
        """Network coordinates of panel points [m]."""
        return (panel_xy - self._center(panel_xy)) / self.panel_scale

    def to_panel(self, xy: Points) -> Points:
        """Panel points [m] at network coordinates."""
        return xy * self.panel_scale + self._center(xy)

    def _center(self, like: Points) -> Points:
        if isinstance(like, Tensor):
            return like.new_tensor(self.panel_center)
        return self.panel_center.astype(like.dtype)
