"""The comparison with a physical equilibrium: exact figures from a made-up solver; energy minima."""

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from click.testing import Result
from hanging_cloth import hanging_square
from typer.testing import CliRunner

from isp_assets.cli import app
from isp_assets.errors import InputError, PluginError
from isp_assets.evaluate.physics import (
    FIGURES,
    HOLD_FIGURES,
    PhysicsOptions,
    PhysicsReport,
    evaluate_physics,
)
from isp_assets.evaluate.physics_energy import EnergyReference
from isp_assets.frames import DrapedFrames, FrameChunk, StageTimes
from isp_assets.geometry.energy import Fabric, cloth_rest
from isp_assets.physics import (
    HoldResult,
    PhysicsResult,
    PhysicsScene,
    PhysicsSolver,
    Reference,
    make_solver,
)
from isp_assets.synthetic import SyntheticShot, synthetic_shot

_DOWN = np.array([0.0, -0.01, 0.0])  # where the made-up equilibrium lies from the start [m]


class _Shifted:
    """A solver whose equilibrium lies 1 cm beneath the start, and whose starts rise by 2 mm."""

    name, version = "shifted", "1"

    def __init__(self, *, finite: bool = True) -> None:
        self.finite = finite
        self.held: list[int] = []

    def drape(self, scene: PhysicsScene) -> PhysicsResult:
        self.scene = scene
        start = tuple(cloth.start for cloth in scene.cloths)
        states = {"moving": tuple(p + 2 * _DOWN for p in start), "settled": tuple(p + _DOWN for p in start)}
        return PhysicsResult(states, {"moving": 0.25, "settled": 2.0}, {"version": self.version})

    def hold(self, scene: PhysicsScene, frame: int, start: tuple[np.ndarray, ...], steps: int) -> HoldResult:
        self.held.append(frame)
        moved = tuple(p + np.array([0, 0.002, 0]) * (1 if self.finite else np.nan) for p in start)
        return HoldResult(moved, 0.5 if self.finite else float("inf"), self.finite)


@pytest.fixture(scope="module")
def shot() -> SyntheticShot:
    return synthetic_shot(frames="1001-1005")


def _chunks(shot: SyntheticShot) -> Iterator[FrameChunk]:
    """Skinning lies 3 cm above the end; tucking changes nothing; the first chunk took long."""
    for number, chunk in enumerate(shot.chunks(2)):
        above = tuple(layer - 3 * _DOWN for layer in chunk.layers)
        stages = {"skin": above, "displace": chunk.layers, "tuck": chunk.layers, "layering": chunk.layers}
        count = len(chunk.frames)
        slow = 10.0 if number == 0 else 1.0
        seconds = {"body": 0.001, "skin": 0.002, "displace": 0.003, "tuck": 0.004, "project": 0.1}
        times = StageTimes({stage: slow * count * value for stage, value in seconds.items()})
        yield replace(chunk, stages=stages, times=times)


def _report(shot: SyntheticShot, solver: Reference, options: PhysicsOptions | None = None) -> PhysicsReport:
    return evaluate_physics(DrapedFrames(shot.scene, _chunks(shot)), solver, options)


def _rows(report: PhysicsReport, garment: str) -> dict[str, dict]:
    return {row["state"]: row for row in report.rows if row["garment"] == garment}


def test_distances_are_those_of_the_solver(shot: SyntheticShot) -> None:
    rows = _rows(_report(shot, _Shifted()), "L01_coat")
    distances = {state: (row["distance_mean_mm"], row["distance_p95_mm"]) for state, row in rows.items()}
    assert list(distances) == ["skin", "displace", "shifted moving", "shifted settled"]
    for state, expected in zip(distances, (40, 10, 10, 0), strict=True):
        assert distances[state] == pytest.approx((expected, expected), abs=1e-3), state


def test_energies_differ_by_the_lift_alone(shot: SyntheticShot) -> None:
    rows = _rows(_report(shot, _Shifted()), "L00_vest")
    garment = shot.scene.layers[0].garment
    mass = float(cloth_rest(garment.faces, garment.corner_xy, garment.num_vertices, Fabric()).mass.sum())
    assert rows["displace"]["above_mj"] == pytest.approx(1e3 * mass * 9.81 * 0.01, rel=1e-3)
    assert rows["skin"]["above_mj"] == pytest.approx(1e3 * mass * 9.81 * 0.04, rel=1e-3)
    assert rows["shifted settled"]["above_mj"] == 0
    settled = rows["shifted settled"]
    for figure in ("membrane_mj", "bending_mj", "strain_p99"):
        assert rows["displace"][figure] == pytest.approx(settled[figure], rel=1e-3, abs=1e-6), figure


def test_times_add_up_over_the_rungs_without_the_first_chunk(shot: SyntheticShot) -> None:
    rows = _rows(_report(shot, _Shifted()), "L00_vest")
    times = {state: row["ms_per_frame"] for state, row in rows.items()}
    assert times == pytest.approx({"skin": 3, "displace": 6, "shifted moving": 250, "shifted settled": 2000})


