"""Relaxing strained cloth: energy and gradient, descent over skin, what must stay, and when it runs."""

import numpy as np
import pytest
import torch
from collision_shapes import LEFT_ARM, collision, obstacle, tube

from isp_assets import clearing
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions, Draper, drape
from isp_assets.dressing import dress
from isp_assets.errors import GeometryError
from isp_assets.evaluate import stress_motions
from isp_assets.evaluate.stress_setup import StressSetup
from isp_assets.geometry.energy import (
    ClothRest,
    Fabric,
    bending_energy,
    cloth_rest,
    gravity_energy,
    membrane_energy,
)
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, apart_from_arms
from isp_assets.geometry.relaxation import ElasticCloth, relax
from isp_assets.motion import Motion
from isp_assets.shot import Shot

RADIUS, SKIN = 0.104, 0.1
SHAPE = tube(RADIUS)
FABRIC = Fabric()


def _rest() -> ClothRest:
    """The tube cut open and laid flat: its faces' own shapes in their own planes."""
    vertices, faces = SHAPE
    corner = vertices[faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    length = np.linalg.norm(first, axis=1)
    along = (first * second).sum(1) / length
    height = np.linalg.norm(np.cross(first, second), axis=1) / length
    zero = np.zeros_like(length)
    flat = np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([along, height], 1)], 1)
    return cloth_rest(faces, flat, len(vertices), FABRIC)


def _cloth(held: np.ndarray | None = None) -> ElasticCloth:
    none = np.zeros(len(SHAPE[0]), bool)
    return ElasticCloth(_rest(), FABRIC, free=~(none if held is None else held))


def _bunched() -> np.ndarray:
    """The tube with its middle pulled up by 3 cm: above it too short, beneath it too long."""
    vertices = SHAPE[0].copy()
    vertices[:, 1] += 0.03 * np.exp(-((vertices[:, 1] / 0.05) ** 2))
    return vertices


def _body(radius: float = SKIN) -> Obstacle:
    return obstacle(tube(radius, low=-0.4, high=0.4, columns=80))


def test_energy_and_gradient_are_those_of_the_training_energy() -> None:
    rng = np.random.default_rng(0)
    vertices = SHAPE[0] + 0.004 * rng.normal(size=SHAPE[0].shape)
    value, gradient = _cloth().energy(vertices)
    place = torch.from_numpy(vertices).requires_grad_(True)
    rest = _rest()
    wanted = (
        membrane_energy(place, rest, FABRIC)
        + bending_energy(place, rest, FABRIC)
        + gravity_energy(place, rest)
    )
    wanted.backward()
    assert value == pytest.approx(wanted.item(), rel=1e-10)
    np.testing.assert_allclose(gradient, place.grad.numpy(), rtol=1e-8, atol=1e-12)


def test_flat_lengths_give_the_strain_of_uniform_stretch() -> None:
    assert _cloth().strain_p99(SHAPE[0]) < 1e-9
    assert _cloth().strain_p99(1.2 * SHAPE[0]) == pytest.approx(0.2)


def test_strained_cloth_slides_over_the_skin() -> None:
    cloth, start = _cloth(), _bunched()
    after = relax(start, cloth, collision(SHAPE), [_body()])
    assert cloth.strain_p99(after) < 0.4 * cloth.strain_p99(start)
    assert cloth.energy(after)[0] < cloth.energy(start)[0]
    assert np.abs(after - start).max() > 0.01  # by sliding, which no push off the skin brings about


def test_tight_cloth_stays_above_the_skin() -> None:
    start = SHAPE[0] * [1.2, 1, 1.2]
    after = relax(start, _cloth(), collision(SHAPE), [_body(0.115)])
    radius = np.linalg.norm(after[:, [0, 2]], axis=1)
    assert 0.1175 < radius.min() < radius.max() < 0.12  # it would be 0.104 wide without the skin


def test_more_rounds_only_lower_the_energy() -> None:
    """Friction is absent, so the tube also slides down; held at its upper end it comes to rest."""
    held = SHAPE[0][:, 1] > 0.19
    cloth = _cloth(held)
    energies = [
        cloth.energy(relax(_bunched(), cloth, collision(SHAPE), [_body(0.08)], rounds=n))[0]
        for n in (1, 2, 4, 16)
    ]
    assert (np.diff(energies) <= 1e-6).all()
    assert energies[2] - energies[3] < 0.05 * (cloth.energy(_bunched())[0] - energies[3])


def test_a_turned_scene_gives_turned_positions() -> None:
    turn = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])  # about the vertical, as gravity must stay
    mesh, cloth = collision(SHAPE), _cloth()
    skin = _body()
    turned = Obstacle(skin.mesh, skin.vertices @ turn.T, margin=skin.margin)
    after = relax(_bunched() @ turn.T, cloth, mesh, [turned])
    np.testing.assert_allclose(after, relax(_bunched(), cloth, mesh, [skin]) @ turn.T, atol=1e-6)


def test_held_vertices_stay() -> None:
    held = SHAPE[0][:, 1] > 0.19
    start = _bunched()
    after = relax(start, _cloth(held), collision(SHAPE), [_body()])
    np.testing.assert_array_equal(after[held], start[held])
    assert np.linalg.norm(after - start, axis=1).max() > 0.01


