"""Sewing by labels: seams match, the result is an oriented surface, its border the free edges."""

import numpy as np
import pytest
from analytic_panels import JACKET_FRONT, SHIRT, SHIRT_SEAMS, SKIRT, SKIRT_SEAMS

from isp_assets.errors import GeometryError
from isp_assets.geometry import sewing
from isp_assets.geometry.edge_runs import EdgeRun
from isp_assets.geometry.sewing import FlatPanel, FlatSeam, SewnPanels, sew_panels
from isp_assets.geometry.topology import boundary_loops, edges


def _runs(*loops):
    return [tuple(EdgeRun(label, np.array(points, float)) for label, points in loop) for loop in loops]


def _sew(front, back, seams, spacing=0.05, sliver=0.06) -> SewnPanels:
    return sew_panels({"front": front, "back": back}, seams, spacing=spacing, sliver=sliver)


def _check_surface(sewn: SewnPanels, num_loops: int) -> None:
    """Oriented, manifold, border = free edges, seams welded point by point."""
    faces = sewn.faces
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed), "two faces run along an edge alike"
    assert edges(faces).num_faces.max() == 2
    assert set(faces.reshape(-1)) == set(range(sewn.num_vertices))
    loops = boundary_loops(faces)
    assert len(loops) == num_loops
    sewn_points = {side: set() for side in sewn.panels}
    for seam in sewn.seams:
        for side, index in (("front", seam.front), ("back", seam.back)):
            sewn_points[side] |= set(zip(index[:-1].tolist(), index[1:].tolist(), strict=True))
        front, back = (
            sewn.panels[s].vertex_index[i] for s, i in (("front", seam.front), ("back", seam.back))
        )
        np.testing.assert_array_equal(front, back)
    free = sum(
        (a, b) not in sewn_points[side]
        for side, panel in sewn.panels.items()
        for _, run in panel.runs
        for a, b in zip(run[:-1].tolist(), run[1:].tolist(), strict=True)
    )
    assert sum(map(len, loops)) == free
    for side, sign in (("front", 1), ("back", -1)):
        panel = sewn.panels[side]
        a, b, c = (panel.points[panel.faces[:, k]] for k in range(3))
        area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (sign * area > 0).all()


def test_a_corner_that_joins_two_points_of_one_panel_is_refused_where_they_have_a_common_neighbour():
    """Edges to that neighbour become one edge with four faces, though its other end is on no seam."""
    angle = 2 * np.pi * np.arange(4) / 4
    wheel = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], axis=1), np.zeros((1, 2))])
    spokes = np.array([[4, 1, 0], [4, 2, 1], [4, 3, 2], [4, 0, 3]])
    label = np.array([1, 1, 1, 1, 0])

    def sewn(joined: int) -> SewnPanels:
        """The front's first point sewn to the back's point 0, and to another."""
        vertex = np.array([0, 3, 4, 5, 6])
        vertex[joined] = 0
        front = FlatPanel(wheel[:3], np.array([[0, 1, 2]]), np.arange(3), label[:3], ())
        back = FlatPanel(wheel, spokes, vertex, label, ())
        seams = [FlatSeam((1, 1), np.array([0]), np.array([k])) for k in sorted({0, joined})]
        return SewnPanels({"front": front, "back": back}, tuple(seams), 7, 1.0)

    sewing._check_surface(sewn(0))
    with pytest.raises(GeometryError, match="no surface: 1 edges"):
        sewing._check_surface(sewn(2))


@pytest.mark.parametrize("spacing", [0.2, 0.07, 0.031])
def test_a_skirt_has_two_openings(spacing):
    _check_surface(_sew(_runs(SKIRT), _runs(SKIRT), SKIRT_SEAMS, spacing), 2)


@pytest.mark.parametrize("spacing", [0.25, 0.1, 0.04])
def test_a_shirt_has_four_openings(spacing):
    _check_surface(_sew(_runs(SHIRT), _runs(SHIRT), SHIRT_SEAMS, spacing), 4)


@pytest.mark.parametrize("spacing", [0.1, 0.04])
def test_a_jacket_of_three_pieces_has_three_openings(spacing):
    _check_surface(_sew(_runs(*JACKET_FRONT), _runs(SHIRT), SHIRT_SEAMS, spacing), 3)


