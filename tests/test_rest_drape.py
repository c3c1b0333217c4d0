"""Draping to rest: start without contact, physics, invariances, checks that see intersections."""

import numpy as np
import pytest
import torch
from rest_bodies import rest_body

from isp_assets.geometry.energy import bending_energy, cloth_rest, gravity_energy, membrane_energy
from isp_assets.train.drape_start import waist_targets, wrapped_start
from isp_assets.train.garment_maker import CATEGORIES
from isp_assets.train.pattern import sew
from isp_assets.train.rest_drape import DrapeSettings, drape_to_rest, energy_function, intersects

pytest.importorskip("numba")
pytest.importorskip("ipctk")


def sewn(category: str, name: str, spacing: float = 0.03):
    spec = CATEGORIES[category]
    return sew(spec.draw(rest_body(category), rest_body("top").landmarks, spec.presets[name]), spacing)


@pytest.fixture(scope="module")
def skirt():
    pattern = sewn("skirt", "mini_skirt")
    return pattern, drape_to_rest(pattern, rest_body("skirt"))


@pytest.mark.parametrize(
    ("category", "name"),
    [
        ("top", "tee"),
        ("top", "open_jacket"),
        ("top", "tank_top"),
        ("skirt", "pencil_skirt"),
        ("trousers", "shorts"),
    ],
)
def test_the_start_is_clear_of_the_body_and_keeps_the_pattern(category, name):
    pattern, body = sewn(category, name, 0.018), rest_body(category)
    start = wrapped_start(pattern, body)
    assert np.array_equal(start[:, :2], pattern.vertex_xy)
    assert body.distance.sample(start).min() > 0.004
    normal = np.cross(*(start[pattern.faces[:, k]] - start[pattern.faces[:, 0]] for k in (1, 2)))
    side = np.repeat([1, -1], [len(p.faces) for p in pattern.panels.values()])
    assert (normal[:, 2] * side > 0).all()  # the sewn surface faces outwards


def test_the_waist_ring_is_level_symmetric_and_as_long_as_the_pattern():
    pattern, body = sewn("skirt", "a_line_skirt", 0.018), rest_body("skirt")
    ring = waist_targets(pattern, body)
    xy, side = pattern.vertex_xy[pattern.anchors], pattern.vertex_side[pattern.anchors]
    assert np.ptp(ring[:, 1]) == 0
    order = np.argsort(np.where(side >= 0, -xy[:, 0], 10 + xy[:, 0]))
    closed = ring[np.append(order, order[0])]
    length = np.linalg.norm(np.diff(closed, axis=0), axis=1).sum()
    assert length == pytest.approx(4 * np.abs(xy[:, 0]).max(), rel=0.01)
    assert body.distance.sample(ring).min() > 0.001
    assert (ring[side > 0, 2] > ring[side < 0, 2].max()).mean() > 0.5
    for k in np.flatnonzero(side >= 0):
        partner = np.flatnonzero((np.abs(xy - xy[k] * (-1, 1)).max(axis=1) < 1e-9) & (side == side[k]))[0]
        assert np.abs(ring[partner] - ring[k] * (-1, 1, 1)).max() < 0.006


def test_the_energy_is_the_training_energy_plus_contact_with_a_true_gradient():
    pattern, body, settings = sewn("skirt", "a_line_skirt"), rest_body("skirt"), DrapeSettings()
    cloth = cloth_rest(pattern.faces, pattern.corner_xy, len(pattern.vertex_xy), settings.fabric)
    evaluate = energy_function(pattern, cloth, body, settings)
    x = wrapped_start(pattern, body) + 0.005 * pattern.vertex_side[:, None] * (0, 0, 1)  # sheets apart
    position = torch.from_numpy(x)
    terms = membrane_energy(position, cloth, settings.fabric) + bending_energy(
        position, cloth, settings.fabric
    )
    expected = (terms + gravity_energy(position, cloth)).item()
    assert evaluate(x)[0] == pytest.approx(expected, rel=1e-12)
    deep = x - 0.015 * pattern.vertex_side[:, None] * (0, 0, 1)  # within the margin
    energy, gradient = evaluate(deep)
    elastic = membrane_energy(torch.from_numpy(deep), cloth, settings.fabric).item()
    assert energy > elastic + 0.001
    rng, h = np.random.default_rng(0), 1e-7
    for _ in range(5):
        direction = rng.normal(size=x.shape)
        slope = (evaluate(deep + h * direction)[0] - evaluate(deep - h * direction)[0]) / (2 * h)
        assert slope == pytest.approx((gradient * direction).sum(), rel=1e-3, abs=1e-4)


def test_a_draped_skirt_is_at_rest_on_the_body(skirt):
    pattern, rest = skirt
    body, m = rest_body("skirt"), rest.metrics
    assert m["residual"] < 0.5
    assert m["speed"] < 0.02
    assert m["strain_mean"] < 0.03
    assert m["strain_max"] < 0.4
    assert m["clearance"] > 0.003
    assert m["body_intersects"] == m["self_intersects"] == 0
    assert np.allclose(rest.vertices[pattern.anchors], waist_targets(pattern, body), atol=1e-4)
    settings = DrapeSettings()
    cloth = cloth_rest(pattern.faces, pattern.corner_xy, len(rest.vertices), settings.fabric)
    evaluate = energy_function(pattern, cloth, body, settings)
    assert evaluate(rest.vertices)[0] < evaluate(wrapped_start(pattern, body))[0]


def test_draping_is_deterministic(skirt):
    pattern, rest = skirt
    again = drape_to_rest(pattern, rest_body("skirt"))
    assert np.array_equal(again.vertices, rest.vertices)
    assert again.metrics == rest.metrics


def test_intersections_are_seen(skirt):
    pattern, rest = skirt
    body = rest_body("skirt")
    assert not intersects(rest.vertices, pattern.faces, body)
    assert intersects(np.add(rest.vertices, (0.0, 0.0, 0.02)), pattern.faces, body)
    folded = rest.vertices.copy()
    folded[pattern.faces[40]] -= [0.0, 0.0, 0.5]
    assert intersects(folded, pattern.faces)
