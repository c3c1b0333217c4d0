"""Baking a garment's texture: cloth, hems and stitched seams on the flat panels.

The front panel lies in the left half of the image, the back panel in the right.
Cloth continues a little beyond the edges, and the rest of the image holds its
mean colour, so neither filtering nor mip maps bleed a foreign colour in.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw

from isp_assets.conventions import PANELS
from isp_assets.errors import GarmentError, InputError
from isp_assets.fabric_style import FabricStyle, weave
from isp_assets.garment import Garment, Panel

__all__ = ["FabricStyle", "bake_texture"]

_HEM, _SEAM, _WAIST = 0, 1, 2
_STITCH_ROWS = {_HEM: (0.010,), _SEAM: (0.003,), _WAIST: (0.004, 0.032)}
"""How far inside the edge the rows of stitches lie [m]."""
_DASH, _GAP, _THREAD = 0.0032, 0.0013, 0.0009
_CREASE = 0.0015
_WEAR = 0.006
_BLEED = 12
"""How far cloth continues beyond the edge [pixels]."""
_AFFINE_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class _Window:
    """The part of the image that shows one panel."""

    rows: slice
    columns: slice
    x: Float[np.ndarray, "#h #w"]
    y: Float[np.ndarray, "#h #w"]
    """Flat position of every pixel's centre [m]; of length 1 along an axis it does not depend on."""
    pixel: float
    """Side of a pixel [m]."""
    points: Float[np.ndarray, "P 2"]
    """Panel points in pixels (column, row) of the window."""


@dataclass(frozen=True, eq=False)
class _Border:
    """A panel's edges, segment by segment."""

    start: Float[np.ndarray, "n 2"]
    end: Float[np.ndarray, "n 2"]
    """End points in pixels of the window."""
    along: Float[np.ndarray, " n"]
    """Length along the edge up to ``start`` [m]."""
    length: Float[np.ndarray, " n"]
    """Length of the segment [m]."""
    kind: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Near:
    """Pixels near an edge, and where on the edge the nearest point is."""

    pixels: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]
    """Rows and columns of the window."""
    distance: Float[np.ndarray, " m"]
    along: Float[np.ndarray, " m"]
    """[m]"""
    kind: Int[np.ndarray, " m"]


def bake_texture(garment: Garment, style: FabricStyle, *, height: int = 1024) -> UInt8[np.ndarray, "H W 3"]:
    """The sRGB texture of a garment, ``2 * height`` pixels wide; row 0 is the top (t = 1).

    Raises:
        GarmentError: If ``st`` is no affine map of the flat panel, or leaves the panel's half.
        InputError: If ``height`` is out of range.
    """
    if not 16 <= height <= 8192:
        raise InputError(f"texture height must lie in 16..8192 pixels, got {height}")
    image = np.empty((height, 2 * height, 3), np.uint8)
    for side, panel in garment.panels.items():
        window = _window(garment, side, height)
        loops = border_loops(panel)
        inside, covered = _masks(window, loops)
        tile = _cloth(window, style, inside, _border(garment, side, loops, window))
        mean = _mean(tile[::4, ::4], inside[::4, ::4], style)
        tile[~covered] = mean
        half = slice(0, height) if side == PANELS[0] else slice(height, None)
        image[:, half] = mean
        image[window.rows, window.columns] = tile
    return image


