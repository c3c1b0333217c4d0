"""Patterns: curves, seams that match, closed and simple outlines, coverage of the body."""

import numpy as np
import pytest
from rest_bodies import maker, rest_body

from isp_assets.conventions import PANELS
from isp_assets.errors import GarmentError
from isp_assets.geometry.topology import boundary_loops
from isp_assets.train.garment_maker import CATEGORIES
from isp_assets.train.pattern import (
    Pattern,
    PatternEdge,
    bezier,
    mirrored,
    outline_samples,
    resample,
    sew,
    smooth_curve,
)

SQUARE = np.array([(0.0, 0.0), (0.2, 0.0), (0.2, 0.2), (0.0, 0.2)])


def square_panel(scale=1.0):
    corners = SQUARE * scale
    edges = [PatternEdge(k + 1, np.array([corners[k], corners[(k + 1) % 4]])) for k in range(4)]
    return (tuple(edges),)


def drawings():
    for category in CATEGORIES.values():
        rng = np.random.default_rng(7)
        for name, parameters in [
            *category.presets.items(),
            *((f"random{k}", category.sample(rng)) for k in range(4)),
        ]:
            yield pytest.param(category, parameters, id=f"{category.name}-{name}")


def test_resample_is_even_and_keeps_the_ends():
    curve = bezier((0, 0), (0.1, 0.3), (0.4, 0.1), 200)
    steps = np.linalg.norm(np.diff(resample(curve, 0.02), axis=0), axis=1)
    assert steps == pytest.approx(steps.mean(), rel=0.01)
    assert steps.mean() == pytest.approx(0.02, rel=0.05)
    assert np.array_equal(resample(curve, 0.02)[[0, -1]], curve[[0, -1]])
    assert len(resample(curve, 10.0)) == 2


def test_smooth_curve_passes_its_points_without_overshoot():
    points = np.array([(0.0, 0.0), (0.0, 0.1), (0.1, 0.2), (0.1, 0.4)])
    curve = smooth_curve(points, 301)
    for point in points:
        assert np.linalg.norm(curve - point, axis=1).min() < 1e-3
    assert curve[:, 0].min() >= 0
    assert curve[:, 0].max() <= 0.1 + 1e-12


def test_mirrored_twice_is_the_curve():
    curve = smooth_curve([(0.1, 0.0), (0.2, 0.1), (0.1, 0.3)])
    assert np.array_equal(mirrored(mirrored(curve)), curve)
    assert np.array_equal(mirrored(curve)[0], curve[-1] * (-1, 1))


def test_sewing_two_squares_on_two_sides_makes_a_tube():
    panels = {side: square_panel() for side in PANELS}
    tube = sew(Pattern(panels=panels, seam_pairs=((2, 2), (4, 4)), anchor_labels=(3,)), 0.02)
    lower, upper = boundary_loops(tube.faces)
    assert len(lower) == len(upper) == 20
    assert set(tube.anchors.tolist()) == set(upper.tolist())
    v, f = len(tube.vertex_xy), len(tube.faces)
    e = len({tuple(sorted(p)) for t in tube.faces.tolist() for p in zip(t, t[1:] + t[:1], strict=True)})
    assert v - e + f == 0
    assert (tube.vertex_side == 0).sum() == 2 * 11
    front, back = tube.twins.T
    assert np.array_equal(tube.vertex_xy[front], tube.vertex_xy[back])
    assert (tube.vertex_side[front] == 1).all()
    assert (tube.vertex_side[back] == -1).all()


def test_seams_with_different_curves_are_refused():
    pattern = Pattern(panels={"front": square_panel(), "back": square_panel(1.5)}, seam_pairs=((1, 1),))
    with pytest.raises(GarmentError, match=r"seam \(1, 1\): the two sides have different curves"):
        sew(pattern, 0.02)


def test_open_outlines_are_refused():
    edges = square_panel()[0][:3]
    with pytest.raises(GarmentError, match="not closed"):
        sew(Pattern(panels=dict.fromkeys(PANELS, (edges,)), seam_pairs=((1, 1),)), 0.02)


def test_outline_samples_carry_the_label_of_the_edge_they_start():
    xy, label, loop = outline_samples(square_panel(), 0.05)
    assert len(xy) == 16
    assert label.tolist() == [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4
    assert not loop.any()
    assert np.array_equal(xy[::4], SQUARE)


@pytest.mark.parametrize(("category", "parameters"), drawings())
def test_garments_are_sewn_surfaces_within_the_panel(category, parameters):
    body, standing = rest_body(category.name), rest_body("top").landmarks
    pattern = category.draw(body, standing, parameters)
    sewn = sew(pattern, 0.022)
    reach = np.abs((sewn.vertex_xy - maker().panel_center(category.name)) / category.panel_scale)
    assert reach.max() <= 0.95
    assert (sewn.vertex_side == 0).any()
    is_open = len(pattern.panels["front"]) == 2
    holes = {"trousers": 3, "skirt": 2}.get(category.name, 3 if is_open else 4)
    assert len(boundary_loops(sewn.faces)) == holes
    # The whole outline mirrors in x, with the labels of the other side.
    for side in PANELS:
        xy, label, _ = outline_samples(pattern.panels[side], 0.01)
        names = category.edge_names
        other = {k: next(j for j, n in names.items() if n == exchange(names[k])) for k in names}
        for k in set(label.tolist()):
            here, there = xy[label == k] * (-1, 1), xy[label == other[k]]
            nearest = np.linalg.norm(here[:, None] - there, axis=-1).min(axis=1)
            assert nearest.max() < 0.011


def exchange(name: str) -> str:
    return name.replace("right", "LEFT").replace("left", "right").replace("LEFT", "left")


@pytest.mark.parametrize("category", CATEGORIES)
def test_landmarks_are_in_the_order_of_a_body(category):
    lm = rest_body(category).landmarks
    heights = [lm.bottom_y, *(xy[1] for xy in lm.leg_xy[::-1]), lm.crotch_y, lm.hip_y, lm.waist_y]
    heights += [lm.armpit_y, lm.arm_y, lm.neck_y, lm.top_y]
    assert heights == sorted(heights)
    assert lm.neck_x < lm.waist_x < lm.hip_x
    assert lm.arm_girth[0] > lm.arm_girth[1] > lm.arm_girth[2]
    assert lm.leg_girth[0] > lm.leg_girth[1] > lm.leg_girth[2]
    assert 0.6 < lm.waist_girth < lm.hip_girth < 1.3
