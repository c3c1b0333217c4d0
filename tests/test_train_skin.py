"""Training of the skin field: its target, its samples, and that the errors fall."""

from pathlib import Path

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.bundle import SkinBundle
from isp_assets.networks.skin_field import SkinFieldConfig
from isp_assets.train.loop import RunOptions
from isp_assets.train.skin import Diffusion, Samples, SkinTask, rest_poses_of_categories, train_skin

QUICK = Diffusion(samples=4000)


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load()


@pytest.fixture(scope="module")
def task(body: Body) -> SkinTask:
    return SkinTask(body, SkinFieldConfig(num_vertices=len(body.template), width=32), QUICK)


def test_target_is_local_on_the_skin_and_shared_far_away(task: SkinTask, body: Body) -> None:
    knee = int((body.template - torch.tensor([0.13, -0.65, 0.1])).norm(dim=1).argmin())
    middle = torch.tensor([0.0, -0.7, 0.35])
    points = torch.stack([body.template[knee], middle])
    weights = task.target(Samples(points, torch.tensor([0.025, 0.35])), rest=0)
    left = body.template[:, 0] > 0
    assert weights[0, left].sum() > 0.99
    assert abs(float(weights[1, left].sum()) - 0.5) < 0.02
    assert torch.allclose(weights.sum(1), torch.ones(2))


def test_samples_lie_where_they_were_asked_for(task: SkinTask) -> None:
    samples = task.pools[0]
    assert samples.width.min() >= QUICK.base
    assert samples.width.max() <= np.hypot(QUICK.base, QUICK.growth * QUICK.reach) + 1e-4
    assert (samples.width > 0.2).float().mean() > 0.02


def test_trained_field_is_saved_and_better_than_an_untrained_one(
    task: SkinTask, body: Body, tmp_path: Path
) -> None:
    before = task.measure()
    report = train_skin(
        tmp_path, RunOptions(steps=150), body=body, rest_poses=[np.zeros((24, 3))], diffusion=QUICK,
        config=SkinFieldConfig(num_vertices=1, width=32),
    )  # fmt: skip
    assert report.metrics["joint_weight_error_mean"] < 0.5 * before["joint_weight_error_mean"]
    bundle = SkinBundle.load(tmp_path / "skin.safetensors")
    assert bundle.body_sha256 == body.sha256
    points = body.template[::500] + 0.02
    assert torch.allclose(bundle.skin_field(points).sum(-1), torch.ones(len(points)), atol=1e-5)


def test_field_with_a_head_trains_on_cross_entropy(body: Body) -> None:
    config = SkinFieldConfig(num_vertices=len(body.template), kernel=False, rank=8, width=16, depth=2)
    task = SkinTask(body, config, QUICK)
    terms = task.losses(torch.Generator().manual_seed(0), 0.0)
    assert set(terms) == {"entropy"}
    terms["entropy"].backward()
    assert task.module.head.weight.grad.norm() > 0


def test_categories_have_two_rest_poses_the_t_pose_first() -> None:
    first, second = rest_poses_of_categories()
    assert not first.any()
    assert np.degrees(second[1, 2]) == pytest.approx(18)
    assert second[2, 2] == -second[1, 2]