def border_loops(panel: Panel) -> list[Int[np.ndarray, " _"]]:
    """Closed loops of panel points along the panel's edges, in the direction of its faces."""
    edges = np.concatenate([panel.faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    size = len(panel.panel_xy)
    twin = np.isin(edges @ [size, 1], edges @ [1, size])
    following = {int(a): int(b) for a, b in edges[~twin]}
    loops = []
    while following:
        loop = [next(iter(following))]
        while (point := following.pop(loop[-1], None)) is not None:
            loop.append(point)
        loops.append(np.array(loop[:-1] if loop[0] == loop[-1] else loop))
    return loops


def _window(garment: Garment, side: str, height: int) -> _Window:
    panel = garment.panels[side]
    size = np.array([2 * height, height])
    columns = slice(0, height) if side == PANELS[0] else slice(height, 2 * height)
    pixels = (panel.st * [1, -1] + [0, 1]) * size
    where = f"garment {garment.name!r}, {side} panel"
    if (pixels < [columns.start - 1e-6, -1e-6]).any() or (
        pixels > [columns.stop + 1e-6, height + 1e-6]
    ).any():
        raise GarmentError(
            f"{where}: st must lie in its half of the texture, s in {columns.start}..{columns.stop} pixels"
        )
    low = np.maximum(np.floor(pixels.min(0)).astype(int) - _BLEED, [columns.start, 0])
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + _BLEED, [columns.stop, height])
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    affine, *_ = np.linalg.lstsq(homogeneous, panel.panel_xy, rcond=None)
    if np.abs(homogeneous @ affine - panel.panel_xy).max() > _AFFINE_TOLERANCE:
        raise GarmentError(
            f"{where}: st must be an affine map of panel_xy; cloth would be stretched in the texture"
        )
    column = np.arange(low[0], high[0], dtype=np.float32) + np.float32(0.5)
    row = (np.arange(low[1], high[1], dtype=np.float32) + np.float32(0.5))[:, None]
    x, y = (_linear(column, row, a, b) + np.float32(c) for a, b, c in affine.T)
    pixel = float(np.sqrt(abs(np.linalg.det(affine[:2]))))
    return _Window(slice(low[1], high[1]), slice(low[0], high[0]), x, y, pixel, pixels - low)


def _linear(
    column: Float[np.ndarray, " w"], row: Float[np.ndarray, "h 1"], a: float, b: float
) -> Float[np.ndarray, "#h #w"]:
    """``a * column + b * row``; narrow where a coefficient vanishes, so the usual case is cheap."""
    terms = [np.float32(k) * v for k, v in ((a, column[None]), (b, row)) if abs(k) * v.size > 1e-6]
    return terms[0] if len(terms) == 1 else terms[0] + terms[1]


def _masks(
    window: _Window, loops: list[Int[np.ndarray, " _"]]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Pixels inside the panel, and pixels to fill with cloth (the panel and a rim around it)."""
    shape = np.broadcast_shapes(window.x.shape, window.y.shape)
    inside, rim = np.zeros(shape, bool), Image.new("1", shape[::-1])
    for loop in loops:
        # PIL puts the centre of a pixel at whole coordinates.
        outline = [tuple(p) for p in window.points[np.append(loop, loop[:1])] - 0.5]
        filled = Image.new("1", shape[::-1])
        ImageDraw.Draw(filled).polygon(outline, fill=1)
        inside ^= np.asarray(filled)  # a hole's loop lies inside the outer one
        ImageDraw.Draw(rim).line(outline, fill=1, width=2 * _BLEED, joint="curve")
    return inside, inside | np.asarray(rim)


def _border(garment: Garment, side: str, loops: list[Int[np.ndarray, " _"]], window: _Window) -> _Border:
    panel, points = garment.panels[side], window.points
    keys = [_edge_keys(i[:-1], i[1:]) for i in (getattr(seam, side) for seam in garment.seams)]
    sewn = np.concatenate([np.empty(0, np.int64), *keys])
    held = np.isin(panel.vertex_index, garment.anchors)
    begin, end = np.concatenate(loops), np.concatenate([np.roll(loop, -1) for loop in loops])
    kind = np.where(held[begin] & held[end], _WAIST, _HEM)
    kind[np.isin(_edge_keys(begin, end), sewn)] = _SEAM
    length = np.linalg.norm(panel.panel_xy[end] - panel.panel_xy[begin], axis=1)
    return _Border(points[begin], points[end], np.cumsum(length) - length, length, kind)


def _edge_keys(a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """One number for an edge, whichever way it runs."""
    return np.minimum(a, b).astype(np.int64) << 32 | np.maximum(a, b)


def _cloth(
    window: _Window, style: FabricStyle, inside: Bool[np.ndarray, "h w"], border: _Border
) -> UInt8[np.ndarray, "h w 3"]:
    """Colour of every pixel of the window: pattern, then wear and creases at the edges, then thread."""
    shade, second = (
        np.array(np.broadcast_to(v, inside.shape)) for v in weave(style, window.x, window.y, window.pixel)
    )
    near = _near(border, window.pixel, inside.shape)
    crease = np.where(near.kind == _SEAM, 0.28, 0.12) * _falloff(
        near.distance, max(_CREASE, 0.6 * window.pixel)
    )
    shade[near.pixels] *= 1 - crease
    if style.kind == "denim":
        second[near.pixels] += 0.16 * _falloff(near.distance, _WEAR)
    ink = _thread(near, window.pixel) * inside[near.pixels]
    tile = np.empty((*inside.shape, 3), np.uint8)
    for k, (first, other, thread) in enumerate(
        zip(style.color, style.second_color, style.thread_color, strict=True)
    ):
        channel = (np.float32(first) + second * np.float32(other - first)) * shade
        channel[near.pixels] += ink * (thread - channel[near.pixels])
        tile[..., k] = np.clip(255 * channel + np.float32(0.5), 0, 255)
    return tile


def _falloff(distance: Float[np.ndarray, " m"], width: float) -> Float[np.ndarray, " m"]:
    return np.exp(-((distance / width) ** 2))


def _near(border: _Border, pixel: float, shape: tuple[int, ...]) -> _Near:
    """Exact distances to the edges, within the reach of each edge's stitches."""
    distance = np.full(shape, np.inf, np.float32)
    along, kind = np.zeros(shape, np.float32), np.zeros(shape, np.int8)
    for start, end, before, length, what in zip(
        border.start, border.end, border.along, border.length, border.kind, strict=True
    ):
        reach = max(_STITCH_ROWS[int(what)]) / pixel + 4
        low = np.clip(np.floor(np.minimum(start, end) - reach).astype(int), 0, shape[::-1])
        high = np.clip(np.ceil(np.maximum(start, end) + reach).astype(int), 0, shape[::-1])
        box = slice(low[1], high[1]), slice(low[0], high[0])
        x = np.arange(low[0], high[0], dtype=np.float32) + np.float32(0.5 - start[0])
        y = (np.arange(low[1], high[1], dtype=np.float32) + np.float32(0.5 - start[1]))[:, None]
        dx, dy = (np.float32(v) for v in end - start)
        share = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, np.float32(1e-12)), 0, 1)
        squared = (x - share * dx) ** 2 + (y - share * dy) ** 2
        closer = squared < distance[box]
        distance[box][closer] = squared[closer]
        along[box][closer] = np.float32(before) + share[closer] * np.float32(length)
        kind[box][closer] = what
    rows, columns = np.nonzero(np.isfinite(distance))
    pixels = rows, columns
    return _Near(pixels, pixel * np.sqrt(distance[pixels]), along[pixels], kind[pixels])


def _thread(near: _Near, pixel: float) -> Float[np.ndarray, " m"]:
    """How much of a pixel the thread covers, 0..1. Coarse images get dashes that stay visible."""
    dash, gap, width = max(_DASH, 3 * pixel), max(_GAP, 1.5 * pixel), max(_THREAD, 0.9 * pixel)
    phase = np.mod(near.along, dash + gap)
    on = np.clip((np.minimum(phase, dash - phase) / pixel) + 0.5, 0, 1)
    ink = np.zeros_like(near.distance)
    for value, rows in _STITCH_ROWS.items():
        for row in rows:
            line = np.clip(0.5 + (width / 2 - np.abs(near.distance - max(row, 1.5 * pixel))) / pixel, 0, 1)
            ink = np.maximum(ink, np.where(near.kind == value, line * on, 0))
    return 0.85 * ink


def _mean(
    tile: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"], style: FabricStyle
) -> UInt8[np.ndarray, " 3"]:
    mean = tile[inside].mean(0) if inside.any() else 255 * np.array(style.color)
    return np.clip(mean + 0.5, 0, 255).astype(np.uint8)
