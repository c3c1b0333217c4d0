"""A tube of cloth with a known flat state, for tests of its energy and of relaxing it."""

import numpy as np
from collision_shapes import tube

from isp_assets.geometry.elastic_cloth import ElasticCloth
from isp_assets.geometry.energy import ClothRest, Fabric, cloth_rest

SHAPE = tube(0.104)
FABRIC = Fabric()


def flat_rest() -> ClothRest:
    """The tube cut open and laid flat: its faces' own shapes in their own planes."""
    vertices, faces = SHAPE
    corner = vertices[faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    length = np.linalg.norm(first, axis=1)
    along = (first * second).sum(1) / length
    height = np.linalg.norm(np.cross(first, second), axis=1) / length
    zero = np.zeros_like(length)
    flat = np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([along, height], 1)], 1)
    return cloth_rest(faces, flat, len(vertices), FABRIC)


def elastic_cloth(held: np.ndarray | None = None) -> ElasticCloth:
    none = np.zeros(len(SHAPE[0]), bool)
    return ElasticCloth(flat_rest(), FABRIC, free=~(none if held is None else held))
