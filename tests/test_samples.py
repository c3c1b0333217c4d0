"""The samples run as they are: each ends in its own assertions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parents[1] / "samples"
QUICK = ["02_read_usd_back.py", "03_bake_fabrics.py", "04_own_writer.py"]
DRAPING = ["01_bundle_to_usd.py"]


def run(*command: str, cwd: Path) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_sample_is_listed() -> None:
    assert sorted(QUICK + DRAPING) == sorted(p.name for p in SAMPLES.glob("[0-9]*.py"))


@pytest.mark.parametrize("name", QUICK)
def test_sample_runs(name: str, tmp_path: Path) -> None:
    assert run(str(SAMPLES / name), cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAPING)
def test_draping_sample_runs(name: str, tmp_path: Path) -> None:
    assert "nothing to complain about" in run(str(SAMPLES / name), cwd=tmp_path)


def test_the_template_passes_its_own_tests(tmp_path: Path) -> None:
    out = run("-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=SAMPLES / "writer_plugin_template")
    assert "2 passed" in out
