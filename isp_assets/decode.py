"""From a latent code to a garment: cut the panels, sew them, lift them onto the rest body.

The three steps are separate, so that a fit can cut and sew once, which fixes the
topology, and differentiate the lift alone (Eq. 5).

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 1, 3 and 5.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.conventions import PANELS
from isp_assets.errors import DecodeError, GarmentError, GeometryError
from isp_assets.garment import Garment, Panel, Seam
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.edge_runs import EdgeRun, split_edges
from isp_assets.geometry.lattice_interpolation import LatticeInterpolation
from isp_assets.geometry.outline import PlaneField, trace_outline
from isp_assets.geometry.seam_fairing import fair_seams
from isp_assets.geometry.sewing import FlatPanel, SewnPanels, sew_panels
from isp_assets.networks.panel_field import PanelField

RESOLUTIONS = (32, 512)
"""Coarsest and finest mesh: grid cells across a panel's square."""
_OUTLINE_CELLS = 256
"""Outlines are found on a grid at least this fine, so coarse and fine meshes have one shape."""
_LATTICE_STEP = 2.0 / 128
"""Step at which atlases are evaluated for finer meshes; costs .03 mm on average, .8 mm at worst."""
_FINE = 0.75 * _LATTICE_STEP
"""Triangle side below which interpolating saves time, and seams are smoothed."""
_FAIR_REACH = 0.03
"""Distance from a seam up to which smoothing reaches [network units]."""
SLIVER = 0.1
"""Longest edge that one panel may have and the other lack [network units]."""


@dataclass(frozen=True, eq=False)
class CutPanels:
    """Outlines of both panels as labelled edges [network units]."""

    outlines: Mapping[str, tuple[tuple[EdgeRun, ...], ...]]
    num_specks: int
    """Tiny pieces and holes that were dropped."""
    num_evaluations: int
    """Grid points at which a panel field was evaluated."""
    num_grid_points: int
    """Points of the full grids."""


@dataclass(frozen=True)
class DecodeReport:
    """What decoding cost, and what it had to mend."""

    seconds: Mapping[str, float]
    """Time of "cut", "sew" and "lift"."""
    num_specks: int
    evaluated_share: float
    """Share of the grid points at which the panel fields were evaluated."""
    seam_gap_mean: float
    """Mean distance between the two sides of the seams before welding [m]."""
    seam_gap_max: float


def decode_garment(
    model: GarmentModel, code: Float[np.ndarray, " Z"], *, resolution: int = 128, name: str = ""
) -> Garment:
    """Make the garment of a latent code.

    Args:
        model: Networks and pattern facts of the category.
        code: Latent code.
        resolution: Grid cells across a panel's square, 32 to 512; triangles have that side.
        name: Name of the garment, for messages and files.

    Raises:
        DecodeError: If the code gives no valid garment.
    """
    return decode_with_report(model, code, resolution=resolution, name=name)[0]


def decode_with_report(
    model: GarmentModel, code: Float[np.ndarray, " Z"], *, resolution: int = 128, name: str = ""
) -> tuple[Garment, DecodeReport]:
    """As `decode_garment`, with figures.

    Raises:
        DecodeError: If the code gives no valid garment.
    """
    code = _check(model, code, resolution)
    where = f"{model.category} {name!r}" if name else f"a {model.category}"
    try:
        times = [time.perf_counter()]
        cut = cut_panels(model, code, resolution=resolution)
        times.append(time.perf_counter())
        sewn = sew_panels(cut.outlines, model.seam_pairs, spacing=2.0 / resolution, sliver=SLIVER)
        times.append(time.perf_counter())
        with torch.no_grad():
            lifted = lift_points(model, sewn, torch.from_numpy(code))
            rest = weld_points(sewn, lifted).numpy()
        if sewn.spacing < _FINE:
            rest = fair_seams(rest, sewn.faces, sewn.seam_distance, reach=_FAIR_REACH)
        times.append(time.perf_counter())
        garment = _garment(model, sewn, code, rest, name)
    except (GeometryError, GarmentError) as error:
        raise DecodeError(
            f"{where} cannot be decoded at resolution {resolution}: {error}; its code has norm "
            f"{np.linalg.norm(code):.3g}. Use a code nearer to those of the garments in the bundle"
        ) from error
    gap = np.concatenate([
        np.linalg.norm(lifted["front"].numpy()[s.front] - lifted["back"].numpy()[s.back], axis=1)
        for s in sewn.seams
    ] or [np.zeros(1)])  # fmt: skip
    stages = dict(zip(("cut", "sew", "lift"), np.diff(times).tolist(), strict=True))
    share = cut.num_evaluations / cut.num_grid_points
    return garment, DecodeReport(stages, cut.num_specks, share, float(gap.mean()), float(gap.max()))


