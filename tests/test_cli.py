"""The command line in a process of its own: outputs, messages, exit codes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

JOB = 'name = "j"\nmotion = "walk"\nframes = "1-2"\nresolution = 40\noutfit = ["tank_top"]\n'
ATLAS = ("train", "atlas", "--data", "x", "--category", "top", "--steps", "1")


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "isp_assets.cli", *map(str, arguments)]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"COLUMNS": "200", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command(*arguments), capture_output=True, text=True, env=environment, timeout=300)


@pytest.fixture
def job(tmp_path: Path) -> Path:
    path = tmp_path / "job.toml"
    path.write_text(JOB)
    return path


def test_drape_writes_what_is_asked_for(job: Path, tmp_path: Path) -> None:
    done = run("drape", job, "--out", tmp_path / "out", "--frames", "3-4", "--write", "usd")
    assert done.returncode == 0, done.stderr
    assert "L00_tank_top" in done.stdout
    assert {p.name for p in (tmp_path / "out").glob("*.*")} == {"j.usdc", "report.json"}


def test_plugins_lists_versions() -> None:
    done = run("plugins")
    assert done.returncode == 0
    for name in ("usd", "glb", "rerun", "sheet"):
        assert name in done.stdout
    assert "broken" not in done.stdout


def test_a_mesh_is_fitted_and_added(tmp_path: Path) -> None:
    """A skirt of the collection, exported in centimetres with Z up, becomes a garment of a new collection."""
    from isp_assets import Collection
    from isp_assets.code_file import GarmentCode
    from isp_assets.geometry.surface_distance import Surface
    from isp_assets.mesh_file import read_surface, write_surface

    garment = Collection.load("default").bundle("skirt.safetensors").decode("pencil_skirt", resolution=64)
    z_up = garment.rest_vertices[:, [0, 2, 1]] * [100, -100, 100]
    write_surface(tmp_path / "found.obj", Surface(z_up, garment.faces))
    done = run(
        "fit", "mesh", tmp_path / "found.obj", "-o", tmp_path / "code.safetensors", "--category", "skirt",
        "--add-to", tmp_path / "mine", "--preview", tmp_path / "preview.ply",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "skirt, read in cm, z up" in done.stdout
    code = GarmentCode.load(tmp_path / "code.safetensors")
    assert code.notes["distance_m"]["mean"] < 2e-3
    mine = Collection.load(tmp_path / "mine")
    assert mine.names()[-1] == "found"
    assert (mine.item("found").code == code.code).all()
    assert len(read_surface(tmp_path / "preview.ply").faces) > 100
    taken = run(
        "fit", "mesh", tmp_path / "found.obj", "-o", tmp_path / "x.safetensors", "--add-to", tmp_path / "mine"
    )
    assert taken.returncode == 3
    assert "has a garment 'found' already" in taken.stderr
    assert not (tmp_path / "x.safetensors").exists(), "refused before the work"
    again = run("fit", "mesh", tmp_path / "found.obj", "-o", tmp_path / "x.safetensors", "--align", "furlong")
    assert again.returncode == 3
    assert "not an alignment" in again.stderr or "unit must be" in again.stderr


@pytest.mark.slow
def test_codes_are_evaluated(tmp_path: Path) -> None:
    bundle = Path(__file__).parents[1] / "isp_assets/data/collection/skirt.safetensors"
    done = run(
        "evaluate", "decode", "--bundle", bundle, "--out", tmp_path, "--pairs", "1", "--steps", "2",
        "--random", "1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {p.name for p in tmp_path.iterdir()} == {"decode.csv", "decode.json", "decode.md"}
    assert "own codes" in (tmp_path / "decode.md").read_text()


def test_garments_lists_the_collection() -> None:
    assert "open_jacket" in run("garments").stdout


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("drape", "none.toml", "--out", "o"), 3, "no such file: none.toml"),
        (("drape", "{job}", "--out", "o", "--frames", "5-"), 3, "not a frame range"),
        (("drape", "{job}", "--out", "o", "--frames", "1-99999"), 3, "has frames"),
        (("drape", "{job}", "--out", "o", "--write", "fbx"), 6, "no writer plugin named 'fbx'"),
        (("drape", "{job}", "--out", "o", "--steps", "skin,glue"), 4, "steps must be some of"),
        (("drape", "{job}", "--out", "o", "--strain", "5"), 4, "strain must be"),
        (("drape", "{job}"), 2, "Missing option"),
        (("garments", "nowhere"), 3, "no such file"),
        (("fit", "mesh", "none.obj", "-o", "c.safetensors"), 3, "no such file: none.obj"),
        (("fit", "mesh", "{job}", "-o", "c.safetensors"), 3, "meshes are read from"),
        (("evaluate", "decode", "--bundle", "none", "--out", "o"), 3, "no such file"),
        (("train", "patterns", "--data", "x", "--category", "top", "--out", "o"), 5, "steps or of minutes"),
        ((*ATLAS, "--out", "o"), 2, "either --patterns or --bundle"),
        ((*ATLAS, "--out", "o", "--patterns", "p", "--bundle", "b"), 2, "either --patterns or --bundle"),
        ((*ATLAS, "--out", "o", "--bundle", "b", "--width", "64"), 2, "leave --width out"),
    ],
)
def test_errors_are_one_message_and_a_code(
    arguments: tuple[str, ...],
    code: int,
    message: str,
    job: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*(a.format(job=job) for a in arguments))
    assert done.returncode == code, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "o").exists()


def test_interrupt_leaves_nothing_half_written(job: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    job.write_text(JOB.replace("1-2", "1-90").replace("40", "96"))
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command("drape", job, "--out", out, "--write", "usd,sheet"),
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        # A background shell starts its children with SIGINT ignored, and Python leaves it so.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not out.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=120)
    assert process.returncode == 130, message
    assert not [p for p in out.rglob("*") if p.is_file() and p.parent.name != "j.frames"]


def test_help_is_quick_to_import() -> None:
    code = "import sys, isp_assets.cli; sys.exit(any(m in sys.modules for m in ('torch', 'pxr', 'rerun')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
