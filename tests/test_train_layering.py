"""Training of D_m: stacks, losses, that it clears contact, and the bundle it writes."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model

from isp_assets.body import Body, PosedBody
from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.errors import TrainError
from isp_assets.geometry.contact import clearance
from isp_assets.geometry.normals import vertex_normals
from isp_assets.layering import correct_layer
from isp_assets.networks.layering_net import LayeringConfig
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.train import wardrobe
from isp_assets.train.layering import LayeringOptions, LayeringTask, train_layering
from isp_assets.train.loop import RunOptions, train
from isp_assets.train.wearers import Wearer

OPTIONS = LayeringOptions(
    network=LayeringConfig(features=4, map_size=32, levels=2),
    garments=2, held_out=0, edge_length=0.1, frames=2, learning_rate=5e-3,
)  # fmt: skip


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load()


@pytest.fixture(scope="module")
def skin(body: Body) -> SkinBundle:
    field = SkinField(SkinFieldConfig(num_vertices=len(body.template)))
    field.place_on(body.template[None], torch.ones(len(body.template)))
    return SkinBundle(field, body.sha256)


@pytest.fixture(scope="module")
def bundle(body: Body) -> GarmentBundle:
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    codes = {"a": np.zeros(2, np.float32), "c": np.array([0.02, 0], np.float32)}
    return GarmentBundle(model, codes, body.sha256)


@pytest.fixture(scope="module", autouse=True)
def _tolerate_pillows() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wardrobe, "_MAX_STRAIN", 99.0)
        yield


@pytest.fixture(scope="module")
def task(bundle: GarmentBundle, skin: SkinBundle, body: Body) -> LayeringTask:
    return LayeringTask([bundle], skin, body, OPTIONS)


def _losses(task: LayeringTask, seed: int) -> dict[str, torch.Tensor]:
    return task.losses(torch.Generator().manual_seed(seed), 0.5)


def test_inner_layers_are_clear_of_the_body_and_carry_no_gradient(task: LayeringTask) -> None:
    poses = torch.zeros(2, 24, 3)
    stack = task.stack(task.wearers, poses, torch.zeros(10), torch.Generator().manual_seed(3))
    assert len(stack.beneath) == len(stack.inner) + 1 >= 2
    for _, vertices in stack.inner:
        assert not vertices.requires_grad
        assert vertices.shape[0] == len(poses)
        inside = clearance(vertices, stack.beneath[0]) < 0
        assert inside.float().mean() < 0.01


def test_layers_that_are_turned_inside_out_still_push_outwards(
    task: LayeringTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    drape, upright = Wearer.drape, []

    def mirrored(self: Wearer, posed: PosedBody, betas: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        skinned, draped = drape(self, posed, betas)
        upright.append(vertex_normals(skinned, self.rest.faces))
        return skinned, draped * torch.tensor([-1.0, 1, 1])

    monkeypatch.setattr(Wearer, "drape", mirrored)
    generator = torch.Generator().manual_seed(3)
    stack = task.stack(task.wearers, torch.zeros(2, 24, 3), torch.zeros(10), generator)
    for surface, outwards in zip(stack.beneath[1:], upright, strict=False):
        assert ((surface.normals * outwards).sum(-1) > -1e-6).all()


def test_losses_depend_on_the_generator_alone_and_reach_the_network(task: LayeringTask) -> None:
    first, again, other = _losses(task, 1), _losses(task, 1), _losses(task, 2)
    assert set(first) == {"strain", "bending", "gravity", "collision", "layers", "regular"}
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["layers"], other["layers"])
    sum(first.values()).backward()
    assert task.module.head.weight.grad.norm() > 0
    task.module.zero_grad()


def test_untrained_network_neither_moves_nor_lifts(task: LayeringTask) -> None:
    figures = task.measure_on(stacks=1)
    for name in ("body_area_percent", "layer_area_percent", "crossing_pairs", "strain_p99"):
        assert figures[f"before.{name}"] == figures[f"after.{name}"]


def test_training_clears_contact_with_the_layers_beneath(task: LayeringTask, tmp_path: Path) -> None:
    state = {k: v.clone() for k, v in task.module.state_dict().items()}
    # The pillows are strained far beyond any cloth: let contact outweigh that.
    eager = copy(task)
    eager.options = replace(OPTIONS, layer_weight=1e4)

    def lacking() -> float:
        generator, total = torch.Generator().manual_seed(5), 0.0
        for _ in range(4):
            stack = task.stack(task.wearers, torch.zeros(1, 24, 3), torch.zeros(10), generator)
            lifted, touched = correct_layer(stack.wearer.layering, stack.draped, stack.beneath, stack.posed)
            assert touched.all()  # the same two garments over one another: they always touch
            heights = torch.stack([clearance(lifted, surface) for surface in stack.beneath[1:]])
            total += float(torch.relu(OPTIONS.contact.margin - heights).mean())
        return total

    with torch.no_grad():
        before = lacking()
        with torch.enable_grad():
            train(eager, tmp_path, RunOptions(steps=20, measurements=1))
        assert lacking() < 0.8 * before
    task.module.load_state_dict(state)


def test_trained_bundle_is_written_with_figures_and_provenance(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, tmp_path: Path
) -> None:
    result = train_layering(
        [bundle], skin, tmp_path, RunOptions(steps=2), body=body, options=OPTIONS, stacks=1
    )
    loaded = LayeringBundle.load(tmp_path / "layering.safetensors")
    assert loaded.layering_net.config == OPTIONS.network
    assert loaded.provenance["steps"] == 2
    assert loaded.provenance["config"]["categories"] == ["pillow"]
    assert dict(loaded.metrics) == dict(result.metrics)
    assert {"before.layer_area_percent", "after.layer_area_percent"} <= set(loaded.metrics)


def test_training_goes_on_from_an_earlier_network_and_says_so(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, tmp_path: Path
) -> None:
    first = train_layering(
        [bundle], skin, tmp_path / "first", RunOptions(steps=2), body=body, options=OPTIONS, stacks=1
    )
    wider = replace(OPTIONS, network=replace(OPTIONS.network, features=8))  # an earlier one keeps its size
    task = LayeringTask([bundle], skin, body, wider, earlier=first)
    weights = task.module.state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in first.layering_net.state_dict().items())
    # Contact is stiff from the start: progress changes nothing.
    generators = [torch.Generator().manual_seed(1) for _ in range(2)]
    early, late = (task.losses(g, p) for g, p in zip(generators, (0.0, 1.0), strict=True))
    assert all(torch.equal(early[name], late[name]) for name in early)
    second = train_layering(
        [bundle], skin, tmp_path / "second", RunOptions(steps=1), body=body, options=wider, earlier=first,
        stacks=1,
    )  # fmt: skip
    assert second.layering_net.config == OPTIONS.network
    assert second.provenance["earlier"] == dict(first.provenance)


def test_stacks_have_two_to_five_layers_in_the_given_shares(task: LayeringTask) -> None:
    only = copy(task)
    for depth in (2, 5):
        only.options = replace(OPTIONS, depth_shares=tuple(float(n == depth) for n in range(2, 6)))
        stack = only.stack(
            only.wearers, torch.zeros(1, 24, 3), torch.zeros(10), torch.Generator().manual_seed(3)
        )
        assert len(stack.inner) == depth - 1
        assert len(stack.beneath) == depth


def test_what_does_not_belong_together_is_refused(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, tmp_path: Path
) -> None:
    run = RunOptions(steps=1)
    with pytest.raises(TrainError, match="at least one"):
        train_layering([], skin, tmp_path, run, body=body)
    with pytest.raises(TrainError, match="'pillow' was made for body 000000000000"):
        train_layering([replace(bundle, body_sha256="0" * 64)], skin, tmp_path, run, body=body)
    with pytest.raises(TrainError, match="skin bundle was made"):
        train_layering([bundle], replace(skin, body_sha256="1" * 64), tmp_path, run, body=body)