def cut_panels(model: GarmentModel, code: Float[np.ndarray, " Z"], *, resolution: int) -> CutPanels:
    """Find the labelled outlines of both panels: the topology of the garment.

    Raises:
        GeometryError: If a panel is missing, has a hole or leaves its square.
    """
    cells = max(_OUTLINE_CELLS, 1 << (resolution - 1).bit_length())
    outlines, specks, evaluations = {}, 0, 0
    for side in PANELS:
        try:
            outline = trace_outline(plane_field(model.panel_fields[side], code), cells=cells)
        except GeometryError as error:
            raise GeometryError(f"{side} panel: {error}") from error
        loops = zip(outline.loops, outline.logits, strict=True)
        outlines[side] = tuple(split_edges(points, logits) for points, logits in loops)
        specks += outline.num_specks
        evaluations += outline.num_evaluations
    return CutPanels(outlines, specks, evaluations, len(PANELS) * (cells + 1) ** 2)


def plane_field(network: PanelField, code: Float[np.ndarray, " Z"]) -> PlaneField:
    """The panel of one code as functions of NumPy arrays [network units]."""
    latent = torch.from_numpy(np.asarray(code, dtype=np.float32))

    def distance(xy):
        with torch.no_grad():
            return network.signed_distance(_tensor(xy), latent).numpy().astype(np.float64)

    def border(xy):
        points = _tensor(xy).requires_grad_()
        with torch.enable_grad():
            value, logits = network(points, latent)
            (gradient,) = torch.autograd.grad(value.sum(), points)
        return tuple(t.detach().numpy().astype(np.float64) for t in (value, gradient, logits))

    return PlaneField(distance, border)


@dataclass(frozen=True, eq=False)
class BorderSlope:
    """How the border points of a panel follow the zero level as the code leaves that of the cut (Eq. 5)."""

    points: Int[Tensor, " B"]
    """Panel points on the border."""
    distance: Float[Tensor, " B"]
    """Signed distance there at the code of the cut."""
    step: Float[Tensor, "B 2"]
    """Motion for each unit that the signed distance falls: ``grad s / |grad s|^2``."""


def border_slopes(model: GarmentModel, sewn: SewnPanels, code: Float[Tensor, " Z"]) -> dict[str, BorderSlope]:
    """Prepare the border of both panels to follow the code, by panel.

    Args:
        model: The category's networks, at the precision of ``code``.
        sewn: Flat panels [network units].
        code: The code that they were cut at.
    """
    slopes = {}
    for side, panel in sewn.panels.items():
        border = torch.from_numpy(np.flatnonzero(panel.border_label))
        xy = torch.from_numpy(panel.points).to(code)[border].requires_grad_()
        with torch.enable_grad():
            distance = model.panel_fields[side].signed_distance(xy, code.detach())
            (slope,) = torch.autograd.grad(distance.sum(), xy)
        step = slope / (slope**2).sum(dim=-1, keepdim=True).clamp_min(0.1)
        slopes[side] = BorderSlope(border, distance.detach(), step)
    return slopes


