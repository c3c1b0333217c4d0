"""Smoothing beside seams takes creases away and moves nothing else."""

import numpy as np
import pytest
from collision_shapes import sheet

from isp_assets.bundle import GarmentBundle
from isp_assets.collection import Collection
from isp_assets.decode import SLIVER, cut_panels, decode_garment
from isp_assets.geometry.closest import unit_face_normals
from isp_assets.geometry.seam_fairing import fair_seams
from isp_assets.geometry.sewing import sew_panels

REACH = 0.03


def _seam_distance(vertices: np.ndarray) -> np.ndarray:
    """The seam runs along x = 0; the sheet's border stays."""
    distance = np.abs(vertices[:, 0])
    border = np.abs(vertices[:, [0, 2]]).max(axis=1) > 0.0999
    return np.where(border, np.inf, distance)


def test_what_is_flat_stays_flat_and_what_is_far_stays_in_place() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = sheet(41)
    distance = _seam_distance(vertices)
    flat = fair_seams(vertices, faces, distance, reach=REACH)
    np.testing.assert_allclose(flat, vertices, atol=1e-15)  # a regular grid is its own average
    rough = vertices + rng.normal(0, 1e-3, vertices.shape)
    faired = fair_seams(rough, faces, distance, reach=REACH)
    still = distance >= REACH
    assert np.array_equal(faired[still], rough[still])
    assert (np.abs(faired[~still] - rough[~still]).max(axis=1) > 0).all()


def test_a_crease_is_smoothed_and_a_gentle_curve_is_not_flattened() -> None:
    vertices, faces = sheet(81)
    distance = _seam_distance(vertices)
    ridge, curve = vertices.copy(), vertices.copy()
    ridge[distance == 0, 1] = 5e-4
    curve[:, 1] = 0.1 * np.cos(vertices[:, 0] / 0.1)
    inner = np.isfinite(distance)
    left = fair_seams(ridge, faces, distance, reach=REACH)[inner, 1]
    assert left.max() < 0.5 * 5e-4
    moved = fair_seams(curve, faces, distance, reach=REACH) - curve
    assert np.abs(moved[inner]).max() < 2e-4


def test_it_moves_with_the_scene() -> None:
    rng = np.random.default_rng(1)
    vertices, faces = sheet(31)
    distance = _seam_distance(vertices)
    rough = vertices + rng.normal(0, 1e-3, vertices.shape)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    there = fair_seams(rough @ turn + 0.3, faces, distance, reach=REACH)
    np.testing.assert_allclose(
        there, fair_seams(rough, faces, distance, reach=REACH) @ turn + 0.3, atol=1e-12
    )


@pytest.fixture(scope="module")
def tops() -> GarmentBundle:
    return Collection.load("default").item("tee").bundle


def test_seam_distances_of_a_decoded_garment(tops: GarmentBundle) -> None:
    cut = cut_panels(tops.model, tops.codes["tee"], resolution=64)
    sewn = sew_panels(cut.outlines, tops.model.seam_pairs, spacing=2 / 64, sliver=SLIVER)
    distance = sewn.seam_distance
    panel = sewn.panels["front"]
    for seam in sewn.seams:
        along = panel.vertex_index[seam.front]
        assert (distance[along[1:-1]] == 0).all()
    free = set(panel.border_label[panel.border_label > 0]) - {seam.labels[0] for seam in sewn.seams}
    for label, points in panel.runs:
        if label in free:
            assert np.isinf(distance[panel.vertex_index[points]]).all()
    assert 0 < distance[np.isfinite(distance) & (distance > 0)].min() < 2 / 64


def test_fine_meshes_have_no_crease_along_their_seams(tops: GarmentBundle) -> None:
    """Faces at a seam face as the next ones do, nearly as well as faces elsewhere do."""
    garment = decode_garment(tops.model, tops.codes["tee"], resolution=384)
    normals = unit_face_normals(garment.rest_vertices.astype(float), garment.faces)
    share = np.bincount(np.concatenate([p.vertex_index for p in garment.panels.values()]))
    at_seam = (share[garment.faces] > 1).any(axis=1)
    edge = np.sort(garment.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
    order = np.lexsort(edge.T)
    twin = (edge[order][1:] == edge[order][:-1]).all(axis=1)
    pair = np.stack([order[:-1][twin], order[1:][twin]], axis=1) // 3
    angle = np.degrees(np.arccos(np.einsum("pc,pc->p", *normals[pair.T]).clip(-1, 1)))
    crease = angle[at_seam[pair].any(axis=1)].mean()
    assert crease < 6.0, f"faces along seams turn by {crease:.1f} degrees from one to the next"