def test_without_seams_the_panels_stay_apart():
    sewn = _sew(_runs(SKIRT), _runs(SKIRT), ())
    assert len(boundary_loops(sewn.faces)) == 2
    assert sewn.num_vertices == sum(len(panel.points) for panel in sewn.panels.values())


def test_sides_of_unlike_length_get_equally_many_points():
    longer = [
        (2, [(0.6, -0.7), (0.75, 0.0), (0.3, 0.6)]) if label == 2 else (label, pts) for label, pts in SKIRT
    ]
    sewn = _sew(_runs(longer), _runs(SKIRT), SKIRT_SEAMS)
    _check_surface(sewn, 2)
    seam = next(s for s in sewn.seams if s.labels == (2, 2))
    steps = [
        np.linalg.norm(np.diff(sewn.panels[side].points[index], axis=0), axis=1).mean()
        for side, index in (("front", seam.front), ("back", seam.back))
    ]
    assert steps[0] / steps[1] == pytest.approx(
        (np.hypot(0.15, 0.7) + np.hypot(0.45, 0.6)) / np.hypot(0.3, 1.3), rel=0.02
    )


def test_corners_of_a_seam_meet_whichever_edge_the_loop_begins_with():
    for turn in range(4):
        turned = SKIRT[turn:] + SKIRT[:turn]
        _check_surface(_sew(_runs(turned), _runs(SKIRT), SKIRT_SEAMS), 2)


def test_labels_may_differ_between_the_sides_of_a_seam():
    renamed = [({2: 7, 4: 8}.get(label, label), points) for label, points in SKIRT]
    sewn = _sew(_runs(SKIRT), _runs(renamed), ((2, 7), (4, 8)))
    _check_surface(sewn, 2)
    assert [seam.labels for seam in sewn.seams] == [(2, 7), (4, 8)]


def test_a_seam_that_neither_side_has_stays_open():
    _check_surface(_sew(_runs(SKIRT), _runs(SKIRT), (*SKIRT_SEAMS, (9, 9))), 2)


def _with_sliver(length: float):
    """A skirt whose left side ends in a short edge of label 9."""
    cut = (0.6 - 0.3 * (1 - length), -0.7 + 1.3 * (1 - length))
    return [SKIRT[0], (2, [(0.6, -0.7), cut]), (9, [cut, (0.3, 0.6)]), *SKIRT[2:]]


def test_a_sliver_without_a_partner_joins_its_neighbour():
    sewn = _sew(_runs(_with_sliver(0.03)), _runs(SKIRT), (*SKIRT_SEAMS, (9, 9)))
    _check_surface(sewn, 2)
    assert 9 not in sewn.panels["front"].border_label
    assert len(sewn.seams) == 2


@pytest.mark.parametrize("front_is_split", [True, False])
def test_panels_that_differ_only_in_a_label_agree(front_is_split):
    """The other outline runs alongside and calls the whole side 2: so does the panel that split it."""
    panels = [_runs(_with_sliver(0.4)), _runs(SKIRT)]
    sewn = _sew(*(panels if front_is_split else panels[::-1]), (*SKIRT_SEAMS, (9, 9)))
    _check_surface(sewn, 2)
    assert len(sewn.seams) == 2


def test_agreement_crosses_to_the_other_panels_names():
    """A stretch that the back calls 7 is one that the front calls 2, if 2 and 7 are sewn."""
    renamed = [({2: 7, 4: 8}.get(label, label), points) for label, points in SKIRT]
    _check_surface(_sew(_runs(_with_sliver(0.4)), _runs(renamed), ((2, 7), (4, 8), (9, 9))), 2)


def test_an_edge_without_a_partner_is_an_error():
    """A sleeve on one side only: no outline runs along it."""
    sleeve = [(0.6, -0.7), (0.7, -0.2)], [(0.7, -0.2), (0.9, 0.5)], [(0.9, 0.5), (0.3, 0.6)]
    sleeved = [SKIRT[0], (2, sleeve[0]), (9, sleeve[1]), (5, sleeve[2]), *SKIRT[2:]]
    message = r"seam \(9, 9\): the {} panel has an edge of length 0\.728 that finds no partner"
    for side, panels in (("front", (sleeved, SKIRT)), ("back", (SKIRT, sleeved))):
        with pytest.raises(GeometryError, match=message.format(side)):
            _sew(*map(_runs, panels), (*SKIRT_SEAMS, (9, 9)))


