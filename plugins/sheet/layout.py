"""The page of a contact sheet: title, legend of layers, a grid of pictures with captions."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from isp_assets.frames import Layer

_PAPER, _INK, _FAINT = (250, 250, 251), (32, 34, 38), (116, 120, 128)
_MARGIN, _HEADER, _CAPTION, _GAP, _SIDE = 20, 74, 26, 6, 26
_SWATCH = 22


def compose_page(
    title: str,
    layers: Sequence[Layer],
    columns: Sequence[str],
    rows: Sequence[str],
    pictures: Sequence[Sequence[UInt8[np.ndarray, "h w 3"]]],
) -> Image.Image:
    """Lay out ``pictures[row][column]``, all of one size, under their captions."""
    high, wide = pictures[0][0].shape[:2]
    width = max(2 * _MARGIN + _SIDE + len(columns) * (wide + _GAP) - _GAP, _legend_width(title, layers))
    height = _HEADER + _CAPTION + len(rows) * (high + _GAP) - _GAP + _MARGIN
    page = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(page)
    draw.text((_MARGIN, 12), title, _INK, font=_font(20))
    _draw_legend(page, draw, layers)
    for column, caption in enumerate(columns):
        x = _MARGIN + _SIDE + column * (wide + _GAP)
        draw.text((x + wide / 2, _HEADER + _CAPTION / 2), caption, _FAINT, font=_font(14), anchor="mm")
        for row in range(len(rows)):
            page.paste(Image.fromarray(pictures[row][column]), (x, _HEADER + _CAPTION + row * (high + _GAP)))
    for row, caption in enumerate(rows):
        middle = _HEADER + _CAPTION + row * (high + _GAP) + high // 2
        _draw_upright(page, caption, (_MARGIN + _SIDE // 2 - 4, middle))
    return page


def _draw_legend(page: Image.Image, draw: ImageDraw.ImageDraw, layers: Sequence[Layer]) -> None:
    x, y = _MARGIN, 44
    for layer in layers:
        page.paste(_swatch(layer), (x, y))
        draw.rectangle((x, y, x + _SWATCH, y + _SWATCH), outline=_FAINT)
        draw.text((x + _SWATCH + 8, y + _SWATCH / 2), layer.name, _INK, font=_font(14), anchor="lm")
        x += _SWATCH + 30 + int(_font(14).getlength(layer.name))


def _legend_width(title: str, layers: Sequence[Layer]) -> int:
    legend = sum(_SWATCH + 30 + int(_font(14).getlength(layer.name)) for layer in layers)
    return 2 * _MARGIN + max(legend, int(_font(20).getlength(title)))


def _swatch(layer: Layer) -> Image.Image:
    """A piece of cloth from the middle of the front panel, at a size where its pattern shows."""
    high, wide = layer.texture.shape[:2]
    s, t = layer.garment.panels["front"].st.mean(0)
    reach = max(8, min(high, wide) // 16)
    x = int(np.clip(s * wide, reach, max(wide - reach, reach)))
    y = int(np.clip((1 - t) * high, reach, max(high - reach, reach)))
    piece = Image.fromarray(layer.texture[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach])
    return piece.resize((_SWATCH, _SWATCH), Image.Resampling.BOX)


def _draw_upright(page: Image.Image, text: str, middle: tuple[int, int]) -> None:
    font = _font(14)
    strip = Image.new("RGB", (int(font.getlength(text)) + 4, 20), _PAPER)
    ImageDraw.Draw(strip).text((strip.width / 2, 10), text, _FAINT, font=font, anchor="mm")
    turned = strip.rotate(90, expand=True)
    page.paste(turned, (middle[0] - turned.width // 2, middle[1] - turned.height // 2))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
