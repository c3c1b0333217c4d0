"""Garment models without training: exact distances to polygons, and a simple lift."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from isp_assets.garment_model import GarmentModel
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig

Edges = Sequence[tuple[int, Sequence[tuple[float, float]]]]
CODE_SIZE = 2


class PolygonField(PanelField):
    """Exact distance to closed polygons, loops of labelled edges; code[0] grows the panel by as much.

    ``sharpness`` is the slope of the label logits with distance; ``noise`` is added to them.
    """

    def __init__(
        self, loops: Sequence[Edges], num_labels: int, *, sharpness: float = 200.0, noise=None
    ) -> None:
        nn.Module.__init__(self)
        self.config = PanelFieldConfig(num_labels=num_labels, code_size=CODE_SIZE)
        curves = [(label, np.asarray(points, float)) for loop in loops for label, points in loop]
        self.start = torch.tensor(np.concatenate([c[:-1] for _, c in curves]), dtype=torch.float32)
        self.end = torch.tensor(np.concatenate([c[1:] for _, c in curves]), dtype=torch.float32)
        self.labels = torch.tensor(np.concatenate([np.full(len(c) - 1, label) for label, c in curves]))
        self.sharpness, self.noise = sharpness, noise

    def _distances(self, xy: Tensor) -> Tensor:
        along, offset = self.end - self.start, xy[:, None] - self.start
        t = ((offset * along).sum(-1) / (along * along).sum(-1)).clamp(0, 1)
        return ((offset - t[..., None] * along) ** 2).sum(-1).add(1e-16).sqrt()

    def signed_distance(self, xy: Tensor, code: Tensor) -> Tensor:
        nearest = self._distances(xy).min(dim=1).values
        a, b, x, y = self.start, self.end, xy[:, :1], xy[:, 1:]
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        crossing = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1] + 1e-30) * (b[:, 0] - a[:, 0])
        inside = (spans & (x < crossing)).sum(1) % 2 == 1
        return torch.where(inside, -nearest, nearest) - code[..., 0]

    def forward(self, xy: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        distances = self._distances(xy)
        columns = [torch.full((len(xy),), -99.0)]
        for label in range(1, self.config.num_labels + 1):
            own = self.labels == label
            columns.append(-self.sharpness * distances[:, own].min(dim=1).values if own.any() else columns[0])
        logits = torch.stack(columns, dim=1)
        return self.signed_distance(xy, code), logits if self.noise is None else logits + self.noise(logits)


class DiscField(PanelField):
    """A disc of radius 0.5 + code[0] about the origin: the upper half has label 1, the lower label 2."""

    def __init__(self) -> None:
        nn.Module.__init__(self)
        self.config = PanelFieldConfig(num_labels=2, code_size=CODE_SIZE)

    def signed_distance(self, xy: Tensor, code: Tensor) -> Tensor:
        return (xy**2).sum(-1).add(1e-16).sqrt() - 0.5 - code[..., 0]

    def forward(self, xy: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        y = 50 * xy[:, 1]
        return self.signed_distance(xy, code), torch.stack([y * 0 - 99, y, -y], dim=1)


class PillowAtlas(Atlas):
    """Lifts the front to z = +0.1 and the back to z = -0.1 [m], both moved sideways by code[1]."""

    def __init__(self, height: float) -> None:
        nn.Module.__init__(self)
        self.config = AtlasConfig(code_size=CODE_SIZE)
        self.height = height

    def forward(self, xy: Tensor, code: Tensor) -> Tensor:
        return torch.stack([xy[..., 0] + code[..., 1], xy[..., 1], xy[..., 0] * 0 + self.height], dim=-1)


def pillow_model(fields: Mapping[str, PanelField], seam_pairs, anchor_labels=()) -> GarmentModel:
    """A model over analytic panel fields, one metre a network unit."""
    return GarmentModel(
        category="pillow",
        panel_fields=fields,
        atlases={"front": PillowAtlas(0.1), "back": PillowAtlas(-0.1)},
        edge_names={k: f"edge_{k}" for k in range(1, fields["front"].config.num_labels + 1)},
        seam_pairs=tuple(seam_pairs),
        anchor_labels=tuple(anchor_labels),
        rest_pose=np.zeros((24, 3), np.float32),
        panel_center=np.zeros(2, np.float32),
        panel_scale=1.0,
    )


def polygon_model(
    front: Sequence[Edges], back: Sequence[Edges], seam_pairs, anchor_labels=(), **options
) -> GarmentModel:
    """A model whose panels are polygons."""
    labels = max(label for loop in (*front, *back) for label, _ in loop)
    fields = {"front": PolygonField(front, labels, **options), "back": PolygonField(back, labels, **options)}
    return pillow_model(fields, seam_pairs, anchor_labels)


SKIRT = [
    (1, [(-0.6, -0.7), (0.6, -0.7)]),
    (2, [(0.6, -0.7), (0.3, 0.6)]),
    (3, [(0.3, 0.6), (-0.3, 0.6)]),
    (4, [(-0.3, 0.6), (-0.6, -0.7)]),
]
"""Hem, left side, waist, right side."""
SKIRT_SEAMS = ((2, 2), (4, 4))

_LEFT = [
    (2, [(0.35, -0.7), (0.35, 0.1)]),
    (3, [(0.35, 0.1), (0.8, 0.1)]),
    (4, [(0.8, 0.1), (0.8, 0.4)]),
    (5, [(0.8, 0.4), (0.15, 0.5)]),
]
_MIRROR = {2: 9, 3: 8, 4: 7, 5: 6}


def _flip(edges: Edges, names: Mapping[int, int]) -> list:
    return [(names.get(label, label), [(-x, y) for x, y in points[::-1]]) for label, points in edges[::-1]]


SHIRT = [
    (1, [(-0.35, -0.7), (0.35, -0.7)]),
    *_LEFT,
    (10, [(0.15, 0.5), (0.0, 0.4), (-0.15, 0.5)]),
    *_flip(_LEFT, _MIRROR),
]
"""Hem, side, under sleeve, cuff, over sleeve, neckline, and the other half."""
SHIRT_SEAMS = ((2, 2), (3, 3), (5, 5), (6, 6), (8, 8), (9, 9))
_LEFT_FRONT = [
    (1, [(0.02, -0.7), (0.35, -0.7)]),
    *_LEFT,
    (10, [(0.15, 0.5), (0.02, 0.42)]),
    (11, [(0.02, 0.42), (0.02, -0.7)]),
]
JACKET_FRONT = [_LEFT_FRONT, _flip(_LEFT_FRONT, {**_MIRROR, 11: 12})]
"""Two pieces that part in the middle."""
