"""Patterns of shirts and jackets: sleeves in one piece with the torso, front open or closed."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from isp_assets.errors import GarmentError
from isp_assets.train.landmarks import Landmarks, RestBody
from isp_assets.train.pattern import (
    Curve,
    Loop,
    Pattern,
    PatternCategory,
    PatternEdge,
    bezier,
    mirrored,
    smooth_curve,
)

EDGE_NAMES = {
    1: "side_right", 2: "under_sleeve_right", 3: "cuff_right", 4: "over_sleeve_right", 5: "neckline",
    6: "over_sleeve_left", 7: "cuff_left", 8: "under_sleeve_left", 9: "side_left", 10: "hem",
    11: "opening_right", 12: "opening_left",
}  # fmt: skip
"""The armhole of a sleeveless top is its cuff."""
_SIDE, _UNDER, _CUFF, _OVER, _NECK, _HEM, _OPENING = 9, 8, 7, 6, 5, 10, 12
_MIRROR = {9: 1, 8: 2, 7: 3, 6: 4, 5: 5, 10: 10, 12: 11}
_SEAMS = ((1, 1), (2, 2), (4, 4), (6, 6), (8, 8), (9, 9))


@dataclass(frozen=True)
class TopParameters:
    """Shape of a top. Eases are relative to the body's girth, lengths in metres."""

    ease: float = 0.16
    hem: float = 1.02
    """Width at the hem relative to that under the arms."""
    length: float = 0.62
    """Hem height: 0 just above the waist, 1 below the hips."""
    shaping: float = 0.0
    """Narrowing of each side seam at the waist [m]."""
    sleeve: float = 0.22
    """0 sleeveless, 1 to the wrist."""
    sleeve_ease: float = 0.35
    cuff: float = 1.1
    strap: float = 0.62
    """Shoulder point of a sleeveless top, relative to the upper arm."""
    neck_width: float = 1.45
    neck_front: float = 0.08
    """Depth of the neckline in front [m]."""
    neck_back: float = 0.015
    vee: float = 0.0
    """0 round, 1 pointed."""
    shoulder_ease: float = 0.012
    """Height of the shoulder seam above the body [m]."""
    armhole: float = 0.02
    """Depth of the underarm below the armpit [m]."""
    open: bool = False
    gap: float = 0.03
    """Half the distance between the fronts at the hem [m]."""
    collar: float = 0.0
    """Height of a stand collar about the neck [m]; 0 for none. With one, ``neck_width`` plays no part."""


PRESETS = {
    "tank_top": TopParameters(
        sleeve=0.0, ease=0.07, hem=1.0, length=0.56, shaping=0.02, strap=0.55, neck_width=1.75,
        neck_front=0.13, neck_back=0.05, shoulder_ease=0.008, armhole=0.02,
    ),
    "tee": TopParameters(),
    "long_sleeved_shirt": TopParameters(
        sleeve=0.97, ease=0.15, length=0.68, sleeve_ease=0.32, cuff=1.1, neck_width=1.35, neck_front=0.07,
    ),
    "crop_top": TopParameters(
        sleeve=0.15, ease=0.08, hem=0.97, length=0.06, sleeve_ease=0.3, neck_width=1.8, neck_front=0.10,
        neck_back=0.03,
    ),
    "oversized_tee": TopParameters(
        ease=0.42, hem=1.0, length=0.88, sleeve=0.42, sleeve_ease=0.75, cuff=1.2, armhole=0.05,
        shoulder_ease=0.02,
    ),
    "v_neck_shirt": TopParameters(
        sleeve=0.45, ease=0.13, length=0.62, shaping=0.01, neck_width=1.5, neck_front=0.17, vee=1.0,
    ),
    "open_jacket": TopParameters(
        sleeve=1.0, ease=0.32, hem=1.03, length=0.70, sleeve_ease=0.62, cuff=1.2, neck_width=1.6,
        neck_front=0.11, shoulder_ease=0.024, armhole=0.045, open=True, gap=0.02,
    ),
    "open_vest": TopParameters(
        sleeve=0.0, ease=0.26, length=0.58, strap=0.66, neck_width=1.6, neck_front=0.16, vee=0.8,
        shoulder_ease=0.02, armhole=0.055, open=True, gap=0.03,
    ),
    "long_cardigan": TopParameters(
        sleeve=0.95, ease=0.28, hem=1.12, length=1.45, sleeve_ease=0.5, cuff=1.15, neck_width=1.6,
        neck_front=0.16, vee=0.7, shoulder_ease=0.02, armhole=0.035, open=True, gap=0.04,
    ),
    "turtleneck": TopParameters(
        sleeve=0.98, ease=0.12, length=0.66, sleeve_ease=0.3, neck_front=0.008, neck_back=0.004, collar=0.04,
    ),
}  # fmt: skip


