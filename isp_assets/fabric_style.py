"""How a cloth looks: its colours and the pattern that is woven, knitted or printed into it.

Patterns are functions of the position on the flat panel in metres, so a stripe
of 2 cm is 2 cm wide on every garment. Each wave is averaged over a pixel in
closed form: what is finer than a pixel fades to its mean instead of aliasing.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from isp_assets.errors import InputError

Color = tuple[float, float, float]
Image = Float[np.ndarray, "_ _"]
"""Values per pixel; an axis of length 1 is broadcast."""

REPEATS = {"plain": 0.0012, "stripes": 0.024, "checks": 0.03, "denim": 0.0022, "knit": 0.004}
"""Kinds of cloth, and how far their pattern takes to repeat unless the style says otherwise [m]."""

_YARN = 0.0012
_STREAK = 0.002
_TABLE = 1024


@dataclass(frozen=True)
class FabricStyle:
    """The look of one garment's cloth. Colours are sRGB in 0..1."""

    color: Color = (0.80, 0.78, 0.74)
    kind: str = "plain"
    accent: Color | None = None
    """Second colour of the pattern; derived from ``color`` if left out."""
    scale: float | None = None
    """Repeat of the pattern [m]; the kind's own if left out."""

    def __post_init__(self) -> None:
        if self.kind not in REPEATS:
            raise InputError(f"fabric kind must be one of {', '.join(REPEATS)}; got {self.kind!r}")
        for what, color in (("color", self.color), ("accent", self.accent or self.color)):
            if len(color) != 3 or not all(0 <= c <= 1 for c in color):
                raise InputError(f"fabric {what} must be three numbers in 0..1, got {color}")
        if self.scale is not None and not 0 < self.scale < 10:
            raise InputError(f"fabric scale must lie in 0..10 m, got {self.scale:g}")

    @classmethod
    def from_text(
        cls, *, color: str, kind: str = "plain", accent: str | None = None, scale: float | None = None
    ) -> "FabricStyle":
        """A style with colours as ``"#e8e4da"``.

        Raises:
            InputError: If a colour is no six-digit hexadecimal colour, or a value is out of range.
        """
        return cls(_parse_color(color), kind, None if accent is None else _parse_color(accent), scale)

    @property
    def second_color(self) -> Color:
        """``accent``, or else a darker or lighter tone of the first colour."""
        if self.accent is not None:
            return self.accent
        if self.kind == "denim" or _luminance(self.color) < 0.25:
            return tuple(c + 0.55 * (1 - c) for c in self.color)  # type: ignore[return-value]
        return tuple(0.55 * c for c in self.color)  # type: ignore[return-value]

    @property
    def thread_color(self) -> Color:
        """Colour of visible stitching: ochre on denim, else a little off the cloth."""
        if self.kind == "denim":
            return (0.80, 0.58, 0.30)
        factor = 0.62 if _luminance(self.color) > 0.3 else 1.8
        return tuple(min(factor * c + (factor > 1) * 0.08, 1.0) for c in self.color)  # type: ignore[return-value]


def weave(style: FabricStyle, x: Image, y: Image, pixel: float) -> tuple[Image, Image]:
    """The pattern of a cloth at flat positions.

    Args:
        style: Kind and scale of the cloth.
        x, y: Positions on the panel [m]; either may have an axis of length 1.
        pixel: Side of a pixel [m]; finer detail is averaged away.

    Returns:
        Brightness (about 1), and the share of the second colour (0..1), broadcastable to the image.
    """
    repeat = style.scale if style.scale is not None else REPEATS[style.kind]
    return _PATTERNS[style.kind](x, y, repeat, pixel)


def _plain(x: Image, y: Image, repeat: float, pixel: float) -> tuple[Image, Image]:
    return _threads(x, y, repeat, pixel), np.zeros_like(x)


def _stripes(x: Image, y: Image, repeat: float, pixel: float) -> tuple[Image, Image]:
    return _threads(x, y, _YARN, pixel), _bars(x, repeat, pixel)


def _checks(x: Image, y: Image, repeat: float, pixel: float) -> tuple[Image, Image]:
    return _threads(x, y, _YARN, pixel), 0.5 * (_bars(x, repeat, pixel) + _bars(y, repeat, pixel))


def _denim(x: Image, y: Image, repeat: float, pixel: float) -> tuple[Image, Image]:
    twill = _wave(x + y, repeat, pixel)
    warp = _streaks(x, 3, pixel)
    return 1 + 0.10 * twill + 0.012 * warp, np.clip(0.07 + 0.07 * twill + 0.016 * warp, 0, 1)


def _knit(x: Image, y: Image, repeat: float, pixel: float) -> tuple[Image, Image]:
    column = x / repeat
    slant = np.abs(2 * (column - np.floor(column)) - 1)
    loops = _wave(y + 0.4 * repeat * slant, 0.8 * repeat, pixel)
    shade = 1 + 0.08 * loops - 0.07 * _wave(x, repeat, pixel) + 0.012 * _streaks(y, 4, pixel)
    return shade, np.zeros_like(x)


_PATTERNS: dict[str, Callable[[Image, Image, float, float], tuple[Image, Image]]] = {
    "plain": _plain, "stripes": _stripes, "checks": _checks, "denim": _denim, "knit": _knit,
}  # fmt: skip


def _threads(x: Image, y: Image, yarn: float, pixel: float) -> Image:
    """Brightness of a plain weave: threads across, threads along, and yarns of uneven thickness."""
    shade = 1 + 0.05 * (_wave(x, yarn, pixel) + _wave(y, yarn, pixel))
    return shade + 0.018 * (_streaks(x, 1, pixel) + _streaks(y, 2, pixel))


def _wave(u: Image, repeat: float, pixel: float) -> Image:
    """A cosine in -1..1, averaged over one pixel: exactly sinc times the cosine."""
    strength = np.sinc(min(pixel / repeat, 1.0))
    return strength * np.cos(u * np.float32(2 * np.pi / repeat)) if strength > 0 else np.zeros_like(u)


def _bars(u: Image, repeat: float, pixel: float) -> Image:
    """1 on the first half of each repeat, 0 on the second, averaged over one pixel."""
    width = max(pixel / repeat, 1e-4)

    def covered(v: Image) -> Image:
        whole = np.floor(v)
        return 0.5 * whole + np.minimum(v - whole, 0.5)

    return (covered(u / repeat + width / 2) - covered(u / repeat - width / 2)) / width


def _streaks(u: Image, seed: int, pixel: float) -> Image:
    """Smooth noise of one coordinate, unit variance at its nodes; the same for every image size."""
    table = np.random.default_rng(seed).standard_normal(_TABLE).astype(np.float32)
    node = u * np.float32(1 / _STREAK)
    left = np.floor(node)
    index = left.astype(np.int32)
    weight = node - left
    value = table[index % _TABLE] * (1 - weight) + table[(index + 1) % _TABLE] * weight
    return value * np.float32(min(1.0, _STREAK / pixel) ** 0.5)


def _luminance(color: Color) -> float:
    return 0.30 * color[0] + 0.59 * color[1] + 0.11 * color[2]


def _parse_color(text: str) -> Color:
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        raise InputError(f"a colour must look like '#e8e4da', got {text!r}")
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
