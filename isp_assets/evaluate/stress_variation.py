"""Stress cases about bodies, time, meshes and numbers (T14 to T22), from harmless to hard."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.body import BETA_PRESETS
from isp_assets.drape import DrapeOptions
from isp_assets.evaluate import stress_motions as motions
from isp_assets.evaluate import stress_runs as runs
from isp_assets.evaluate.stress_case import StressCase
from isp_assets.evaluate.stress_setup import StressSetup, Sweep
from isp_assets.motion import Motion
from isp_assets.outfit import Outfit

_WALKING = ("tank_top", "trousers", "open_jacket")
_NOISE_SEED = 0


def shapes(setup: StressSetup) -> Iterator[StressCase]:
    """T14: unusual bodies."""
    motion, outfit = setup.walk(2), ["tank_top", "trousers"]
    for beta in range(2 if setup.quick else 6):
        for way in (1, -1):
            for size in setup.few((2.0, 3.0, 5.0)):
                betas = np.zeros(10, np.float32)
                betas[beta] = way * size
                label = f"beta {beta} {'up' if way > 0 else 'down'}"
                case = setup.case("T14", label, outfit, motion, Sweep("beta", (way * size,)))
                yield _on_body(case, betas)
    for preset in ("man", "woman"):
        case = setup.case("T14", f"preset {preset}", outfit, motion, Sweep("preset", (1.0,)))
        yield _on_body(case, np.asarray(BETA_PRESETS[preset], np.float32))


def rates(setup: StressSetup) -> Iterator[StressCase]:
    """T15: frame rates, and noise in the pose."""
    for clip in (setup.walk_tail, *setup.clips):
        base = clip.resample(30.0)
        base = replace(base, poses=base.poses[:40], translation=base.translation[:40], frame_step=1)
        for fps in (30, 60) if setup.quick else (30, 60, 120):
            motion = base.resample(float(fps))
            measures = ("jerk_ratio", "jumps")
            sweep = Sweep("frames a second", (float(fps),), measures)
            case = setup.case("T15", f"walking, {clip.name}", _WALKING, motion, sweep)
            run = None if fps == 30 else runs.compared_with(motion=base, every=fps // 30)
            yield replace(case, run=run, measure_every=max(4, fps // 6))
    sizes = np.repeat(setup.few((0.05, 0.1, 0.2, 0.4, 0.8)), 8)
    motion = motions.noisy(setup.walk_tail, frame=0, amplitudes=tuple(sizes), seed=_NOISE_SEED)
    for names in (_WALKING, ["tee", "a_line_skirt"]):
        sweep = Sweep("noise up to [deg]", tuple(float(s) for s in sizes), ("noise_gain",))
        yield replace(setup.case("T15", f"noise, {names[-1]}", names, motion, sweep), measure_every=4)


def far_skirts(setup: StressSetup) -> Iterator[StressCase]:
    """T16: cloth far from any skin."""
    for rule, what in ((motions.stride, "stride"), (motions.split, "split")):
        angles = setup.sweep(20, 110, 10)
        sweep = Sweep("between the legs [deg]", angles, ("far",))
        yield setup.case(
            "T16", f"{what}, long_flared_skirt", ["long_flared_skirt"], rule(setup.figure, angles), sweep
        )


def sleeves(setup: StressSetup) -> Iterator[StressCase]:
    """T17: an outer sleeve that lies nearer to the inner torso than to the inner sleeve."""
    angles = setup.sweep(40, -30, -5)
    sweep = Sweep("arm angle [deg]", angles, ("corrections",))
    motion = motions.arms_swept(setup.figure, angles)
    yield setup.case("T17", "jacket over shirt", ["long_sleeved_shirt", "open_jacket"], motion, sweep)


def grids(setup: StressSetup) -> Iterator[StressCase]:
    """T18: edges that cross between vertices, from coarse to fine meshes."""
    motion = setup.walk(2)
    for cells in (64, 128) if setup.quick else (64, 128, 256, 512):
        case = setup.case(
            "T18",
            "shirt and jacket",
            ["long_sleeved_shirt", "open_jacket"],
            motion,
            Sweep("cells", (float(cells),)),
        )
        yield replace(case, options=DrapeOptions(resolution=cells, chunk=2))


def smoothings(setup: StressSetup) -> Iterator[StressCase]:
    """T19: contact after smoothing over time (before) and after projecting again (final)."""
    tail = setup.walk_tail
    motion = replace(tail, poses=tail.poses[:13], translation=tail.translation[:13])
    for width in setup.few((3.0, 5.0, 9.0)):
        sweep = Sweep("frames averaged", (width,), ("corrections",))
        yield replace(
            setup.case("T19", "smoothed walk", _WALKING, motion, sweep), run=runs.smoothed(int(width))
        )


def numbers(setup: StressSetup) -> Iterator[StressCase]:
    """T20: other chunks, other precision, another device."""
    tail, names = setup.walk_tail, ["tee", "open_jacket"]
    for chunk in (1, 64):
        sweep = Sweep("frames a chunk, against 16", (float(chunk),))
        case = setup.case("T20", "chunk", names, tail, sweep)
        run = runs.compared_with(change=_with_chunk_of_16)
        yield replace(case, run=run, options=replace(case.options, chunk=chunk), measure_every=20)
    motion = setup.walk(3)
    for dtype, name in ((torch.float16, "float16"), (torch.bfloat16, "bfloat16")):
        outfit = setup.collection.outfit(names)
        case = setup.case(
            "T20", f"networks at {name}", runs.lower_precision(outfit, dtype), motion, Sweep("bits", (16.0,))
        )
        yield replace(case, run=runs.compared_with(change=_Wearing(outfit)))
    if torch.cuda.is_available():
        case = setup.case("T20", "cuda against cpu", names, motion, Sweep("device", (1.0,)))
        options = replace(case.options, device="cuda")
        yield replace(case, options=options, run=runs.compared_with(change=_on_cpu))


def waistbands(setup: StressSetup) -> Iterator[StressCase]:
    """T22: cloth beside a waistband, from frame to frame, at growing speed."""
    clip = Motion.load("squat")
    for name in ("trousers", "a_line_skirt"):
        for speed in setup.few((1.0, 2.0, 4.0)):
            frames = slice(0, 46, int(speed))
            motion = replace(clip, poses=clip.poses[frames], translation=clip.translation[frames])
            sweep = Sweep("times the speed", (speed,), ("anchor_jumps", "jumps"))
            yield replace(setup.case("T22", f"squat, {name}", [name], motion, sweep), measure_every=5)


def _on_body(case: StressCase, betas: Float[np.ndarray, " B"]) -> StressCase:
    return replace(case, shot=replace(case.shot, betas=betas))


def _with_chunk_of_16(case: StressCase) -> StressCase:
    return replace(case, options=replace(case.options, chunk=16))


def _on_cpu(case: StressCase) -> StressCase:
    return replace(case, options=replace(case.options, device="cpu"))


@dataclass(frozen=True, eq=False)
class _Wearing:
    """The case in another outfit."""

    outfit: Outfit

    def __call__(self, case: StressCase) -> StressCase:
        return replace(case, outfit=self.outfit)
