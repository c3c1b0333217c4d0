"""Spreading moves over a mesh."""

import numpy as np
from collision_shapes import collision, sheet

from isp_assets.geometry.spread import fade_out, keep_larger, spread


def _field(rings: int, decay: float = 0.9) -> np.ndarray:
    shape = sheet(11)
    move = np.zeros_like(shape[0])
    move[60] = [0, 0.01, 0]  # the middle
    return spread(move, collision(shape).topology.neighbour_average, rings=rings, decay=decay)[:, 1].reshape(
        11, 11
    )


def test_moved_vertices_keep_their_move_and_neighbours_follow_less_and_less() -> None:
    field = _field(8)
    assert field[5, 5] == 0.01
    row = field[5, 5:]
    assert (np.diff(row) <= 0).all()
    assert 0 < row[1] < 0.01


def test_a_very_small_move_of_its_own_holds_nothing_back() -> None:
    """Whether a vertex beside a lifted one lies a hair within the margin or without makes no difference."""
    shape = sheet(11)
    average = collision(shape).topology.neighbour_average
    fields = []
    for own in (0.0, 1e-7):
        move = np.zeros_like(shape[0])
        move[60], move[61] = [0, 0.01, 0], [0, own, 0]
        fields.append(spread(move, average, rings=8, decay=0.9))
    np.testing.assert_allclose(fields[1], fields[0], atol=1e-6)


def test_every_vertex_moves_at_least_as_far_as_it_must() -> None:
    shape, rng = sheet(11), np.random.default_rng(3)
    move = np.where(rng.random((121, 1)) < 0.3, rng.uniform(0, 0.01, (121, 1)), 0) * np.array([0, 1.0, 0])
    field = spread(move, collision(shape).topology.neighbour_average, rings=8, decay=0.9)
    assert (field[:, 1] >= move[:, 1] - 1e-12).all()


def test_as_many_rings_follow_as_asked_for() -> None:
    reached = np.abs(np.subtract.outer(np.arange(11), [5])).reshape(11, 1)
    for rings in (0, 1, 3):
        moved = _field(rings) > 0
        distance = np.maximum(reached, reached.T)
        assert not moved[distance > rings].any()
        assert moved[5, 5 + rings]


def test_a_field_of_ones_is_kept_by_the_average() -> None:
    average = collision(sheet(6)).topology.neighbour_average
    np.testing.assert_allclose(average @ np.ones(36), 1.0)


def test_shares_fade_in_a_straight_line_whatever_the_size_of_the_triangles() -> None:
    for count in (21, 41):
        vertices, faces = sheet(count)
        edge = 0.2 / (count - 1)
        share = np.where(vertices[:, 0] < -0.0999, 1.0, 0.0)
        faded = fade_out(share, faces, reach=0.1, edge=edge)
        np.testing.assert_allclose(faded, (-vertices[:, 0] / 0.1).clip(0, 1), atol=1e-9)
        assert share.sum() == count


def test_no_move_stays_no_move() -> None:
    still = np.zeros((36, 3))
    assert spread(still, collision(sheet(6)).topology.neighbour_average, rings=4, decay=0.9) is still


def test_the_longer_of_two_moves_is_kept_per_row() -> None:
    kept = np.array([[1.0, 0, 0], [0, 0, 0], [0, 3.0, 0]])
    keep_larger(kept, np.array([[0, 2.0, 0], [0, 0.5, 0]]), np.array([0, 2]))
    assert kept.tolist() == [[0, 2.0, 0], [0, 0, 0], [0, 3.0, 0]]
    keep_larger(kept, np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 9.0]]))
    assert kept.tolist() == [[0, 2.0, 0], [0, 0, 1.0], [0, 0, 9.0]]
