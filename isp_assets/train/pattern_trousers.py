"""Patterns of trousers: two equal panels held at the waist, on a body with its legs apart."""

from dataclasses import dataclass

import numpy as np

from isp_assets.train.landmarks import Landmarks, RestBody
from isp_assets.train.pattern import Curve, Pattern, PatternCategory, PatternEdge, mirrored, smooth_curve

EDGE_NAMES = {
    1: "outseam_right", 2: "waist", 3: "outseam_left", 4: "hem_left", 5: "inseam_left", 6: "inseam_right",
    7: "hem_right",
}  # fmt: skip
_SEAMS = ((1, 1), (3, 3), (5, 5), (6, 6))
_ANCHORS = (2,)
_CROTCH_HALF_WIDTH = 0.012
"""Flat stretch between the legs [m]; without it the inseams would meet in a cusp."""


@dataclass(frozen=True)
class TrouserParameters:
    """Shape of trousers. Eases are relative to the body's girth, lengths in metres."""

    length: float = 0.97
    """0 hot pants, 1 to the ankle."""
    waist: float = 1.02
    rise: float = -0.01
    """Height of the waist [m]."""
    hip_ease: float = 0.09
    thigh_ease: float = 0.14
    hem_ease: float = 0.45
    drop: float = 0.05
    """Depth of the crotch relative to the body's."""


PRESETS = {
    "trousers": TrouserParameters(),
    "slim_trousers": TrouserParameters(
        length=0.98, hip_ease=0.065, thigh_ease=0.08, hem_ease=0.16, drop=0.035
    ),
    "wide_trousers": TrouserParameters(
        length=0.96, hip_ease=0.14, thigh_ease=0.28, hem_ease=1.05, drop=0.08, rise=0.02
    ),
    "shorts": TrouserParameters(length=0.16, hip_ease=0.11, thigh_ease=0.20, hem_ease=0.5, drop=0.06),
    "bermuda_shorts": TrouserParameters(
        length=0.42, hip_ease=0.10, thigh_ease=0.17, hem_ease=0.55, drop=0.05
    ),
}


def sample_trousers(rng: np.random.Generator) -> TrouserParameters:
    """Draw random parameters."""
    u = rng.uniform
    return TrouserParameters(
        length=u(0.10, 1.0), waist=u(0.99, 1.06), rise=u(-0.04, 0.03), hip_ease=u(0.06, 0.20),
        thigh_ease=u(0.07, 0.32), hem_ease=u(0.12, 0.9), drop=u(0.03, 0.12),
    )  # fmt: skip


def draw_trousers(body: RestBody, standing: Landmarks, p: TrouserParameters) -> Pattern:
    """Lay out trousers on a body with its legs apart; the hip is measured standing."""
    lm = body.landmarks
    waist = np.array([0.0, lm.waist_y - 0.03 + p.rise])
    waist[0] = 0.25 * body.level_girth(waist[1]) * p.waist + 0.004
    depth = 0.5 * lm.crotch_arc - (lm.waist_y - waist[1])
    crotch_y = min(waist[1] - depth * (1 + p.drop), lm.crotch_y - 0.012)
    hip_x = max(0.25 * standing.hip_girth * (1 + p.hip_ease), lm.hip_x + 0.006)
    hip = np.array([hip_x, lm.hip_y + 0.02])
    outer, inner = _leg_sides(lm, p)
    above = np.array([0.5 * (waist[0] + hip[0]), 0.55 * waist[1] + 0.45 * hip[1]])
    outseam = smooth_curve([*outer, hip, above, waist], 50)
    inseam = _inseam(inner, crotch_y)
    hem = np.array([inseam[-1], outseam[0]])
    loop = (
        PatternEdge(3, outseam),
        PatternEdge(2, np.array([waist, waist * (-1, 1)])),
        PatternEdge(1, mirrored(outseam)),
        PatternEdge(7, mirrored(hem)),
        PatternEdge(6, mirrored(inseam)),
        PatternEdge(5, inseam),
        PatternEdge(4, hem),
    )
    panel = (loop,)
    return Pattern(panels={"front": panel, "back": panel}, seam_pairs=_SEAMS, anchor_labels=_ANCHORS)


def _leg_sides(lm: Landmarks, p: TrouserParameters) -> tuple[Curve, Curve]:
    """Outer and inner side of the left leg, from the hem up."""
    thigh, axis = np.array(lm.leg_xy[0]), np.array(lm.leg_axis)
    outward = np.array([-axis[1], axis[0]])
    knee, ankle = ((xy[1] - thigh[1]) / axis[1] for xy in lm.leg_xy[1:])
    end = 0.10 + p.length * (ankle - 0.10)
    along = np.linspace(end, 0.12 if end > 0.16 else end - 0.03, 12)
    girth = np.interp(along, [0, knee, ankle], lm.leg_girth)
    ease = np.interp(along, [0, ankle], [p.thigh_ease, p.hem_ease])
    half = (0.25 * girth * (1 + ease) + 0.004)[:, None]
    middle = thigh + axis * along[:, None]
    return middle + outward * half, middle - outward * half


def _inseam(inner: Curve, crotch_y: float) -> Curve:
    """From the middle of the crotch down to the hem."""
    low = inner[(inner[:, 1] < crotch_y - 0.03) & (inner[:, 0] > _CROTCH_HALF_WIDTH + 0.008)]
    if len(low) == 0:
        low = np.array([[max(inner[0, 0], _CROTCH_HALF_WIDTH + 0.02), min(inner[0, 1], crotch_y - 0.035)]])
    start = [(0.0, crotch_y), (_CROTCH_HALF_WIDTH, crotch_y - 0.012)]
    return smooth_curve([*start, *low[::-1]], 40)


TROUSERS = PatternCategory(
    name="trousers", edge_names=EDGE_NAMES, seam_pairs=_SEAMS, anchor_labels=_ANCHORS, presets=PRESETS,
    sample=sample_trousers, draw=draw_trousers, panel_center=lambda lm: (0.0, lm.waist_y - 0.53),
    panel_scale=0.65, leg_angle=float(np.deg2rad(18)),
)  # fmt: skip
