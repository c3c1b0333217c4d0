"""Drawing cloth in: as far as the other part demands and no further, flat where it leaves no room."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.geometry.draw_in import draw_in

DOWN = np.array([[0.0, -1.0, 0.0]])


def _below(level: float):
    """Points lower than ``level`` are clear."""
    return lambda points, rows: level - points[:, 1]


@given(st.integers(1, 100), st.integers(0, 64))
def test_a_point_comes_out_just_below_the_other_part(room_mm: int, share: int) -> None:
    room = room_mm / 2000
    level = -share / 64 * room
    moves, clear = draw_in(np.zeros((1, 3)), DOWN, np.array([room]), _below(level))
    assert clear.all()
    assert moves[0, 1] <= level + 1e-12
    assert level - moves[0, 1] <= room / 2**5 + 1e-12
    assert (moves[0, [0, 2]] == 0).all()


def test_without_enough_room_it_takes_what_there_is() -> None:
    moves, clear = draw_in(np.zeros((1, 3)), DOWN, np.array([0.01]), _below(-0.02))
    assert not clear.any()
    np.testing.assert_allclose(moves, 0.01 * DOWN)


def test_a_light_touch_moves_little_though_nothing_clears_it() -> None:
    """Squeezed for good: what moves grows from nothing with how deep it lies, up to all the room."""

    def squeezed(depth: float) -> float:
        def clearance(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return np.full(len(points), -depth)

        moves, clear = draw_in(np.zeros((1, 3)), DOWN, np.array([0.01]), clearance)
        assert not clear.any()
        return -moves[0, 1]

    moved = [squeezed(depth) for depth in (1e-6, 1e-5, 0.001, 0.003, 0.02)]
    assert moved[0] < 1e-5
    assert moved[1] < 1e-4
    assert (np.diff(moved) > 0).all()
    assert moved[-1] == 0.01


def test_points_are_judged_by_their_own_rows() -> None:
    levels, asked = np.array([-0.004, -0.5, -0.012]), []

    def clearance(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
        asked.append(rows)
        return levels[rows] - points[:, 1]

    points, room = np.zeros((3, 3)), np.full(3, 0.016)
    moves, clear = draw_in(points, np.repeat(DOWN, 3, axis=0), room, clearance)
    assert clear.tolist() == [True, False, True]
    np.testing.assert_allclose(moves[:, 1], [-0.004, -0.016, -0.012], atol=0.016 / 2**5)
    assert asked[-1].tolist() == [0, 2]


def test_no_points_are_no_trouble() -> None:
    moves, clear = draw_in(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), _below(0.0))
    assert moves.shape == (0, 3)
    assert clear.shape == (0,)