def lift_points(
    model: GarmentModel, sewn: SewnPanels, code: Float[Tensor, " Z"], *,
    border: Mapping[str, BorderSlope] | None = None,
) -> dict[str, Float[Tensor, "_ 3"]]:  # fmt: skip
    """Map every panel point to the rest body [m] (Eq. 3); differentiable in the code.

    On fine meshes the atlas is evaluated on a lattice and along the border, and interpolated.

    Args:
        model: The category's networks, at the precision of ``code``.
        sewn: Flat panels [network units].
        code: Latent code.
        border: What `border_slopes` gives for the code that the panels were cut at. With it,
            border points move with the zero level as the code leaves that one, and gradients
            are those of Eq. 5; without it the panels keep their outlines.
    """
    lifted = {}
    for side, panel in sewn.panels.items():
        atlas = model.atlases[side]
        if border is None and sewn.spacing < _FINE:
            on_border = np.flatnonzero(panel.border_label)
            lattice = LatticeInterpolation.build(panel.points, on_border, step=_LATTICE_STEP)
            lifted[side] = lattice(partial(atlas, code=code), code)
            continue
        xy = torch.from_numpy(panel.points).to(code)
        if border is not None:
            slope = border[side]
            risen = model.panel_fields[side].signed_distance(xy[slope.points], code) - slope.distance
            xy = xy.index_add(0, slope.points, -slope.step * risen[:, None])
        lifted[side] = atlas(xy, code)
    return lifted


def weld_points(sewn: SewnPanels, lifted: Mapping[str, Float[Tensor, "_ 3"]]) -> Float[Tensor, "V 3"]:
    """Vertex positions: seam vertices halfway between both panels, their surroundings following smoothly."""
    index = torch.from_numpy(np.concatenate([p.vertex_index for p in sewn.panels.values()]))
    points = torch.cat([lifted[side] for side in sewn.panels])
    total = points.new_zeros(sewn.num_vertices, 3).index_add(0, index, points)
    welded = total / torch.bincount(index, minlength=sewn.num_vertices)[:, None]
    for side, panel in sewn.panels.items():
        fade, vertex = sewn.fades[side], torch.from_numpy(panel.vertex_index)
        move = welded[vertex] - lifted[side]  # zero but on the seams
        weights = torch.from_numpy(fade.weights).to(move)
        follow = (weights[..., None] * move[torch.from_numpy(fade.sources)]).sum(dim=1)
        welded = welded.index_add(0, vertex[torch.from_numpy(fade.points)], follow)
    return welded


def _check(model: GarmentModel, code: Float[np.ndarray, " Z"], resolution: int) -> Float[np.ndarray, " Z"]:
    low, high = RESOLUTIONS
    if not low <= resolution <= high:
        raise DecodeError(f"resolution must lie in {low}..{high} cells, got {resolution}")
    code = np.asarray(code, dtype=np.float32)
    if code.shape != (model.code_size,):
        raise DecodeError(f"a {model.category} code has {model.code_size} numbers, got shape {code.shape}")
    if not np.isfinite(code).all():
        raise DecodeError(f"the {model.category} code holds NaN or infinity")
    return code


def _garment(
    model: GarmentModel, sewn: SewnPanels, code: Float[np.ndarray, " Z"], rest, name: str
) -> Garment:
    anchors = [
        panel.vertex_index[points]
        for panel in sewn.panels.values()
        for label, points in panel.runs
        if label in model.anchor_labels
    ]
    return Garment(
        name=name,
        category=model.category,
        code=code,
        rest_vertices=rest,
        rest_pose=model.rest_pose,
        panels={side: _panel(model, side, panel) for side, panel in sewn.panels.items()},
        seams=tuple(Seam(s.labels, s.front, s.back) for s in sewn.seams),
        anchors=np.unique(np.concatenate([*anchors, np.empty(0, dtype=np.int64)])),
    )


def _panel(model: GarmentModel, side: str, panel: FlatPanel) -> Panel:
    return Panel(
        panel_xy=model.to_panel(panel.points).astype(np.float32),
        faces=panel.faces,
        vertex_index=panel.vertex_index,
        st=texture_coordinates(side, panel.points).astype(np.float32),
        border_label=panel.border_label,
    )


def texture_coordinates(side: str, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Place of network coordinates in the texture: the front is its left half, the back its right.

    The texture is twice as wide as high. The back is mirrored: seen from behind,
    the body's left is on the left, and writing must still read from left to right.
    """
    s = 0.25 * (xy[:, 0] + 1) if side == "front" else 1 - 0.25 * (xy[:, 0] + 1)
    return np.stack([s, 0.5 * (xy[:, 1] + 1)], axis=1)


def _tensor(xy: Float[np.ndarray, "n 2"]) -> Float[Tensor, "n 2"]:
    return torch.from_numpy(np.asarray(xy, dtype=np.float32))
