"""The Newton solver: cases with a known answer, a garment at rest, and what happens without the extra."""

import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from hanging_cloth import hanging_square
from scipy.spatial import ConvexHull

from isp_assets.errors import MissingExtraError, PluginError
from isp_assets.evaluate.physics import PhysicsOptions, evaluate_physics
from isp_assets.frames import DrapedFrames
from isp_assets.physics import Cloth, PhysicsScene, PhysicsSolver, make_solver
from isp_assets.synthetic import synthetic_shot
from isp_assets_plugins.newton import NewtonOptions, NewtonSolver
from isp_assets_plugins.newton.simulation import Simulation, _wound_alike

needs_newton = pytest.mark.skipif(
    find_spec("newton") is None, reason="needs the extra: pip install 'isp-assets[newton]'"
)


def _moved(scene: PhysicsScene, path: np.ndarray) -> PhysicsScene:
    """The scene carried along a path ``[T, 3]``, body, start and held vertices alike."""
    cloths = tuple(replace(cloth, start=cloth.start + path[:, None]) for cloth in scene.cloths)
    return replace(scene, cloths=cloths, body=scene.body + path[:, None])


@pytest.mark.parametrize("package", ["newton", "warp"])
def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'isp-assets\[newton\]'"):
        NewtonSolver()


def test_plugin_loads_without_importing_newton() -> None:
    import subprocess

    code = "import sys, isp_assets_plugins.newton; sys.exit('newton' in sys.modules or 'warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_options_are_checked() -> None:
    with pytest.raises(PluginError, match="1 or more"):
        NewtonOptions(substeps=0)


def test_flat_faces_are_turned_without_changing_their_shape() -> None:
    corners = np.random.default_rng(0).normal(size=(20, 3, 2))
    turned = _wound_alike(corners)
    first, second = turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0]
    assert (first[:, 0] * second[:, 1] > first[:, 1] * second[:, 0]).all()
    for shift in (1, 2):
        lengths = [np.linalg.norm(c - np.roll(c, shift, axis=1), axis=-1) for c in (corners, turned)]
        np.testing.assert_allclose(*lengths)


@needs_newton
def test_entry_point_gives_the_solver() -> None:
    solver = make_solver("newton")
    assert isinstance(solver, PhysicsSolver)
    assert solver.version.startswith("newton ")


@needs_newton
def test_square_hangs_as_far_as_a_bar_of_its_stiffness() -> None:
    """The hem sinks by ``density g L^2 / 2E``; gravity pulls along one axis of the panel."""
    scene = hanging_square(9)
    solver = NewtonSolver(NewtonOptions(first_settle=500, still=1e-5))
    found = solver.drape(scene).states["settled"][0][0]
    start, fabric = scene.cloths[0].start[0], scene.fabric
    young = 4 * fabric.mu * (fabric.mu + fabric.lam) / (2 * fabric.mu + fabric.lam)
    height = 0.5 - start[:, 1]  # measured down from the held edge
    sag = fabric.density * 9.81 * (0.5 * height - 0.5 * height**2) / young
    np.testing.assert_allclose(found[:, 1], start[:, 1] - sag, atol=2e-4)
    np.testing.assert_allclose(found[:, [0, 2]], start[:, [0, 2]], atol=2e-4)


@needs_newton
def test_flat_square_rests_without_gravity() -> None:
    scene = hanging_square(9)
    result = NewtonSolver(NewtonOptions(gravity=0.0, first_settle=20)).drape(scene)
    np.testing.assert_allclose(result.states["settled"][0], scene.cloths[0].start, atol=1e-6)
    held = NewtonSolver(NewtonOptions(gravity=0.0)).hold(scene, 0, (scene.cloths[0].start[0],), 5)
    assert held.finite
    assert held.fastest < 1e-4


@needs_newton
def test_first_step_from_rest_falls_freely() -> None:
    """Slack cloth gains ``g dt`` in a step; the solver takes .2 % of every speed away."""
    scene = hanging_square(9)
    free = replace(scene.cloths[0], held=np.zeros(0, np.int64))
    scene = replace(scene, cloths=(free,))
    held = NewtonSolver(NewtonOptions(substeps=8)).hold(scene, 0, (free.start[0],), 1)
    assert held.fastest == pytest.approx(0.998 * 9.81 / (8 * 30), rel=1e-3)