def test_a_whole_outline_cannot_be_sewn():
    disc = _runs([(1, [(0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5), (0.5, 0)])])
    with pytest.raises(GeometryError, match="no corner to begin at"):
        _sew(disc, disc, ((1, 1),))


def test_a_crossing_outline_is_an_error():
    bow = _runs([(1, [(-0.5, -0.5), (0.5, 0.5)]), (2, [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)])])
    with pytest.raises(GeometryError, match="cross"):
        _sew(bow, bow, ())


def test_runs_of_one_label_pair_by_place():
    """Two separate edges of one label on each side find the nearer partner, in whatever order they come."""
    both = [(label if label != 4 else 2, points) for label, points in SKIRT]
    sewn = _sew(_runs(both), _runs(both[2:] + both[:2]), ((2, 2),))
    _check_surface(sewn, 2)
    for seam in sewn.seams:
        xy = [sewn.panels[side].points[i] for side, i in (("front", seam.front), ("back", seam.back))]
        np.testing.assert_allclose(*xy, atol=1e-12)


def test_an_opening_in_one_panel_only_stays_open():
    """Front: two seams meet in a point. Back: a free edge lies between them, and bounds a hole."""
    cut_a, cut_b = (0.5, -0.7 + 1.3 / 3), (0.4, -0.7 + 2.6 / 3)
    middle = (0.45, -0.05)
    front = [SKIRT[0], (2, [(0.6, -0.7), middle]), (5, [middle, (0.3, 0.6)]), *SKIRT[2:]]
    back = [SKIRT[0], (2, [(0.6, -0.7), cut_a]), (6, [cut_a, cut_b]), (5, [cut_b, (0.3, 0.6)]), *SKIRT[2:]]
    for spacing in (0.3, 0.1, 0.03):
        sewn = _sew(_runs(front), _runs(back), ((2, 2), (5, 5), (4, 4)), spacing)
        assert edges(sewn.faces).num_faces.max() == 2
        assert not (sewn.faces == np.roll(sewn.faces, 1, axis=1)).any()
        # With two edges the hole's sides fall onto one another and close it.
        num_edges = len(next(run for label, run in sewn.panels["back"].runs if label == 6)) - 1
        assert len(boundary_loops(sewn.faces)) == (2 if num_edges == 2 else 3)


def test_a_sleeve_narrower_than_two_triangles_keeps_its_sides_apart():
    """Chords across it lie in both panels; uncut, their copies would fuse to edges with four faces."""
    strip = [
        (1, [(-0.8, -0.03), (0.8, -0.03)]),
        (2, [(0.8, -0.03), (0.8, 0.03)]),
        (3, [(0.8, 0.03), (-0.8, 0.03)]),
        (4, [(-0.8, 0.03), (-0.8, -0.03)]),
    ]
    _check_surface(_sew(_runs(strip), _runs(strip), ((1, 1), (3, 3)), spacing=0.06), 2)


def test_border_labels_and_corners():
    sewn = _sew(_runs(SKIRT), _runs(SKIRT), SKIRT_SEAMS)
    for panel in sewn.panels.values():
        for label, run in panel.runs:
            assert (panel.border_label[run[:-1]] == label).all()
        corner = np.linalg.norm(panel.points - np.array([0.6, -0.7]), axis=1).argmin()
        assert panel.border_label[corner] == 2, "a corner carries the label of the edge it starts"
        np.testing.assert_allclose(panel.points[corner], [0.6, -0.7])
        num_border = sum(len(run) - 1 for _, run in panel.runs)
        assert (panel.border_label[:num_border] > 0).all()
        assert (panel.border_label[num_border:] == 0).all()


def test_mirrored_panels_give_a_mirrored_mesh():
    sewn = _sew(_runs(SHIRT), _runs(SHIRT), SHIRT_SEAMS, 0.06)
    points = sewn.panels["front"].points
    flipped = points * (-1, 1)
    nearest = np.linalg.norm(points[:, None] - flipped[None], axis=-1).min(axis=0)
    assert nearest.max() < 1e-9
