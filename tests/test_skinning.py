"""Binding and skinning: the fold is exact, rest poses are reproduced, a garment on the skin moves with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.errors import DrapeError
from isp_assets.garment import Garment
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.skinning import bind, shape_garment, skin_garment
from isp_assets.synthetic import synthetic_garment

SPREAD = np.zeros((24, 3))
SPREAD[1, 2], SPREAD[2, 2] = 0.3, -0.3
BENT = SPREAD.copy()
BENT[4, 0] = 0.2


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load()


@pytest.fixture(scope="module")
def skin(body: Body) -> SkinField:
    torch.manual_seed(0)
    poses = (np.zeros((24, 3)), SPREAD)
    config = SkinFieldConfig(
        num_vertices=len(body.template),
        rest_poses=tuple(tuple(p.reshape(-1).tolist()) for p in poses),
        rank=4,
    )
    field = SkinField(config)
    field.place_on(body.pose(torch.tensor(np.stack(poses))).vertices, torch.ones(len(body.template)))
    torch.nn.init.normal_(field.head.weight, 0.0, 0.1)
    return field


def _garment(rest_pose: np.ndarray | None = None) -> Garment:
    pose = np.zeros((24, 3)) if rest_pose is None else rest_pose
    return replace(synthetic_garment("tube", radius=0.25), rest_pose=pose)


def _motion(frames: int = 3) -> torch.Tensor:
    return 0.3 * torch.randn(frames, 24, 3, generator=torch.Generator().manual_seed(1))


def test_fold_equals_skinning_with_all_body_vertices(body: Body, skin: SkinField) -> None:
    garment = _garment()
    poses, betas = _motion(), torch.tensor([1.5, -1.0, 2.0])
    posed = body.pose(poses, betas=betas)
    bound = bind(garment, body, skin)
    vertices, linear = skin_garment(bound, posed, betas)
    with torch.no_grad():  # Eq. 6 as it is written, with w(v) of shape [V, N_B]
        w = skin(torch.tensor(garment.rest_vertices, dtype=torch.float32))
    offsets = body.shape_dirs[..., :3] @ betas + (body.pose_dirs @ posed.pose_feature.T).permute(2, 0, 1)
    v = bound.canonical + w @ offsets
    transform = torch.einsum("vn,nk,tkij->tvij", w, body.weights, posed.joint_transforms)
    expected = torch.einsum("tvij,tvj->tvi", transform[..., :3, :3], v) + transform[..., :3, 3]
    assert (vertices - expected).abs().max() < 1e-5
    assert (linear - transform[..., :3, :3]).abs().max() < 1e-5


@pytest.mark.parametrize("rest_pose", [np.zeros((24, 3)), SPREAD, BENT], ids=["T", "known", "unknown"])
def test_rest_pose_is_reproduced(body: Body, skin: SkinField, rest_pose: np.ndarray) -> None:
    garment = _garment(rest_pose)
    posed = body.pose(torch.tensor(rest_pose[None]))
    vertices, _ = skin_garment(bind(garment, body, skin), posed)
    assert (vertices[0] - torch.tensor(garment.rest_vertices)).abs().max() < 2e-6


def test_unknown_rest_pose_agrees_with_the_field_in_its_first_pose(body: Body, skin: SkinField) -> None:
    bound = bind(_garment(BENT), body, skin)
    posed = body.pose(torch.zeros(1, 24, 3))
    with torch.no_grad():
        weights = skin(skin_garment(bound, posed)[0][0]) @ body.weights
    assert (weights - bound.joint_weights).abs().max() < 2e-3


def test_weights_sum_to_one_and_are_positive(body: Body, skin: SkinField) -> None:
    weights = bind(_garment(), body, skin).joint_weights
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-5)
    assert weights.min() >= 0


def test_root_rotation_turns_the_garment_rigidly(body: Body, skin: SkinField) -> None:
    bound = bind(_garment(), body, skin)
    poses = _motion(2)
    poses[1] = poses[0]
    poses[:, 0] = torch.tensor([[0.0, 0, 0], [0, 1.2, 0]])
    posed = body.pose(poses)
    vertices, linear = skin_garment(bound, posed)
    turn = axis_angle_to_matrix(poses[1, 0])
    pelvis = posed.joints[:, :1]
    assert torch.allclose((vertices[0] - pelvis[0]) @ turn.T, vertices[1] - pelvis[1], atol=1e-5)
    assert torch.allclose(turn @ linear[0], linear[1], atol=1e-5)


def test_betas_per_frame_equal_betas_one_by_one(body: Body, skin: SkinField) -> None:
    bound = bind(_garment(), body, skin)
    betas = torch.tensor([[1.0, 0.0], [0.0, -2.0]])
    posed = body.pose(_motion(2), betas=betas)
    both, _ = skin_garment(bound, posed, betas)
    for frame in range(2):
        alone = body.pose(_motion(2)[frame : frame + 1], betas=betas[frame])
        assert torch.allclose(skin_garment(bound, alone, betas[frame])[0][0], both[frame], atol=1e-5)
    assert torch.equal(shape_garment(bound, None), bound.canonical)
    assert torch.allclose(shape_garment(bound, betas)[1], shape_garment(bound, betas[1]), atol=1e-6)


def test_wrong_body_is_refused(body: Body) -> None:
    field = SkinField(SkinFieldConfig(num_vertices=100))
    with pytest.raises(DrapeError, match="100 vertices"):
        bind(_garment(), body, field)