def test_strained_cloth_slides_over_a_layer_and_stays_above_it() -> None:
    cloth, start = _cloth(), _bunched()
    layer = obstacle(tube(0.1015, low=-0.4, high=0.4, columns=80), margin=0.0025)
    after = relax(start, cloth, collision(SHAPE), [_body(0.095), layer])
    assert cloth.strain_p99(after) < 0.4 * cloth.strain_p99(start)
    tight = relax(SHAPE[0] * [1.2, 1, 1.2], cloth, collision(SHAPE), [_body(), _body(0.115)])
    radius = np.linalg.norm(tight[:, [0, 2]], axis=1)
    assert 0.1175 < radius.min() < radius.max() < 0.12  # it would be 0.104 wide without the layer


def test_cloth_that_an_arm_presses_on_stays_where_it_was_put() -> None:
    start = _bunched()
    arm = obstacle(tube(0.1035, low=-0.03, high=0.03, columns=80), joint=LEFT_ARM)
    body = _body()
    faces = np.concatenate([body.mesh.topology.faces, arm.mesh.topology.faces + len(body.vertices)])
    weights = np.zeros((len(body.vertices) + len(arm.vertices), 24))
    weights[: len(body.vertices), 0] = weights[len(body.vertices) :, LEFT_ARM] = 1
    vertices = np.concatenate([body.vertices, arm.vertices])
    skin = Obstacle(CollisionMesh.build(faces, weights), vertices, margin=0.003)
    free, pressed = (
        np.linalg.norm(relax(start, _cloth(), collision(SHAPE), [beneath]) - start, axis=1)
        for beneath in (body, skin)
    )
    under = np.abs(start[:, 1]) < 0.02
    assert pressed[under].max() < 0.2 * free[under].max()


def test_cloth_that_is_to_stay_still_stays() -> None:
    start = _bunched()
    still = np.abs(start[:, 1]) < 0.05
    moved = [
        np.linalg.norm(relax(start, _cloth(), collision(SHAPE), [_body()], still=part) - start, axis=1)
        for part in (None, still)
    ]
    assert moved[1][still].max() < 0.2 * moved[0][still].max()


def test_all_but_the_arms_count_as_one() -> None:
    parts = np.eye(6, dtype=bool)
    own = apart_from_arms(parts)
    arms = [2, 3]
    rest = [0, 1, 4, 5]
    assert own[np.ix_(rest, rest)].all()
    np.testing.assert_array_equal(own[arms], parts[arms])
    assert not own[np.ix_(rest, arms)].any()


@pytest.mark.parametrize("wrong", [{"rounds": 0}, {"steps": 0}])
def test_no_rounds_or_steps_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(GeometryError, match="at least 1 round"):
        relax(SHAPE[0], _cloth(), collision(SHAPE), [_body()], **wrong)


def test_a_deep_squat_is_relaxed_and_walking_is_left_alone() -> None:
    setup = StressSetup.load()
    outfit = Collection.load().outfit(["mini_skirt"])
    squat = Shot("squat", setup.body, stress_motions.deep_squat(setup.figure, [10.0, 48.0]))
    (chunk,) = list(drape(outfit, squat, DrapeOptions(resolution=64, keep_stages=True)))
    assert [("relax" in layers[0]) for layers in chunk.steps] == [False, True]
    worn = dress(outfit, setup.body, torch.zeros(10), resolution=64)[0].elastic
    before, after = (worn.strain_p99(stage[0][1]) for stage in (chunk.stages["project"], chunk.layers))
    assert before > 0.34
    assert after < 0.3
    np.testing.assert_array_equal(chunk.layers[0][0], chunk.stages["project"][0][0])
    walk = Shot("walk", setup.body, Motion.load("walk").select(FrameRange(50, 50)))
    (chunk,) = list(drape(outfit, walk, DrapeOptions(resolution=64)))
    assert "relax" not in chunk.steps[0][0]


def test_cloth_that_is_barely_strained_barely_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = StressSetup.load()
    outfit = Collection.load().outfit(["mini_skirt"])
    squat = Shot("squat", setup.body, stress_motions.deep_squat(setup.figure, [48.0]))
    draper = Draper(outfit, squat, DrapeOptions(resolution=48, keep_stages=True))

    def largest_move(strained: float) -> float:
        monkeypatch.setattr(clearing, "_STRAINED", strained)
        monkeypatch.setattr(clearing, "_OVERSTRAINED", strained + 0.1)
        chunk = draper.chunk(slice(0, 1))
        return float(np.linalg.norm(chunk.layers[0][0] - chunk.stages["project"][0][0], axis=1).max())

    strain = draper.worn[0].elastic.strain_p99(draper.chunk(slice(0, 1)).stages["project"][0][0])
    wholly = largest_move(strain - 0.1)
    assert wholly > 0.01
    assert largest_move(strain - 0.001) < 0.05 * wholly
    assert largest_move(strain) < 1e-6


def test_a_tucked_hem_stays_where_it_was_pressed() -> None:
    setup = StressSetup.load()
    outfit = Collection.load().outfit(["long_sleeved_shirt", "trousers"])
    squat = Shot("squat", setup.body, stress_motions.deep_squat(setup.figure, [48.0]))
    draper = Draper(outfit, squat, DrapeOptions(resolution=48, keep_stages=True))
    chunk = draper.chunk(slice(0, 1))
    tucked = draper.worn[0].tucked
    moved = np.linalg.norm(chunk.layers[0][0] - chunk.stages["project"][0][0], axis=1)
    assert "relax" in chunk.steps[0][0]
    assert 0.05 < tucked.mean() < 0.4
    assert not draper.worn[1].tucked.any()
    assert np.percentile(moved[tucked], 90) < 0.004
    assert moved[~tucked].max() > 0.006
