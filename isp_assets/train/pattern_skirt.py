"""Patterns of skirts: two equal panels held at the waist."""

from dataclasses import dataclass

import numpy as np

from isp_assets.train.landmarks import Landmarks, RestBody
from isp_assets.train.pattern import Pattern, PatternCategory, PatternEdge, bezier, mirrored

EDGE_NAMES = {1: "side_right", 2: "waist", 3: "side_left", 4: "hem"}
_SEAMS = ((1, 1), (3, 3))
_ANCHORS = (2,)


@dataclass(frozen=True)
class SkirtParameters:
    """Shape of a skirt. Eases are relative to the body's girth, lengths in metres."""

    length: float = 0.4
    """Hem height: 0 at mid thigh, 1 above the ankle."""
    flare: float = 0.3
    """Widening below the hip; 0 straight, 1 a slope of .42, below 0 narrowing."""
    waist: float = 1.02
    """Waist relative to the body's."""
    rise: float = 0.02
    """Height of the waist [m]."""
    hip_ease: float = 0.08
    hem_curve: float = 0.8
    """0 straight, 1 meets the side seams at right angles."""


PRESETS = {
    "mini_skirt": SkirtParameters(length=0.04, flare=0.25, hip_ease=0.07, rise=0.0, hem_curve=0.8),
    "pencil_skirt": SkirtParameters(length=0.42, flare=-0.04, hip_ease=0.06, rise=0.03, hem_curve=0.0),
    "a_line_skirt": SkirtParameters(length=0.34, flare=0.6, hip_ease=0.09, rise=0.02, hem_curve=0.9),
    "long_flared_skirt": SkirtParameters(length=0.97, flare=0.85, hip_ease=0.10, rise=0.03, hem_curve=0.95),
    "midi_skirt": SkirtParameters(length=0.65, flare=0.35, hip_ease=0.09, rise=0.02, hem_curve=0.9),
}


def sample_skirt(rng: np.random.Generator) -> SkirtParameters:
    """Draw random parameters."""
    u = rng.uniform
    return SkirtParameters(
        length=u(0.02, 1.0), flare=u(-0.03, 1.0), waist=u(0.99, 1.06), rise=u(-0.02, 0.05), hip_ease=u(0.05,
        0.16), hem_curve=u(0.2, 1.0),
    )  # fmt: skip


def draw_skirt(body: RestBody, standing: Landmarks, p: SkirtParameters) -> Pattern:
    """Lay out a skirt on a body in T-pose."""
    del standing  # the rest pose is the T-pose
    lm = body.landmarks
    waist = np.array([0.0, lm.waist_y - 0.02 + p.rise])
    waist[0] = 0.25 * body.level_girth(waist[1]) * p.waist + 0.004
    hip = np.array([0.25 * lm.hip_girth * (1 + p.hip_ease), lm.hip_y])
    mid_thigh, ankle = lm.crotch_y - 0.08, lm.leg_xy[2][1] + 0.03
    hem_y = mid_thigh + p.length * (ankle - mid_thigh)
    slope = p.flare * 0.42
    # The hem is lowest in the middle; its ends lie higher, where the side seam is narrower.
    bow = 0.5 * p.hem_curve * max(slope, 0.0)
    hem_x = (hip[0] + slope * (hip[1] - hem_y)) / (1 + slope * bow)
    hem = np.array([hem_x, hem_y + bow * hem_x])
    # Above the hip the curve leaves along the line of the skirt, so that the hip makes no corner.
    reach = 0.45 * (waist[1] - hip[1])
    above = bezier(hip, (hip[0] - slope * reach, hip[1] + reach), waist, 24)
    side = np.concatenate([hem[None], above])
    panel = (
        (
            PatternEdge(3, side),
            PatternEdge(2, np.array([waist, waist * (-1, 1)])),
            PatternEdge(1, mirrored(side)),
            PatternEdge(4, bezier(hem * (-1, 1), (0.0, 2 * hem_y - hem[1]), hem, 30)),
        ),
    )
    return Pattern(panels={"front": panel, "back": panel}, seam_pairs=_SEAMS, anchor_labels=_ANCHORS)


SKIRT = PatternCategory(
    name="skirt", edge_names=EDGE_NAMES, seam_pairs=_SEAMS, anchor_labels=_ANCHORS, presets=PRESETS,
    sample=sample_skirt, draw=draw_skirt, panel_center=lambda lm: (0.0, lm.waist_y - 0.50), panel_scale=0.65,
)  # fmt: skip
