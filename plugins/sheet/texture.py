"""Textures that are read at the right sharpness, and the sRGB curve."""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def linear_from_srgb(value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear light of sRGB values, both in 0..1."""
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """sRGB values of linear light, clipped to 0..1."""
    value = np.clip(value, 0.0, 1.0)
    curve = 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(value <= 0.0031308, value * 12.92, curve)


_LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)


class MipTexture:
    """A texture averaged down on demand, so that fine weaves fade to their mean instead of making moire."""

    def __init__(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        self._image = image
        self._levels: dict[int, UInt8[np.ndarray, "h w 3"]] = {1: image}

    def sample(self, st: Float[np.ndarray, "n 2"], texels: float) -> Float[np.ndarray, "n 3"]:
        """Linear light at texture coordinates, each sample standing for about ``texels`` squared texels."""
        image = self._level(max(1, round(texels)))
        height, width = image.shape[:2]
        x = np.clip(st[:, 0] * width - 0.5, 0, width - 1)
        y = np.clip((1 - st[:, 1]) * height - 0.5, 0, height - 1)
        x0, y0 = x.astype(int), y.astype(int)
        x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
        fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
        top = _LINEAR[image[y0, x0]] * (1 - fx) + _LINEAR[image[y0, x1]] * fx
        bottom = _LINEAR[image[y1, x0]] * (1 - fx) + _LINEAR[image[y1, x1]] * fx
        return top * (1 - fy) + bottom * fy

    def _level(self, factor: int) -> UInt8[np.ndarray, "h w 3"]:
        if factor not in self._levels:
            self._levels[factor] = np.asarray(Image.fromarray(self._image).reduce(factor))
        return self._levels[factor]
