"""Processes side by side: threads are pinned for a while, and nobody outlives who started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from isp_assets.processes import available_cores, end_with_parent, one_thread_each

PARENT = """
import time
from multiprocessing import get_context
from isp_assets.processes import end_with_parent

def work():
    end_with_parent()
    time.sleep(120)

if __name__ == "__main__":
    child = get_context("spawn").Process(target=work)
    child.start()
    print(child.pid, flush=True)
    time.sleep(120)
"""


def running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as file:  # an ended process that nobody has waited for is a zombie
        return file.read().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs the process table of Linux")
def test_a_process_ends_with_the_one_that_started_it(tmp_path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    time.sleep(2)  # it must have begun to watch
    assert running(child)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while running(child) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not running(child)


def test_a_first_process_watches_nobody() -> None:
    end_with_parent()


def test_threads_are_pinned_inside_only() -> None:
    before = dict(os.environ)
    with one_thread_each():
        assert os.environ["OMP_NUM_THREADS"] == os.environ["MKL_NUM_THREADS"] == "1"
    assert dict(os.environ) == before


def test_at_least_one_core() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
