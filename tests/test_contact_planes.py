"""Planes that cloth stays above: their levels, whose they are, and the penalty for lying beneath."""

import numpy as np
import pytest
import trimesh
from collision_shapes import LEFT_ARM, collision, obstacle, sheet

from isp_assets.geometry.closest import ClosestQuery
from isp_assets.geometry.contact_planes import Planes, nearest
from isp_assets.geometry.obstacle import Obstacle

MARGIN = 0.003
FLOOR = sheet(41, size=0.4)
CLOTH = sheet(11, size=0.2, height=0.002)
ALL = np.ones((len(CLOTH[0]), 6), bool)


def _floor(*, hidden: bool = False, joint: int = 0) -> Obstacle:
    tight = np.ones(len(FLOOR[0]), bool) if hidden else None
    return Obstacle(collision(FLOOR, joint), FLOOR[0], margin=MARGIN, tight=tight)


def _box() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box((0.4, 0.3, 0.4))
    return np.asarray(mesh.vertices) - [0, 0.15, 0], np.asarray(mesh.faces, np.int64)


def _each_vertex() -> np.ndarray:
    return np.repeat(np.arange(len(CLOTH[0]))[:, None], 3, axis=1)


def _above(position: np.ndarray, corner: np.ndarray, surface: Obstacle, parts: np.ndarray = ALL) -> Planes:
    return Planes.above(position, corner, surface, nearest(position, corner, surface, parts))


def _lacking(planes: Planes, position: np.ndarray) -> np.ndarray:
    """What each point lacks to its level [m]."""
    place = np.einsum("nk,nkc->nc", planes.weights, position[planes.corner])
    return planes.level - ((place - planes.point) * planes.normal).sum(axis=1)


def test_vertices_are_asked_for_the_margin_and_middles_for_half_of_it() -> None:
    vertices = _above(CLOTH[0], _each_vertex(), _floor())
    middles = _above(CLOTH[0], CLOTH[1], _floor())
    assert len(vertices.level) == len(CLOTH[0])
    assert len(middles.level) == len(CLOTH[1])
    np.testing.assert_allclose(_lacking(vertices, CLOTH[0]), MARGIN + 0.001 - 0.002, atol=1e-9)
    np.testing.assert_allclose(_lacking(middles, CLOTH[0]), 0.5 * (MARGIN + 0.001) - 0.002, atol=1e-9)
    for planes in (vertices, middles):
        np.testing.assert_allclose(
            planes.normal, np.broadcast_to([0, 1.0, 0], planes.normal.shape), atol=1e-9
        )


@pytest.mark.parametrize(
    ("height", "of_layer", "of_body"),
    [
        (0.01, True, True),
        (0.05, False, False),
        (-0.01, True, True),
        (-0.05, False, True),
        (-0.07, False, False),
    ],
)
@pytest.mark.parametrize("body", [False, True])
def test_only_what_is_near_or_not_too_deep_meets_a_plane(
    height: float, of_layer: bool, of_body: bool, body: bool
) -> None:
    """The floor is a layer, or the top of a closed box."""
    position, wanted = CLOTH[0] * [1, 0, 1] + [0, height, 0], of_body if body else of_layer
    beneath = obstacle(_box(), margin=MARGIN) if body else _floor()
    planes = _above(position, _each_vertex(), beneath)
    assert bool(len(planes.level)) == wanted
    if wanted:  # upwards from beneath as well
        np.testing.assert_allclose(planes.normal[:, 1], 1, atol=1e-9)


def test_parts_that_cloth_does_not_belong_to_are_passed_over() -> None:
    arm = np.eye(6, dtype=bool)[np.full(len(CLOTH[0]), 2)]
    garment = ClosestQuery(CLOTH[0], collision(CLOTH).topology)
    concerned = np.ones(len(CLOTH[0]), bool)
    for joint, meets in ((0, False), (LEFT_ARM, True)):
        floor = _floor(joint=joint)
        for planes in (
            _above(CLOTH[0], _each_vertex(), floor, arm),
            Planes.over_vertices(garment, floor, arm, concerned=concerned),
        ):
            assert bool(len(planes.level)) == meets


