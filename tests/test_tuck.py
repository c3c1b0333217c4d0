"""Tucking: a wide inner garment gives way, everything else stays."""

import numpy as np
import pytest
from collision_shapes import LEFT_ARM, collision, obstacle, tube

from isp_assets.errors import GeometryError
from isp_assets.geometry.tuck import GIVE, Hidden, press, tuck

SKIN = obstacle(tube(0.05, low=-0.5, high=0.5))
"""A body far beneath all that is tucked in here."""


def _radius(vertices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[:, [0, 2]], axis=1)


def test_a_wide_hem_is_drawn_in_under_the_cover_and_the_rest_follows_smoothly() -> None:
    shirt, trousers = tube(0.15, low=-0.3, high=0.3), tube(0.1, low=-0.4, high=0.0)
    after = tuck(shirt[0], collision(shirt), [obstacle(trousers)], SKIN)
    radius = _radius(after)
    under = shirt[0][:, 1] < -0.07  # below, the border of the cover lets it out softly
    assert radius[under].max() < 0.1 + GIVE + 5e-4
    assert radius[shirt[0][:, 1] > 0.28].min() > 0.145  # the far end hardly moves
    profile = radius.reshape(21, -1).mean(1)
    above = profile[shirt[0].reshape(21, -1, 3)[:, 0, 1] >= 0]
    assert (np.diff(above) > -1e-9).all()  # it widens steadily from the waist up
    assert np.abs(np.diff(profile)).max() < 0.02


def test_what_stands_out_no_further_than_it_may_is_left_alone() -> None:
    inner, outer = tube(0.1 + 0.9 * GIVE), tube(0.1, low=-0.3, high=0.3)
    assert tuck(inner[0], collision(inner), [obstacle(outer)], SKIN) is inner[0]
    assert tuck(outer[0], collision(outer), [obstacle(inner)], SKIN) is outer[0]  # lies beneath already
    assert tuck(inner[0], collision(inner), [], SKIN) is inner[0]


def test_garments_of_different_parts_or_far_apart_do_not_meet() -> None:
    inner, outer = tube(0.15), tube(0.1, low=-0.3, high=0.3)
    assert tuck(inner[0], collision(inner, LEFT_ARM), [obstacle(outer)], SKIN) is inner[0]
    wide = tube(0.3)
    assert tuck(wide[0], collision(wide), [obstacle(outer)], SKIN) is wide[0]


def test_nothing_is_drawn_into_the_skin() -> None:
    """The cover cuts deep into the body, as trousers do in a crease of the hip: the shirt stops above it."""
    shirt, trousers = tube(0.12, low=-0.3, high=0.3), tube(0.06, low=-0.4, high=0.0)
    body = obstacle(tube(0.1, low=-0.5, high=0.5))
    after = _radius(tuck(shirt[0], collision(shirt), [obstacle(trousers)], body))
    assert after.min() == pytest.approx(0.104, abs=5e-4)
    assert after.min() < 0.105 < _radius(shirt[0]).min()


def test_negative_give_is_refused() -> None:
    inner = tube(0.1)
    with pytest.raises(GeometryError, match="give"):
        tuck(inner[0], collision(inner), [], SKIN, give=-1.0)


def test_what_stands_out_of_its_cover_at_rest_is_hidden_and_what_has_room_is_not() -> None:
    body, trousers = obstacle(tube(0.09, low=-0.5, high=0.5)), tube(0.1, low=-0.4, high=0.0)
    shirt = tube(0.12, low=-0.3, high=0.3)
    hidden = Hidden.at_rest(shirt[0], collision(shirt), [obstacle(trousers)], body)
    under = (shirt[0][:, 1] < -0.07) & (shirt[0][:, 1] > -0.33)
    assert (hidden.share[under] > 0.99).all()
    assert (hidden.share[shirt[0][:, 1] > 0.01] == 0).all()
    np.testing.assert_allclose(hidden.height[under], 0.01, atol=1.5e-3)  # the cover lies a centimetre up
    vest = tube(0.094, low=-0.3, high=0.3)
    roomy = obstacle(tube(0.12, low=-0.4, high=0.0))
    assert not Hidden.at_rest(vest[0], collision(vest), [roomy], body).share.any()
    assert not Hidden.at_rest(shirt[0], collision(shirt), [], body).share.any()


def test_hidden_cloth_is_pressed_in_to_where_its_cover_lies() -> None:
    body, trousers = obstacle(tube(0.09, low=-0.5, high=0.5)), tube(0.1, low=-0.4, high=0.0)
    shirt = tube(0.12, low=-0.3, high=0.3)
    hidden = Hidden.at_rest(shirt[0], collision(shirt), [obstacle(trousers)], body)
    pressed = _radius(press(shirt[0], collision(shirt), hidden, body))
    under = shirt[0][:, 1] < -0.07
    np.testing.assert_allclose(pressed[under], 0.1, atol=1.5e-3)
    np.testing.assert_allclose(pressed[shirt[0][:, 1] > 0.01], 0.12, atol=1e-9)
    nothing = Hidden(np.zeros(len(shirt[0])), hidden.height)
    assert press(shirt[0], collision(shirt), nothing, body) is shirt[0]


def test_hidden_cloth_loses_its_crumples_and_the_rest_keeps_its_folds() -> None:
    body, trousers = obstacle(tube(0.09, low=-0.5, high=0.5)), tube(0.1, low=-0.4, high=0.0)
    shirt = tube(0.12, low=-0.3, high=0.3)
    mesh = collision(shirt)
    hidden = Hidden.at_rest(shirt[0], mesh, [obstacle(trousers)], body)
    crumpled = shirt[0] + [0, 0.012, 0] * np.random.default_rng(0).normal(size=(len(shirt[0]), 1))
    pressed = press(crumpled, mesh, hidden, body)

    def roughness(points: np.ndarray) -> float:
        inner = (hidden.share > 0.99) & ~mesh.topology.border_vertex
        return float(np.abs(mesh.topology.neighbour_average @ points - points)[inner, 1].mean())

    assert roughness(pressed) < 0.4 * roughness(crumpled)
    assert np.array_equal(pressed[hidden.share == 0], crumpled[hidden.share == 0])