@needs_newton
def test_held_vertices_follow_and_travel_changes_nothing() -> None:
    """A scene that accelerates sideways gives the drape of the one that stands, carried along."""
    path = np.array([[0, 0, 0], [0.05, 0, 0.02], [0.2, 0, 0.1]])
    solver = NewtonSolver(NewtonOptions(first_settle=30, settle=10, substeps=2))
    still = solver.drape(_moved(hanging_square(9), np.zeros_like(path)))
    moved = solver.drape(_moved(hanging_square(9), path))
    for state in ("moving", "settled"):
        np.testing.assert_allclose(moved.states[state][0], still.states[state][0] + path[:, None], atol=1e-4)
    top = hanging_square(9).cloths[0].held
    np.testing.assert_allclose(
        moved.states["moving"][0][:, top],
        hanging_square(9).cloths[0].start[:, top] + path[:, None],
        atol=1e-6,
    )


@needs_newton
def test_skin_that_slides_drags_the_cloth_along() -> None:
    """Cloth on a slab: friction speeds it up towards the slab's velocity, and never beyond."""
    square = hanging_square(9)
    flat = square.cloths[0].start[:, :, [0, 2, 1]] * (1, 1, -1) + (0, 0.0045, 0)
    x, y, z = np.meshgrid([-1.0, 1.5], [-1.0, 0.0], [-1.5, 1.0], indexing="ij")
    slab = np.stack([x, y, z], -1).reshape(-1, 3)
    hull = ConvexHull(slab)
    outward = np.einsum("fc,fc->f", _normals(slab, hull.simplices), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    cloth = replace(square.cloths[0], start=flat, held=np.zeros(0, np.int64))
    scene = PhysicsScene((cloth,), faces.astype(np.int64), slab[None])
    simulation = Simulation(scene, NewtonOptions())
    simulation.place(flat[0])
    speeds = []
    for step in range(1, 25):
        body = slab + np.array([0.1 * step / 240, 0, 0])  # 0.1 m/s
        simulation.step(body, np.zeros((0, 3)), 1 / 240)
        speeds.append(simulation.save()[1][:, 0].mean())
    assert 0.03 < speeds[-1] < 0.101
    assert speeds[2] < speeds[-1]


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = vertices[faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


@needs_newton
@pytest.mark.slow
def test_garment_at_rest_on_the_t_pose_stays_within_millimetres() -> None:
    from isp_assets import Body, Collection
    from isp_assets.decode import decode_garment

    body, item = Body.load("default"), next(iter(Collection.load("default").outfit(["tee"])))
    garment = decode_garment(item.bundle.model, item.code, resolution=64, name=item.name)
    cloth = Cloth(
        "tee", garment.faces, garment.corner_xy.astype(np.float64),
        garment.rest_vertices[None].astype(np.float64), garment.anchors.astype(np.int64),
    )  # fmt: skip
    scene = PhysicsScene((cloth,), body.faces.numpy(), body.template[None].double().numpy())
    found = NewtonSolver(NewtonOptions()).drape(scene).states["settled"][0]
    distance = 1e3 * np.linalg.norm(found - cloth.start, axis=-1)
    assert distance.mean() < 8
    assert np.percentile(distance, 95) < 25


@needs_newton
@pytest.mark.slow
def test_layers_are_compared_and_held() -> None:
    """Two loose tubes hang from their tops over an egg: no layer sinks into another."""
    shot = synthetic_shot(frames="1001-1002")
    chunks = (
        replace(chunk, stages={"skin": chunk.layers, "displace": chunk.layers}) for chunk in shot.chunks(2)
    )
    solver = NewtonSolver(NewtonOptions(first_settle=60, settle=60))
    report = evaluate_physics(DrapedFrames(shot.scene, chunks), solver, PhysicsOptions(hold_frames=1))
    assert all(row["finite"] for row in report.holds)
    settled = [row for row in report.rows if row["state"] == "newton settled"]
    assert len(settled) == 2
    for row in settled:
        assert row["crossing_pairs"] == 0
        assert row["body_area_percent"] == 0
        assert row["distance_mean_mm"] == 0