def test_a_vertex_that_pokes_through_a_triangle_asks_its_corners_for_room() -> None:
    thorn = FLOOR[0].copy()
    middle = CLOTH[0][CLOTH[1][90]].mean(axis=0)
    tip = np.linalg.norm(thorn - middle, axis=1).argmin()
    thorn[tip] = middle + np.array([0, 0.004, 0])
    skin = obstacle((thorn, FLOOR[1]), margin=MARGIN)
    garment = ClosestQuery(CLOTH[0], collision(CLOTH).topology)
    concerned = np.ones(len(CLOTH[0]), bool)
    planes = Planes.over_vertices(garment, skin, ALL, concerned=concerned)
    (row,) = np.flatnonzero((planes.point == thorn[tip]).all(axis=1))
    assert set(planes.corner[row]) == set(CLOTH[1][90])
    np.testing.assert_allclose(planes.weights[row], 1 / 3, atol=0.02)
    assert _lacking(planes, CLOTH[0])[row] > 0.004
    concerned[CLOTH[1][90, 0]] = False
    left = Planes.over_vertices(garment, skin, ALL, concerned=concerned)
    assert not (left.point == thorn[tip]).all(axis=1).any()


def test_cloth_over_hidden_skin_has_a_ceiling() -> None:
    highest = np.full(len(CLOTH[0]), 0.015)
    high = CLOTH[0] + [0, 0.02, 0]
    vertices = _each_vertex()

    def ceiling(floor: Obstacle) -> Planes:
        return Planes.near_hidden(high, vertices, floor, nearest(high, vertices, floor, ALL), highest)

    planes = ceiling(_floor(hidden=True))
    np.testing.assert_allclose(_lacking(planes, high), 0.022 - 0.015, atol=1e-9)
    np.testing.assert_allclose(planes.normal[:, 1], -1, atol=1e-9)
    assert len(ceiling(_floor()).level) == 0


def test_the_penalty_is_quadratic_then_linear_and_its_gradient_is_its_own() -> None:
    rng = np.random.default_rng(0)
    stiffness = rng.uniform(1, 2, len(CLOTH[0]))
    planes = Planes.joined([_above(CLOTH[0], part, _floor()) for part in (_each_vertex(), CLOTH[1])])
    penalty = planes.penalty(len(CLOTH[0]), stiffness)
    for depth in (0.001, 0.04):
        position = CLOTH[0] - [0, depth, 0] + 1e-4 * rng.normal(size=CLOTH[0].shape)
        lacking = _lacking(planes, position).clip(0)
        of_point = np.einsum("nk,nk->n", planes.weights, stiffness[planes.corner])
        wanted = np.where(lacking < 0.025, 0.5 * lacking**2, 0.025 * (lacking - 0.0125))
        value, gradient = penalty.energy(position)
        assert value == pytest.approx((of_point * wanted).sum())
        way, step = rng.normal(size=position.shape), 1e-7
        difference = penalty.energy(position + step * way)[0] - penalty.energy(position - step * way)[0]
        assert difference / (2 * step) == pytest.approx((gradient * way).sum(), rel=1e-4)
    assert penalty.energy(CLOTH[0] + [0, 0.01, 0])[0] == 0


def test_what_is_far_away_sets_no_planes() -> None:
    far = CLOTH[0] + [0, 0.3, 0]
    garment = ClosestQuery(far, collision(CLOTH).topology)
    concerned = np.ones(len(far), bool)
    none = Planes.over_vertices(garment, _floor(), ALL, concerned=concerned)
    assert len(none.level) == 0
    energy, gradient = Planes.joined([none, none]).penalty(len(far), concerned.astype(float)).energy(far)
    assert energy == 0
    assert not gradient.any()
