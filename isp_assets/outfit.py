"""An outfit: the ordered layer stack, innermost garment first."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.errors import OutfitError
from isp_assets.fabric_style import FabricStyle


@dataclass(frozen=True, eq=False)
class OutfitItem:
    """One garment of an outfit: where its code lives, and how its cloth looks."""

    name: str
    bundle: GarmentBundle
    code: Float[np.ndarray, " Z"]
    style: FabricStyle


@dataclass(frozen=True, eq=False)
class Outfit:
    """Garments in the order they are put on, with the networks they share.

    The order is the caller's: no rule says that trousers go over a shirt. All
    parts must have been trained on one body; that is checked here.
    """

    items: tuple[OutfitItem, ...]
    skin: SkinBundle
    layering: LayeringBundle | None = None

    def __post_init__(self) -> None:
        if not self.items:
            raise OutfitError("an outfit needs at least one garment, got none")
        for item in self.items:
            if item.bundle.body_sha256 != self.skin.body_sha256:
                raise OutfitError(
                    f"garment {item.name!r} (bundle {item.bundle.category!r}) was trained on body "
                    f"{item.bundle.body_sha256[:12]}, "
                    f"but the skin field on body {self.skin.body_sha256[:12]}; "
                    "take both from one collection, or train them on one body"
                )

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[OutfitItem]:
        return iter(self.items)

    @property
    def body_sha256(self) -> str:
        """Digest of the body that all parts were trained on."""
        return self.skin.body_sha256

    def layer_name(self, index: int) -> str:
        """``L00_tank_top``: the layer's index from the inside out, then the garment's name."""
        return f"L{index:02d}_{self.items[index].name}"
