"""The stress cases: what each test drapes, and what it sweeps. Every sweep goes from harmless to hard."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from isp_assets.errors import InputError
from isp_assets.evaluate import stress_motions as motions
from isp_assets.evaluate import stress_runs as runs
from isp_assets.evaluate import stress_variation as variation
from isp_assets.evaluate.stress_case import StressCase
from isp_assets.evaluate.stress_setup import StressSetup, Sweep

_STACK = (
    "tank_top", "slim_trousers", "long_sleeved_shirt", "a_line_skirt", "v_neck_shirt", "open_vest",
    "open_jacket", "long_cardigan",
)  # fmt: skip


def arms(setup: StressSetup) -> Iterator[StressCase]:
    """T1: arms lowered until they press into the torso."""
    angles = setup.sweep(40, -30, -5)
    motion = motions.arms_swept(setup.figure, angles)
    for name in ("tee", "long_sleeved_shirt"):
        yield setup.case("T1", f"arms lowered, {name}", [name], motion, Sweep("arm angle [deg]", angles))


def wrists(setup: StressSetup) -> Iterator[StressCase]:
    """T2: turned wrists, and hands on the hips."""
    outfit = ["long_sleeved_shirt"]
    for axis, what in (("x", "twisted"), ("y", "bent forward"), ("z", "bent down")):
        for way in (1, -1):
            angles = tuple(way * a for a in setup.sweep(0, 80, 10))
            motion = motions.wrists_turned(setup.figure, angles, axis)
            label = f"wrists {what}, {'+' if way > 0 else '-'}"
            yield setup.case("T2", label, outfit, motion, Sweep("wrist angle [deg]", angles))
    distances = setup.sweep(34, 10, -2)
    motion = motions.hands_on_hips(setup.figure, distances)
    yield setup.case("T2", "hands on hips", outfit, motion, Sweep("wrist from the middle [cm]", distances))


def folded_bodies(setup: StressSetup) -> Iterator[StressCase]:
    """T3: bodies that cut themselves."""
    shares = setup.sweep(0, 1.2, 0.1)
    motion = motions.arms_crossed(shares)
    for name in ("tee", "long_sleeved_shirt"):
        yield setup.case(
            "T3", f"arms crossed, {name}", [name], motion, Sweep("share of the crossing", shares)
        )
    depths = setup.sweep(10, 65, 5)
    motion = motions.deep_squat(setup.figure, depths)
    for outfit in (["long_sleeved_shirt", "trousers"], ["trousers", "tee"], ["mini_skirt"]):
        yield setup.case("T3", f"squat, {outfit[-1]}", outfit, motion, Sweep("depth [cm]", depths))


def strides(setup: StressSetup) -> Iterator[StressCase]:
    """T4: legs apart under skirts."""
    for rule, what, start in ((motions.stride, "stride", 0), (motions.split, "split", 20)):
        angles = setup.sweep(start, 90, 10)
        motion = rule(setup.figure, angles)
        for name in ("mini_skirt", "midi_skirt", "long_flared_skirt"):
            yield setup.case("T4", f"{what}, {name}", [name], motion, Sweep("between the legs [deg]", angles))


def rolls(setup: StressSetup) -> Iterator[StressCase]:
    """T5: the whole body turned over, half a degree a frame, and on the spot."""
    outfit = ["tee", "a_line_skirt"]
    for way, what in ((1, "face down"), (-1, "on the back")):
        pitches = np.arange(0, 90.25, 0.5)
        pitches = pitches[-31:] if setup.quick else pitches
        shown = tuple(float(way * np.ceil(p / 15) * 15) for p in pitches)
        motion = motions.rolled(setup.figure, tuple(way * pitches))
        case = setup.case(
            "T5", f"rolled, {what}", outfit, motion, Sweep("pitch up to [deg]", shown, ("jumps",))
        )
        yield replace(case, measure_every=10)
    headings = np.arange(0, 361, 4.0)[: 20 if setup.quick else None]
    shown = tuple(float(np.ceil(h / 90) * 90) for h in headings)
    motion = motions.turned_on_the_spot(setup.figure, tuple(headings))
    case = setup.case(
        "T5", "turned on the spot", outfit, motion, Sweep("heading up to [deg]", shown, ("jumps",))
    )
    yield replace(case, measure_every=10)


def stacks(setup: StressSetup) -> Iterator[StressCase]:
    """T6: many layers, copies, and orders nobody would wear."""
    motion = setup.walk(3)
    for count in setup.few((1.0, 2.0, 3.0, 4.0, 6.0, 8.0)):
        yield setup.case("T6", "mixed layers", _STACK[: int(count)], motion, Sweep("layers", (count,)))
    for count in setup.few((1.0, 2.0, 4.0, 8.0)):
        names = ["tee"] * int(count)
        yield setup.case("T6", "copies of one tee", names, motion, Sweep("layers", (count,)))
    rng = np.random.default_rng(0)
    for number in range(1, 3 if setup.quick else 6):
        names = [_STACK[k] for k in rng.permutation(6)[:4]]
        label = f"shuffled: {', '.join(names)}"
        yield setup.case("T6", label, names, motion, Sweep("order no.", (float(number),)))


def swaps(setup: StressSetup) -> Iterator[StressCase]:
    """T7: the outer layer starts where the inner one should be, and the other way round."""
    motion = setup.walk(3)
    for inner, outer in (("tee", "oversized_tee"), ("slim_trousers", "wide_trousers")):
        first, second = setup.collection.item(inner), setup.collection.item(outer)
        for share in setup.few((0.0, 0.25, 0.5, 0.75, 1.0)):
            items = (
                replace(first, code=_mixed(first.code, second.code, share)),
                replace(second, code=_mixed(second.code, first.code, share)),
            )
            whole = setup.collection.outfit([inner, outer])
            sweep = Sweep("share exchanged", (share,), ("corrections",))
            yield setup.case("T7", f"{inner} with {outer}", replace(whole, items=items), motion, sweep)


def backs(setup: StressSetup) -> Iterator[StressCase]:
    """T8: an inner layer that pushes through at the back alone."""
    yield from _placed(setup, "T8", "at the back", runs.at_the_back)


def sides(setup: StressSetup) -> Iterator[StressCase]:
    """T9: an inner layer that pushes through along the side seams alone."""
    yield from _placed(setup, "T9", "along the sides", runs.along_the_sides)


TESTS: dict[str, Callable[[StressSetup], Iterable[StressCase]]] = {
    "T1": arms, "T2": wrists, "T3": folded_bodies, "T4": strides, "T5": rolls, "T6": stacks, "T7": swaps,
    "T8": backs, "T9": sides, "T14": variation.shapes, "T15": variation.rates, "T16": variation.far_skirts,
    "T17": variation.sleeves, "T18": variation.grids, "T19": variation.smoothings, "T20": variation.numbers,
    "T22": variation.waistbands,
}  # fmt: skip
"""Every test of this table. T10-T13 decode codes (`robustness`), T21 compares files (the writers' tests)."""


def stress_cases(setup: StressSetup, tests: Sequence[str] | None = None) -> list[StressCase]:
    """The cases of some tests, or of all.

    Raises:
        InputError: If a test does not exist.
    """
    chosen = tuple(TESTS) if tests is None else tuple(tests)
    if unknown := [test for test in chosen if test not in TESTS]:
        raise InputError(f"no draping test {', '.join(unknown)}; there are {', '.join(TESTS)}")
    return [case for test in chosen for case in TESTS[test](setup)]


def _placed(setup: StressSetup, test: str, where: str, region: runs.Region) -> Iterator[StressCase]:
    depths = setup.few((2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0))
    motion = motions.arms_swept(setup.figure, [35.0] * len(depths))
    for name, other in (("tee", "v_neck_shirt"), ("a_line_skirt", "mini_skirt")):
        sweep = Sweep("depth [mm]", depths, ("corrections",))
        inner = replace(setup.collection.item(name), style=setup.collection.item(other).style)
        outfit = setup.collection.outfit([name, name])
        outfit = replace(outfit, items=(inner, outfit.items[1]))  # told apart by their looks only
        case = setup.case(test, f"contact {where}, {name}", outfit, motion, sweep)
        yield replace(case, run=runs.placed_contact(region))


def _mixed(
    start: Float[np.ndarray, " Z"], end: Float[np.ndarray, " Z"], share: float
) -> Float[np.ndarray, " Z"]:
    return ((1 - share) * start + share * end).astype(np.float32)
