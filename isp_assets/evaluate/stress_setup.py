"""What stress cases are made from: a collection, a body, clips to walk in, and the size of a sweep."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.errors import InputError
from isp_assets.evaluate.stress_case import StressCase
from isp_assets.motion import Motion
from isp_assets.outfit import Outfit
from isp_assets.shot import Shot
from isp_assets.train.leg_ik import Figure


@dataclass(frozen=True)
class Sweep:
    """A parameter, its value in every frame (or one for all), and further figures to take."""

    parameter: str
    values: tuple[float, ...]
    measures: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class StressSetup:
    """What the cases are made from."""

    collection: Collection
    body: Body
    clips: tuple[Motion, ...] = ()
    """Held-out motions to walk in, besides the last third of the built-in walk."""
    quick: bool = False
    """Fewer values of every sweep."""

    @classmethod
    def load(
        cls,
        collection: str = "default",
        *,
        folder: Path | None = None,
        clips: Sequence[str] = (),
        quick: bool = False,
    ) -> "StressSetup":
        """Read a collection, the default body and clips.

        Args:
            collection: "default" or a folder.
            folder: Where the clips' ``.npz`` files are.
            clips: Their names.
            quick: Fewer values of every sweep.

        Raises:
            InputError: If clips are named without a folder, or a file is not what it should be.
        """
        if clips and folder is None:
            raise InputError(f"clips {', '.join(clips)}: say in which folder they are (--motions)")
        read = tuple(Motion.load(Path(folder or ".") / f"{name}.npz") for name in clips)
        return cls(Collection.load(collection), Body.load(), read, quick)

    @cached_property
    def figure(self) -> Figure:
        return Figure.of(self.body)

    def sweep(self, start: float | int, end: float | int, step: float | int) -> tuple[float, ...]:
        """Values from ``start`` to ``end``; a third of them, with the last, in a quick run."""
        values = np.arange(start, end + step / 2, step)
        return tuple(float(v) for v in (values[::-3][::-1] if self.quick else values))

    def few(self, values: Sequence[float]) -> tuple[float, ...]:
        """First and last value in a quick run, else all."""
        return (values[0], values[-1]) if self.quick else tuple(values)

    def walk(self, count: int) -> Motion:
        """Frames spread over the last third of the built-in walk."""
        tail = self.walk_tail
        chosen = np.linspace(0, len(tail) - 1, 2 if self.quick else count).round().astype(int)
        return replace(tail, poses=tail.poses[chosen], translation=tail.translation[chosen])

    @cached_property
    def walk_tail(self) -> Motion:
        """The last third of the built-in walk; of that, a third in a quick run."""
        whole = Motion.load("walk")
        first = round(len(whole) * (1 - 0.33)) + 1
        return whole.select(FrameRange(first, first + 12 if self.quick else len(whole)))

    def case(
        self, test: str, label: str, outfit: Outfit | Sequence[str], motion: Motion, sweep: Sweep
    ) -> StressCase:
        """A case on the body's mean shape at 64 cells."""
        chosen = outfit if isinstance(outfit, Outfit) else self.collection.outfit(outfit)
        values = sweep.values if len(sweep.values) > 1 else sweep.values * len(motion)
        return StressCase(
            test,
            label,
            sweep.parameter,
            values,
            chosen,
            Shot(test, self.body, motion),
            measures=sweep.measures,
        )
