"""What counts as good: a limit for every figure of a draped frame, in one place."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Criterion:
    """A figure that must not exceed a limit."""

    column: str
    """Column of the draping table."""
    limit: float
    meaning: str
    figure: str | None = None
    """The same in the figures of one frame of one layer, if it is one of them."""

    def severity(self, row: Mapping[str, Any]) -> float:
        """How many times the limit; 0 where the figure is missing, infinite where the limit is 0."""
        value = row.get(self.column)
        if value is None:
            return 0.0
        if self.limit == 0:
            return float("inf") if value > 0 else 0.0
        return float(value) / self.limit


CRITERIA = (
    Criterion("non_finite", 0.0, "no position is NaN or infinite"),
    Criterion("body_area_max", 0.1, "area inside the body [%]", "body_area_percent"),
    Criterion("inner_area_max", 0.1, "area inside a layer beneath [%]", "inner_area_percent"),
    Criterion("strain_p99_max", 0.35, "99th percentile of the strain", "strain_p99"),
    Criterion("flipped_percent", 0.1, "faces folded over [%]", "flipped_percent"),
    Criterion("jump_ratio", 3.0, "longest way of a garment vertex in a frame over that of the body"),
    Criterion("anchor_jump_ratio", 3.0, "the same for cloth within 3 cm of a waistband"),
    Criterion("jerk_ratio", 1.3, "jerk of the garment over that of the skin beneath, walking"),
    Criterion("noise_gain", 2.0, "scatter under noise over that of the skin beneath"),
    Criterion("difference_mm", 1.0, "distance from the reference run [mm]"),
)
"""Every criterion, the gravest first."""


def failures(row: Mapping[str, Any]) -> list[str]:
    """What a row of the draping table fails, as ``strain_p99_max .41 > .35``; an error comes first."""
    found = [f"error: {row['error']}"] if row.get("error") else []
    for criterion in CRITERIA:
        if criterion.severity(row) > 1:
            found.append(f"{criterion.column} {row[criterion.column]:.3g} > {criterion.limit:g}")
    return found


def severity(row: Mapping[str, Any]) -> float:
    """The worst figure of a row, in multiples of its limit."""
    return max(criterion.severity(row) for criterion in CRITERIA)
