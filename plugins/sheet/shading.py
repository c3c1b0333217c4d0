"""Simple light: sky from above, a soft key lamp, a little from the camera. Arrays hold linear light."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .tracer import Tracer

_SKY, _BOUNCE, _KEY, _CAMERA = 0.52, 0.30, 0.95, 0.16
_INSIDE = 0.55  # the inner side of cloth is drawn darker, so openings read as openings
_AMBIENT_RAYS = 48
_LIFT = 1e-3  # [m]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of matt surfaces to be lit."""

    point: Float[np.ndarray, "n 3"]
    """World space [m]."""
    normal: Float[np.ndarray, "n 3"]
    """Of the outer side; any length."""
    outside: Bool[np.ndarray, " n"]
    """Whether the outer side is seen."""
    openness: Float[np.ndarray, " n"]
    """Share of the sky that the outer side sees, 0..1."""
    albedo: Float[np.ndarray, "n 3"]
    """Linear."""


def ambient_occlusion(
    tracer: Tracer, points: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " V"]:
    """Share of the sky (cosine weighted, over the outer side) that each point sees, 0..1."""
    index = np.arange(_AMBIENT_RAYS) + 0.5
    radius, angle = np.sqrt(index / _AMBIENT_RAYS), index * np.pi * (3 - np.sqrt(5))
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], 1)
    side = np.cross(normals, np.where(np.abs(normals[:, 1:2]) < 0.9, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-20)
    frame = np.stack([side, np.cross(normals, side), normals], 1)
    directions = local.astype(np.float32) @ frame.astype(np.float32)
    lifted = points + _LIFT * normals
    blocked = tracer.blocked(np.repeat(lifted, _AMBIENT_RAYS, 0), directions.reshape(-1, 3))
    return 1.0 - blocked.reshape(len(points), -1).mean(1)


def shade(
    tracer: Tracer,
    surface: SurfacePoints,
    rays: Float[np.ndarray, "n 3"],
    light: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "n 3"]:
    """Reflected light seen along unit ``rays``, with the lamp in direction ``light`` (unit)."""
    outside = surface.outside
    normal = surface.normal * np.where(outside, 1.0, -1.0)[:, None]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    openness = np.where(outside, surface.openness, 0.5)
    toward_lamp = normal @ light
    lit = np.zeros(len(normal), bool)
    front = np.flatnonzero(toward_lamp > 0)
    start = surface.point[front] + _LIFT * normal[front]
    lit[front] = ~tracer.blocked(start, np.broadcast_to(light, (len(front), 3)))
    ambient = (_BOUNCE + (_SKY - _BOUNCE) * (0.5 + 0.5 * normal[:, 1])) * openness
    camera = _CAMERA * np.clip(-(normal * rays).sum(1), 0.0, 1.0) * (0.4 + 0.6 * openness)
    energy = ambient + camera + _KEY * np.clip(toward_lamp, 0.0, 1.0) * lit
    return surface.albedo * (energy * np.where(outside, 1.0, _INSIDE))[:, None]
