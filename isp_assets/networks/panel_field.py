"""The implicit sewing pattern of one panel: signed distance and edge label at every point of the plane.

Coordinates are network units: ``(panel_xy - panel_center) / panel_scale``, in [-1, 1]^2.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 1.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.networks.mlp import Mlp


@dataclass(frozen=True)
class PanelFieldConfig:
    """Size of a panel field; stored with its weights."""

    num_labels: int
    """Number of edge labels of the category, 0 ("no edge") not counted."""
    code_size: int = 32
    width: int = 128
    shared_depth: int = 3
    distance_depth: int = 6
    label_depth: int = 4
    input_scale: float = 10.0
    """Factor on panel coordinates before the first layer."""

    @classmethod
    def paper(cls, num_labels: int) -> "PanelFieldConfig":
        """The size used by the paper: 0.69 million parameters a panel."""
        return cls(num_labels=num_labels, width=256)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "PanelFieldConfig":
        return cls(**values)


class PanelField(nn.Module):
    """Signed distance and edge labels of one panel, for all garments of a category.

    Shared layers, then one branch for the distance and one for the labels; the
    input enters both branches again.
    """

    def __init__(self, config: PanelFieldConfig) -> None:
        super().__init__()
        self.config = config
        width, entry = config.width, (2, config.code_size)
        branch = (width, *entry)
        self.shared = Mlp(entry, width, width=width, depth=config.shared_depth, activate_last=True)
        self.distance = Mlp(branch, 1, width=width, depth=config.distance_depth)
        self.label = Mlp(branch, config.num_labels + 1, width=width, depth=config.label_depth)

    def forward(
        self, xy: Float[Tensor, "*#batch 2"], code: Float[Tensor, "*#batch Z"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch L"]]:
        """Evaluate Eq. 1.

        Args:
            xy: Points [network units].
            code: Latent codes; leading axes broadcast, so one code of shape [Z] serves a whole grid.

        Returns:
            Signed distance to the panel's border, negative inside [network units], and
            the logits of the label of the nearest edge, ``num_labels + 1`` of them.
        """
        entry = (xy * self.config.input_scale, code)
        hidden = self.shared(*entry)
        return self.distance(hidden, *entry)[..., 0], self.label(hidden, *entry)

    def signed_distance(
        self, xy: Float[Tensor, "*#batch 2"], code: Float[Tensor, "*#batch Z"]
    ) -> Float[Tensor, "*batch"]:
        """The distance alone, as `forward` gives it, without the cost of the labels."""
        entry = (xy * self.config.input_scale, code)
        return self.distance(self.shared(*entry), *entry)[..., 0]
