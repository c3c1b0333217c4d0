"""Settings of the process that make training on a CPU fast."""

import ctypes
import sys

import torch

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of mallopt(3)


def prepare_cpu(threads: int | None) -> None:
    """Pin the number of threads (None leaves it), drop denormal numbers, and keep freed memory.

    Softplus(beta=100) yields denormal numbers, which cost four times the time. A C library
    that hands every freed tensor back to the system pays for it page by page at the next
    step, a sixth of the time.
    """
    if threads is not None:
        torch.set_num_threads(threads)
    torch.set_flush_denormal(True)
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_MMAP_THRESHOLD, 2**30)
            mallopt(_TRIM_THRESHOLD, 2**31 - 1)
            mallopt(_TOP_PAD, 2**26)