def sample_top(rng: np.random.Generator) -> TopParameters:
    """Draw random parameters."""
    u = rng.uniform
    drawn = TopParameters(
        ease=u(0.06, 0.42), hem=u(0.95, 1.20), length=u(0.0, 1.15), shaping=u(0.0, 0.02),
        sleeve=0.0 if u() < 0.18 else u(0.12, 1.0), sleeve_ease=u(0.2, 0.75), cuff=u(0.95, 1.35),
        strap=u(0.52, 0.68),
        neck_width=u(1.25, 2.0), neck_front=u(0.05, 0.20), neck_back=u(0.005, 0.05), vee=u(0.0, 1.0),
        shoulder_ease=u(0.008, 0.03), armhole=u(0.01, 0.05), open=bool(u() < 0.28), gap=u(0.0, 0.05),
    )  # fmt: skip
    if u() < 0.8:
        return drawn
    return replace(drawn, collar=u(0.02, 0.045), neck_front=u(0.004, 0.02), neck_back=u(0.002, 0.01))


def draw_top(body: RestBody, standing: Landmarks, p: TopParameters) -> Pattern:
    """Lay out a top on a body in T-pose."""
    del standing  # the rest pose is the T-pose
    half = _half_outline(body, p)
    back = (_closed(half, _half_neckline(half[-1].points[-1], p.neck_back, p.vee)),)
    front_neck = _half_neckline(half[-1].points[-1], p.neck_front, p.vee)
    front = _open(half, front_neck, p.gap) if p.open else (_closed(half, front_neck),)
    return Pattern(panels={"front": front, "back": back}, seam_pairs=_SEAMS)


def _half_outline(body: RestBody, p: TopParameters) -> Loop:
    """Edges of the left half from the hem up to the neck."""
    lm = body.landmarks
    hem_y = lm.waist_y + 0.06 + p.length * ((lm.crotch_y - 0.10) - (lm.waist_y + 0.06))
    base = max(lm.chest_girth, lm.hip_girth if hem_y < lm.hip_y + 0.05 else 0.0)
    under_arm = 0.25 * base * (1 + p.ease)
    hem = under_arm * p.hem
    if hem_y < lm.hip_y + 0.08:
        hem = max(hem, 0.25 * lm.hip_girth * 1.06)
    if p.sleeve <= 0:
        return _sleeveless(body, p, np.array([hem, hem_y]), under_arm)
    return _sleeved(body, p, np.array([hem, hem_y]), under_arm)


def _side(lm: Landmarks, p: TopParameters, hem: np.ndarray, top: np.ndarray) -> PatternEdge:
    waist_y = np.clip(lm.waist_y, hem[1] + 0.4 * (top[1] - hem[1]), top[1] - 0.3 * (top[1] - hem[1]))
    share = (waist_y - hem[1]) / (top[1] - hem[1])
    waist = np.array([hem[0] + share * (top[0] - hem[0]) - p.shaping, waist_y])
    return PatternEdge(_SIDE, smooth_curve([hem, waist, top]))


def _sleeveless(body: RestBody, p: TopParameters, hem: np.ndarray, under_arm: float) -> Loop:
    lm = body.landmarks
    under = np.array([under_arm, lm.armpit_y - p.armhole])
    shoulder_x = p.strap * lm.arm_x[0]
    x = np.linspace(shoulder_x, _neck_x(body, p), 8)
    over = np.stack([x, body.shoulder_line(x) + p.shoulder_ease], axis=1)
    armhole = bezier(under, (shoulder_x - 0.012, under[1] + 0.02), over[0])
    return _side(lm, p, hem, under), PatternEdge(_CUFF, armhole), PatternEdge(_OVER, _with_collar(over, p))


