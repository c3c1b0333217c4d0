"""The memory that a piece of work takes at its peak, on top of what the process held before."""

import sys
from pathlib import Path
from types import TracebackType

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class PeakMemory:
    """A context; after it, ``mib`` is the peak in MiB, or None where the system keeps no such count.

    Linux counts the largest resident size since its counter was last set back; memory that the
    process holds free already is used again unseen, so a second run may show less than the first.
    """

    mib: float | None = None

    def __enter__(self) -> "PeakMemory":
        self._before = None
        if sys.platform == "linux":
            try:
                _CLEAR.write_text("5")  # proc(5): set the peak back to the present size
                self._before = _resident("VmRSS")
            except OSError:
                pass
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._before is not None:
            self.mib = max(0.0, _resident("VmHWM") - self._before)


def _resident(name: str) -> float:
    """A size of /proc/self/status [MiB]."""
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024
