"""Little room: how little is seen, and that smoothing flattens what lies there and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from collision_shapes import collision, obstacle, sheet

from isp_assets.geometry.energy import Fabric, cloth_rest
from isp_assets.geometry.folds import folded_faces
from isp_assets.geometry.intersection import Beneath, measure_intersection
from isp_assets.geometry.lifts import open_beneath
from isp_assets.geometry.narrow import crumpled, flatten, narrowness
from isp_assets.geometry.obstacle import NO_ROOM, Obstacle
from isp_assets.geometry.projection import project
from isp_assets.geometry.stretch import StretchLimit
from isp_assets.geometry.topology import hinges

TORSO, LEFT_ARM = 0, 2  # in the order of the body's parts


def _gap(width: float) -> Obstacle:
    """Two sheets that face each other, as one surface."""
    (low, faces), (high, _) = sheet(11), sheet(11, height=width)
    return obstacle((np.concatenate([low, high]), np.concatenate([faces, faces[:, ::-1] + len(low)])))


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [
        (0.001, 0.0003, 1.0), (NO_ROOM, 0.001, 1.0), (0.0065, 0.001, 0.5), (0.009, 0.001, 0.0),
        (0.001, -0.015, 0.5), (0.001, -0.03, 0.0),
    ],
)  # fmt: skip
def test_narrowness_follows_the_gap_and_the_distance_from_it(
    width: float, height: float, expected: float
) -> None:
    beneath = _gap(width)
    found = beneath.whole(np.array([[0.001, height, 0.002]]))
    np.testing.assert_allclose(narrowness(beneath, found), expected, atol=1e-6)


def _folded(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    cloth, faces = sheet(21)
    return cloth + 0.003 * np.random.default_rng(seed).normal(size=cloth.shape), faces


def test_smoothing_fades_out_around_what_has_no_room() -> None:
    cloth, faces = _folded()
    assert not flatten(cloth, collision((cloth, faces)), np.zeros(len(cloth))).any()
    share = np.zeros(len(cloth))
    middle = np.linalg.norm(cloth[:, [0, 2]], axis=1).argmin()
    share[middle] = 1.0
    away = np.linalg.norm((cloth - cloth[middle])[:, [0, 2]], axis=1)
    moves = flatten(cloth, collision((cloth, faces)), share, fade=0.03)
    assert share.sum() == 1.0  # not written to
    assert moves[middle].any()
    assert not moves[away > 0.05].any()
    alone = flatten(cloth, collision((cloth, faces)), share, fade=0.0)
    assert np.flatnonzero(alone.any(axis=1)).tolist() == [middle]


def test_smoothing_takes_out_the_same_folds_at_any_resolution() -> None:
    """A wave of 5 cm keeps about the same part of its height on triangles of 10 and of 5 mm."""
    kept = []
    for count in (21, 41):
        cloth, faces = sheet(count)
        wave = 0.003 * np.sin(2 * np.pi * cloth[:, 0] / 0.05)
        cloth[:, 1] = wave
        smoothed = cloth + flatten(cloth, collision((cloth, faces)), np.ones(len(cloth)))
        inner = np.abs(cloth[:, [0, 2]]).max(axis=1) < 0.05
        kept.append(float(smoothed[inner, 1] @ wave[inner] / (wave[inner] @ wave[inner])))
    assert kept[0] < 0.7
    assert kept[1] == pytest.approx(kept[0], abs=0.1)


def test_smoothing_turns_with_the_cloth_and_takes_roughness_out_of_it() -> None:
    cloth, faces = _folded()
    mesh, share = collision((cloth, faces)), np.ones(len(cloth))
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    moves = flatten(cloth, mesh, share)
    np.testing.assert_allclose(flatten(cloth @ turn + 1.0, mesh, share), moves @ turn, atol=1e-12)

    def roughness(points: np.ndarray) -> float:
        inner = ~mesh.topology.border_vertex
        return float(np.square((mesh.topology.neighbour_average @ points - points)[inner, 1]).mean())

    assert roughness(cloth + moves) < 0.5 * roughness(cloth)


def test_cloth_without_room_may_crumple_and_most_of_all_at_its_border() -> None:
    """A pinch at the middle of one border, and one in the midst of the cloth."""
    cloth, faces = sheet(41)
    mesh, flat = collision((cloth, faces)), cloth[:, [0, 2]]
    rest = cloth_rest(faces, flat[faces], len(cloth), Fabric())
    free = StretchLimit.build(rest, held=np.zeros(len(cloth), bool))
    middle = flat[faces].mean(axis=1)

    def least(pinch: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        narrow = np.zeros(len(cloth))
        narrow[np.linalg.norm(flat - pinch, axis=1).argmin()] = 1.0
        limits = crumpled(free, mesh, narrow, edge=0.005)
        np.testing.assert_array_equal(free.least, 0.94)  # not written to
        return limits.least, np.linalg.norm(middle - pinch, axis=1)

    for pinch, lowest, further in (((0.1, 0.0), 0.68, 0.09), ((0.0, 0.0), 0.83, 0.0)):
        allowed, away = least(pinch)
        assert allowed[away < 0.004] == pytest.approx(lowest)
        assert (allowed[away > further] > 0.829).all()
        near, far = (
            allowed[(away > 0.05) & (away < 0.06)].mean(),
            allowed[(away > 0.08) & (away < 0.09)].mean(),
        )
        assert lowest < near < far < 0.94  # it fades
        np.testing.assert_array_equal(allowed[away > 0.18], 0.94)


def test_folded_cloth_in_a_gap_comes_to_lie_in_it() -> None:
    """Cloth crumpled by more than a gap of 4 mm between two blocks allows ends up between them."""
    block = trimesh.creation.box((0.2, 0.05, 0.2)).subdivide_to_size(0.02)
    blocks = block.apply_translation([0, -0.025, 0]) + block.copy().apply_translation([0, 0.054, 0])
    body = obstacle((np.asarray(blocks.vertices), np.asarray(blocks.faces, np.int64)))
    cloth = sheet(21, size=0.16, height=0.002)
    noise = np.random.default_rng(0).uniform(-1, 1, cloth[0].shape)
    cloth = cloth[0] + [0.024, 0.006, 0.024] * noise, cloth[1]
    pairs = hinges(cloth[1]).faces
    sides = Beneath(body.vertices, body.mesh.topology, closed=True)

    def inside(vertices: np.ndarray) -> float:
        found = measure_intersection(vertices, cloth[1], sides)
        return found.area_percent + found.unavoidable_percent

    done = project(cloth[0], collision(cloth), [body])
    assert inside(cloth[0]) > 10
    assert inside(done.vertices) < 0.01 * inside(cloth[0])
    folded = [folded_faces(vertices, cloth[1], pairs).sum() for vertices in (cloth[0], done.vertices)]
    assert folded[1] < 0.1 * folded[0]


def test_a_layer_covers_a_part_only_where_it_belongs_to_that_part_alone() -> None:
    """At an armhole, cloth above the side of a vest may still lie beneath the sleeve of a shirt."""
    vertices, faces = sheet(21)
    mesh = collision((vertices, faces))
    parts = np.zeros_like(mesh.parts)
    parts[:, TORSO] = True
    parts[vertices[:, 0] > 0, LEFT_ARM] = True
    vest = Obstacle(replace(mesh, parts=parts), vertices, margin=0.0025)
    points = np.array([[-0.05, 0.004, 0.0], [0.05, 0.004, 0.0]])
    wanted = np.zeros((2, 6), bool)
    wanted[:, [TORSO, LEFT_ARM]] = True
    left = open_beneath(wanted, vest, vest.whole(points))
    assert left[0].nonzero()[0].tolist() == [LEFT_ARM]
    assert left[1].nonzero()[0].tolist() == [TORSO, LEFT_ARM]
