"""The body's forward pass is SMPL's, differentiable, and loads from any SMPL file."""

from importlib.resources import files

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_smpl import pose_reference, tiny_smpl_arrays

from isp_assets.body import BETA_PRESETS, Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.errors import BodyError
from isp_assets.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def body():
    return Body.load().to(dtype=torch.float64)


@pytest.fixture
def tiny(tmp_path):
    np.savez(tmp_path / "tiny.npz", **tiny_smpl_arrays())
    return Body.load(tmp_path / "tiny.npz").to(dtype=torch.float64)


@pytest.fixture
def no_annotation_checks():
    """Outside of tests annotations are not checked: wrong shapes must then give our own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def random_poses(frames, scale=0.5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(frames, 24, 3, dtype=torch.float64, generator=generator)


def enclosed_volume(vertices, faces):
    a, b, c = vertices[faces].unbind(1)
    return (a * torch.linalg.cross(b, c)).sum() / 6


def test_forward_equals_the_reference(body):
    poses = random_poses(3)
    betas = torch.linspace(-2, 2, 10, dtype=torch.float64)
    translation = torch.tensor([[0.1, 1.0, -2.0]], dtype=torch.float64).expand(3, -1)
    posed = body.pose(poses, betas=betas, translation=translation)
    for frame in range(3):
        pose = poses[frame].numpy()
        vertices, joints = pose_reference(body, pose, betas.tolist(), translation[frame].numpy())
        np.testing.assert_allclose(posed.vertices[frame], vertices, atol=1e-12)
        np.testing.assert_allclose(posed.joints[frame], joints, atol=1e-12)


def test_single_precision_stays_within_a_micrometre_or_two(body):
    poses, translation = random_poses(4), torch.ones(4, 3, dtype=torch.float64)
    single = Body.load().pose(poses.float(), translation=translation.float())
    double = body.pose(poses, translation=translation)
    torch.testing.assert_close(single.vertices.double(), double.vertices, rtol=0, atol=3e-6)


def test_zero_pose_is_the_shaped_template(body):
    betas = torch.randn(10, dtype=torch.float64)
    posed = body.pose(torch.zeros(1, 24, 3, dtype=torch.float64), betas=betas)
    torch.testing.assert_close(posed.vertices[0], body.shaped(betas))
    torch.testing.assert_close(posed.joints[0], body.joint_regressor @ body.shaped(betas))
    assert not posed.pose_feature.any()


def test_skinning_transforms_rebuild_the_vertices(body):
    poses, translation = random_poses(2), torch.randn(2, 3, dtype=torch.float64)
    betas = torch.randn(2, 10, dtype=torch.float64)
    posed = body.pose(poses, betas=betas, translation=translation)
    rest = body.shaped(betas) + torch.einsum("nck,tk->tnc", body.pose_dirs, posed.pose_feature)
    homogeneous = torch.cat([rest, torch.ones_like(rest[..., :1])], -1)
    rebuilt = torch.einsum("nk,tkij,tnj->tni", body.weights, posed.joint_transforms, homogeneous)
    torch.testing.assert_close(rebuilt[..., :3], posed.vertices)
    torch.testing.assert_close(rebuilt[..., 3], torch.ones_like(rebuilt[..., 3]), rtol=0, atol=1e-6)


def test_pose_feature_is_row_major_rotation_minus_identity(body):
    poses = random_poses(1)
    feature = body.pose(poses).pose_feature.reshape(1, 23, 3, 3)
    torch.testing.assert_close(
        feature + torch.eye(3, dtype=torch.float64), axis_angle_to_matrix(poses[:, 1:])
    )


def test_root_rotation_and_translation_move_the_body_rigidly(body):
    poses, root = random_poses(1), torch.tensor([[0.3, -1.1, 0.4]], dtype=torch.float64)
    poses[:, 0] = 0
    still = body.pose(poses)
    poses[:, 0] = root
    moved = body.pose(poses, translation=torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    turn, pelvis = axis_angle_to_matrix(root)[0], still.joints[:, :1]
    expected = (
        (still.vertices - pelvis) @ turn.T + pelvis + torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    )
    torch.testing.assert_close(moved.vertices, expected)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.1, 4.0))
def test_bones_keep_their_length(body, seed, scale):
    betas = torch.tensor(BETA_PRESETS["woman"], dtype=torch.float64)
    posed = body.pose(random_poses(1, scale, seed), betas=betas)
    rest = body.joint_regressor @ body.shaped(betas)
    parents = list(body.parents[1:])
    lengths = (posed.joints[0, 1:] - posed.joints[0, parents]).norm(dim=-1)
    torch.testing.assert_close(lengths, (rest[1:] - rest[parents]).norm(dim=-1))


def test_frames_do_not_depend_on_their_batch(body):
    poses, betas = random_poses(5), torch.randn(5, 10, dtype=torch.float64)
    together = body.pose(poses, betas=betas)
    for frame in range(5):
        alone = body.pose(poses[frame : frame + 1], betas=betas[frame])
        torch.testing.assert_close(alone.vertices[0], together.vertices[frame])


def test_short_betas_are_padded_with_zeros(body):
    short = torch.tensor([1.0, -0.5], dtype=torch.float64)
    padded = torch.cat([short, torch.zeros(8, dtype=torch.float64)])
    torch.testing.assert_close(body.shaped(short), body.shaped(padded))


def test_gradcheck(tiny):
    poses = random_poses(2).requires_grad_()
    betas = torch.randn(2, 4, dtype=torch.float64, requires_grad=True)
    translation = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)

    def forward(poses, betas, translation):
        posed = tiny.pose(poses, betas=betas, translation=translation)
        return posed.vertices[:, ::7], posed.joints, posed.joint_transforms, posed.pose_feature

    assert torch.autograd.gradcheck(forward, (poses, betas, translation), fast_mode=True)


def test_every_joint_and_beta_moves_the_skin(body):
    """Also at the zero pose, where a careless rotation formula has no gradient."""
    poses = torch.zeros(1, 24, 3, dtype=torch.float64, requires_grad=True)
    betas = torch.zeros(10, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(1, body.template.shape[0], 3, dtype=torch.float64)
    (body.pose(poses, betas=betas).vertices * weight).sum().backward()
    assert torch.isfinite(poses.grad).all()
    assert (poses.grad.norm(dim=-1) > 1e-3).all()
    assert (betas.grad.abs() > 1e-3).all()


def test_default_body_is_a_closed_surface(body):
    faces = body.faces.numpy()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges), "an edge is used twice in one direction"
    assert all((b, a) in directed for a, b in directed), "the surface has a border or is inside out somewhere"
    assert len(body.template) - len(edges) // 2 + len(faces) == 2, "Euler number of a sphere"
    assert 0.060 < enclosed_volume(body.template, body.faces) < 0.075, "outward faces enclose about 67 litres"


@pytest.mark.parametrize(("preset", "stature"), [("man", 1.769), ("woman", 1.63), ("neutral", 1.693)])
def test_presets_have_their_stature(body, preset, stature):
    height = body.shaped(torch.tensor(BETA_PRESETS[preset], dtype=torch.float64))[:, 1]
    assert float(height.max() - height.min()) == pytest.approx(stature, abs=0.006)


def test_mirrored_pose_gives_the_mirrored_body(body):
    with np.load(files("isp_assets") / "data" / "default_body.npz") as data:
        partner = torch.from_numpy(data["mirror"].astype(np.int64))
    other = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in JOINT_NAMES]
    swap = [JOINT_NAMES.index(other.get(side, side) + rest + name) for side, rest, name in sides]
    poses = random_poses(2, scale=0.3)
    mirrored = poses[:, swap] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    expected = body.pose(poses).vertices[:, partner] * flip
    error = (body.pose(mirrored).vertices - expected).norm(dim=-1).amax(0)
    # Where the limit of four weights falls between a left and a right joint, a midline vertex loses one.
    assert (error > 1e-5).sum() <= 10
    assert error.max() < 3e-3


def test_left_is_positive_x_and_the_face_looks_along_z(body):
    joints = body.joint_regressor @ body.template
    assert joints[JOINT_NAMES.index("left_wrist"), 0] > 0.4
    toes, ankle = joints[JOINT_NAMES.index("left_foot")], joints[JOINT_NAMES.index("left_ankle")]
    assert toes[2] - ankle[2] > 0.05
    assert joints[JOINT_NAMES.index("head"), 1] > joints[0, 1]


def test_digest_belongs_to_the_numbers_not_the_file(tmp_path):
    arrays = tiny_smpl_arrays()
    single = {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in arrays.items()}
    np.savez(tmp_path / "double.npz", **arrays)
    np.savez_compressed(tmp_path / "single.npz", license=np.array("free"), **dict(reversed(single.items())))
    single["weights"][3] = np.roll(single["weights"][3], 1)
    np.savez(tmp_path / "other.npz", **single)
    digests = [Body.load(tmp_path / f"{name}.npz").sha256 for name in ("double", "single", "other")]
    assert digests[0] == digests[1] != digests[2]


def test_to_returns_a_copy_with_floats_converted():
    body = Body.load()
    double = body.to(dtype=torch.float64)
    assert (double.template.dtype, double.faces.dtype) == (torch.float64, torch.int64)
    assert body.template.dtype == torch.float32
    assert double.sha256 == body.sha256


def broken(key, change):
    arrays = tiny_smpl_arrays()
    arrays[key] = change(arrays[key])
    return arrays


def with_value(index, value):
    def change(array):
        array[index] = value
        return array

    return change


BAD_FILES = [
    ("weights", with_value((3, 0), 7.0), "row 3 sums to"),
    ("weights", lambda w: w[:, :23], r"weights: expected shape \[40, 24\], got \[40, 23\]"),
    ("f", with_value((0, 0), 40), r"faces: expected vertex numbers in 0\.\.39, got 0\.\.40"),
    ("v_template", with_value((5, 1), np.nan), "template: holds NaN"),
    ("posedirs", lambda p: p[..., :9], r"pose_dirs: expected shape \[40, 3, 207\], got \[40, 3, 9\]"),
    ("J_regressor", lambda j: j.T, r"joint_regressor: expected shape \[24, 40\], got \[40, 24\]"),
    ("kintree_table", lambda t: np.zeros((2, 52), int), "SMPL-H and SMPL-X bodies are not supported"),
    ("kintree_table", with_value((0, 5), 3), "expected SMPL's joint tree"),
    ("v_template", lambda v: np.array([f"{x}" for x in range(3)] + ["x"]), "v_template: expected numbers"),
]


@pytest.mark.usefixtures("no_annotation_checks")
@pytest.mark.parametrize(("key", "change", "message"), BAD_FILES)
def test_bad_files_are_refused(tmp_path, key, change, message):
    np.savez(tmp_path / "bad.npz", **broken(key, change))
    with pytest.raises(BodyError, match=message):
        Body.load(tmp_path / "bad.npz")


def test_missing_key_lists_what_is_there(tmp_path):
    arrays = tiny_smpl_arrays()
    del arrays["posedirs"]
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(BodyError, match="missing posedirs; found J_regressor, f, kintree_table"):
        Body.load(tmp_path / "bad.npz")


def test_object_arrays_are_refused(tmp_path):
    arrays = tiny_smpl_arrays()
    arrays["f"] = np.array([{}], dtype=object)
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(BodyError, match=r"not a readable \.npz of plain arrays"):
        Body.load(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("name", "content"), [("none.npz", None), ("text.npz", b"hello"), ("model.obj", b"v 0 0 0")]
)
def test_files_of_other_kinds_are_refused(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BodyError, match=name):
        Body.load(tmp_path / name)


@pytest.mark.usefixtures("no_annotation_checks")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"poses": torch.zeros(2, 72)}, r"expected \[T, 24, 3\] axis-angle, got \[2, 72\]"),
        ({"betas": torch.zeros(11)}, "has 10 shape coefficients, got 11"),
        ({"betas": torch.zeros(3, 10)}, r"expected \[K\] or \[2, K\] for 2 frames, got \[3, 10\]"),
        ({"translation": torch.zeros(3)}, r"expected \[2, 3\] for 2 frames, got \[3\]"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    poses = arguments.pop("poses", torch.zeros(2, 24, 3))
    with pytest.raises(BodyError, match=message):
        Body.load().pose(poses, **arguments)
