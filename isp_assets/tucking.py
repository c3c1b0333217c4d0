"""Tuck the layers of an outfit under those that the body holds, frame by frame.

Which cloth is tucked in shows at rest, where nothing is creased: the hem of a shirt that
stands out of the trousers worn over it. In every pose it is pressed to the body, and free
to crumple; whatever else stands out of a cover gives way to it.

Positions are in metres; NumPy, one frame at a time.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from isp_assets.dressing import WornGarment
from isp_assets.geometry.obstacle import Obstacle
from isp_assets.geometry.tuck import Hidden, press, tuck

Positions = Float[np.ndarray, "_ 3"]


class Tucking:
    """What is tucked in where, in one outfit on one body."""

    def __init__(self, worn: Sequence[WornGarment], rest: Sequence[Positions], body: Obstacle) -> None:
        """Find what stands out of its covers.

        Args:
            worn: The layers, innermost first.
            rest: Each of them at rest on the wearer, all in one pose.
            body: The skin in that pose.
        """
        covers: list[Obstacle] = []
        hidden = []
        for garment, vertices in zip(reversed(worn), reversed(rest), strict=True):
            hidden.append(Hidden.at_rest(vertices, garment.collision, covers, body))
            self._cover(garment, vertices, covers)
        self._hidden = tuple(reversed(hidden))
        self.worn = tuple(
            replace(
                garment,
                stretch=garment.stretch.loosened((part.share > 0).astype(float)),
                tucked=part.share > 0,
            )
            for garment, part in zip(worn, self._hidden, strict=True)
        )
        """The layers, told what of them is hidden, and free to crumple there."""

    def frame(self, layers: Sequence[Positions], body: Obstacle) -> list[Positions]:
        """The layers of one frame, tucked in; the same arrays where nothing is.

        Args:
            layers: Each layer as it is draped alone.
            body: The skin.
        """
        covers: list[Obstacle] = []
        tucked = []
        for garment, hidden, vertices in zip(
            reversed(self.worn), reversed(self._hidden), reversed(layers), strict=True
        ):
            after = tuck(vertices, garment.collision, covers, body)
            tucked.append(press(after, garment.collision, hidden, body))
            self._cover(garment, tucked[-1], covers)
        return tucked[::-1]

    def _cover(self, garment: WornGarment, vertices: Positions, covers: list[Obstacle]) -> None:
        if len(garment.layer.garment.anchors):  # what the body holds cannot give way; all else is lifted
            covers.append(Obstacle(garment.collision, vertices, margin=0.0))