def test_solver_gets_the_flat_panels_and_the_held_vertices(shot: SyntheticShot) -> None:
    solver = _Shifted()
    _report(shot, solver)
    for cloth, layer, positions in zip(solver.scene.cloths, shot.scene.layers, shot.layers, strict=True):
        np.testing.assert_array_equal(cloth.flat_corners, layer.garment.corner_xy)
        np.testing.assert_array_equal(cloth.held, layer.garment.anchors)
        np.testing.assert_allclose(cloth.start, positions)
    assert solver.scene.fps == shot.scene.fps


def test_held_starts_are_reported_by_rung_and_garment(shot: SyntheticShot) -> None:
    solver = _Shifted()
    report = _report(shot, solver, PhysicsOptions(hold_frames=2, hold_steps=7))
    assert solver.held == [0, 0, 4, 4]
    assert len(report.holds) == 2 * 2 * 2
    for row in report.holds:
        assert set(row) == set(HOLD_FIGURES)
        assert row["finite"]
        assert row["steps"] == 7
        assert row["fastest_mps"] == 0.5
        assert row["moved_mean_mm"] == pytest.approx(2, abs=1e-3)
        assert (row["crossing_before"], row["crossing_after"]) == (0, 0)


def test_start_that_crosses_the_body_is_counted(shot: SyntheticShot) -> None:
    def inside() -> Iterator[FrameChunk]:
        for chunk in _chunks(shot):
            near = tuple(layer * np.array([0.75, 1, 0.75]) for layer in chunk.layers)
            yield replace(chunk, stages={**chunk.stages, "displace": near})

    report = evaluate_physics(DrapedFrames(shot.scene, inside()), _Shifted(), PhysicsOptions(hold_frames=1))
    before = {(row["start"], row["garment"]): row["crossing_before"] for row in report.holds}
    assert before["displace", "L00_vest"] > 0
    assert before["tuck", "L00_vest"] == 0


def test_start_that_explodes_is_said_so(shot: SyntheticShot) -> None:
    report = _report(shot, _Shifted(finite=False), PhysicsOptions(hold_frames=1))
    for row in report.holds:
        assert not row["finite"]
        assert row["crossing_after"] is row["fastest_mps"] is row["moved_mean_mm"] is None
    json.dumps(report.holds, allow_nan=False)


def test_every_figure_is_explained_and_is_plain_json(shot: SyntheticShot) -> None:
    report = _report(shot, _Shifted(), PhysicsOptions(hold_frames=0))
    assert report.holds == []
    assert all(set(row) == set(FIGURES) for row in report.rows)
    json.dumps([report.rows, report.details], allow_nan=False)


def test_frames_without_stages_are_refused(shot: SyntheticShot) -> None:
    with pytest.raises(InputError, match="keep_stages"):
        evaluate_physics(DrapedFrames(shot.scene, shot.chunks(2)), _Shifted())


def test_energy_reference_lets_a_square_hang() -> None:
    """Pinned along its top edge, the middle of the hem sinks as far as a bar of the same stiffness does."""
    scene = hanging_square(8)
    cloth = scene.cloths[0]
    result = EnergyReference(iterations=2000).drape(scene)
    found = result.states["minimum"][0][0]
    fabric, length = scene.fabric, 0.5
    young = 4 * fabric.mu * (fabric.mu + fabric.lam) / (2 * fabric.mu + fabric.lam)
    sag = fabric.density * 9.81 * length**2 / (2 * young)
    hem = cloth.start[0][:, 1] == 0
    assert -found[hem, 1].mean() == pytest.approx(sag, rel=0.1)  # the top edge cannot narrow
    np.testing.assert_allclose(found[cloth.held], cloth.start[0][cloth.held])
    assert np.abs(found[:, 2]).max() < 1e-6


def test_energy_reference_has_no_held_starts(shot: SyntheticShot) -> None:
    assert isinstance(EnergyReference(), Reference)
    assert not isinstance(EnergyReference(), PhysicsSolver)
    assert isinstance(_Shifted(), PhysicsSolver)
    report = _report(shot, EnergyReference(iterations=2))
    assert report.holds == []
    assert list(_rows(report, "L00_vest"))[-1] == "energy minimum"


def test_unknown_solver_is_named() -> None:
    with pytest.raises(PluginError, match="no physics solver named 'aether'"):
        make_solver("aether")


def test_scene_checks_its_frames() -> None:
    scene = hanging_square(8)
    cloth = scene.cloths[0]
    with pytest.raises(PluginError, match="positions for 2 frames"):
        replace(scene, cloths=(replace(cloth, start=np.repeat(cloth.start, 2, axis=0)),))
    with pytest.raises(PluginError, match="needs a garment"):
        replace(scene, cloths=())


def test_command_refuses_an_unknown_reference(tmp_path) -> None:
    run: Result = CliRunner().invoke(
        app, ["evaluate", "physics", "--outfit", "tee", "--reference", "aether", "--out", str(tmp_path)]
    )
    assert isinstance(run.exception, PluginError)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_writes_tables(tmp_path) -> None:
    arguments = ["--outfit", "shorts", "--frames", "11-12", "--resolution", "32", "--reference", "energy"]
    run: Result = CliRunner().invoke(app, ["evaluate", "physics", *arguments, "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    rows = json.loads((tmp_path / "physics.json").read_text())["rows"]
    assert {row["outfit"] for row in rows} == {"shorts"}
    assert [row["state"] for row in rows][-1] == "energy minimum"