def _sleeved(body: RestBody, p: TopParameters, hem: np.ndarray, under_arm: float) -> Loop:
    lm = body.landmarks
    arm_x, _, wrist_x = lm.arm_x
    girths = np.array(lm.arm_girth)[[0, 2]]
    cuff_x = max(under_arm, lm.armpit_x) + 0.05
    cuff_x += p.sleeve * (wrist_x - cuff_x)
    t = np.clip((cuff_x - arm_x) / (wrist_x - arm_x), 0, 1)
    girth = (1 - t) * girths[0] + t * girths[1]
    half_cuff = max(0.25 * girth * (1 + p.sleeve_ease * (1 - 0.3 * t)) * p.cuff, 0.25 * girth * 1.10)

    def sleeve_top(x):
        """Just above the arm: all extra width hangs below, or the sleeve would drop and bunch at the neck."""
        return lm.arm_y - 0.004 + 0.25 * np.interp(x, [arm_x, wrist_x], girths) * 1.10

    cuff = np.array([[cuff_x, sleeve_top(cuff_x) - 2 * half_cuff], [cuff_x, sleeve_top(cuff_x)]])
    under_y = min(lm.armpit_y - p.armhole, sleeve_top(arm_x) - 0.5 * girths[0] * (1 + p.sleeve_ease))
    fillet = min(0.05, 0.45 * (cuff_x - under_arm))
    under = np.array([under_arm, under_y - fillet])
    bend = bezier(under, (under_arm, under_y), (under_arm + fillet, under_y), 10)
    return (
        _side(lm, p, hem, under),
        PatternEdge(_UNDER, np.concatenate([bend, cuff[:1]])),
        PatternEdge(_CUFF, cuff),
        PatternEdge(_OVER, _with_collar(_over_sleeve(body, p, cuff[1], sleeve_top), p)),
    )


def _over_sleeve(body: RestBody, p: TopParameters, cuff: np.ndarray, sleeve_top) -> Curve:
    """Along the shoulder's silhouette, and straight from the shoulder to the cuff."""
    lm = body.landmarks
    x = np.linspace(cuff[0], _neck_x(body, p), 40)
    line = np.maximum(body.shoulder_line(x) + p.shoulder_ease, 0)
    shoulder = 0.9 * lm.arm_x[0]
    straight = np.interp(x, [shoulder, max(cuff[0], shoulder + 1e-3)], [sleeve_top(shoulder), cuff[1]])
    line = np.maximum(line, np.where(x > shoulder, straight, -np.inf))
    smooth = np.maximum(gaussian_filter1d(line, 3, mode="nearest"), line - 0.004)
    smooth[0] = cuff[1]
    return np.stack([x, smooth], axis=1)


def _neck_x(body: RestBody, p: TopParameters) -> float:
    """Half width at the inner end of the shoulder: a collar leaves the neck a little room all round."""
    lm = body.landmarks
    if p.collar > 0:
        return 0.25 * body.level_girth(lm.neck_y) * 1.12
    return lm.neck_x * p.neck_width + 0.01


def _with_collar(over: Curve, p: TopParameters) -> Curve:
    """The shoulder's edge, led on up the neck in a small bend."""
    if p.collar <= 0:
        return over
    corner = over[-1]
    bend = min(0.015, 0.5 * p.collar)
    kept = over[over[:, 0] > corner[0] + bend]
    if len(kept) == 0:
        raise GarmentError("the collar leaves no shoulder between itself and the armhole")
    rounded = bezier(kept[-1], corner, (corner[0], corner[1] + bend), 6)
    return np.concatenate([kept[:-1], rounded, [(corner[0], corner[1] + p.collar)]])


def _half_neckline(shoulder: np.ndarray, depth: float, vee: float) -> Curve:
    lowest = np.array([0.0, shoulder[1] - depth])
    control = np.array([shoulder[0] * (1 - 0.55 * vee), shoulder[1] - depth * (1 - 0.5 * vee)])
    return bezier(shoulder, control if vee < 1 else 0.5 * (shoulder + lowest), lowest, 20)


def _mirrored_loop(edges: Loop) -> Loop:
    return tuple(PatternEdge(_MIRROR[e.label], mirrored(e.points)) for e in edges[::-1])


def _closed(half: Loop, neck: Curve) -> Loop:
    left = (*half, PatternEdge(_NECK, neck))
    hem = half[0].points[0]
    return (*left, *_mirrored_loop(left), PatternEdge(_HEM, np.array([hem * (-1, 1), hem])))


def _open(half: Loop, neck: Curve, gap: float) -> tuple[Loop, Loop]:
    """Two fronts that part from the neckline down."""
    upper, lower = 0.004 + 0.3 * gap, 0.004 + gap
    kept = neck[neck[:, 0] > upper]
    if kept[-1, 0] > upper + 0.006:
        kept = np.concatenate([kept, [(upper, neck[-1, 1])]])
    hem = half[0].points[0]
    corner = np.array([lower, hem[1]])
    left = (
        *half,
        PatternEdge(_NECK, kept),
        PatternEdge(_OPENING, np.array([kept[-1], corner])),
        PatternEdge(_HEM, np.array([corner, hem])),
    )
    return left, _mirrored_loop(left)


TOP = PatternCategory(
    name="top", edge_names=EDGE_NAMES, seam_pairs=_SEAMS, anchor_labels=(), presets=PRESETS,
    sample=sample_top, draw=draw_top, panel_center=lambda lm: (0.0, lm.arm_y - 0.32), panel_scale=0.80,
)  # fmt: skip
