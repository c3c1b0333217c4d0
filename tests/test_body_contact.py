"""Contact that knows whose skin is whose: an arm through the side of a shirt."""

import numpy as np
import pytest
import torch
from torch import Tensor

from isp_assets.geometry.contact import Surface, clearance
from isp_assets.geometry.obstacle import BODY_PARTS, body_parts
from isp_assets.train.body_contact import PartedBody, arms_and_rest

MARGIN = 0.005


def _walls() -> PartedBody:
    """A torso whose skin is the plane x = 0, and an arm from x = .05 to x = .10 (skins facing both ways)."""
    y = torch.linspace(-0.5, 0.5, 101, dtype=torch.float64)
    places, normals, members = [], [], []
    for x, facing, part in ((0.0, 1.0, 0), (0.05, -1.0, 1), (0.10, 1.0, 1)):
        places.append(torch.stack([torch.full_like(y, x), y, torch.zeros_like(y)], dim=1))
        normals.append(torch.tensor([[facing, 0.0, 0.0]], dtype=torch.float64).expand(len(y), 3))
        members.append(torch.tensor([[part == 0, part == 1, False]]).expand(len(y), 3))
    whole = Surface(torch.cat(places)[None], torch.cat(normals)[None])
    return PartedBody.of(whole, torch.cat(members))


def _height_and_slope(x: float, own: tuple[bool, bool, bool]) -> tuple[float, list[float]]:
    """Clearance of one vertex, and how it changes with the vertex's place."""
    vertex = torch.tensor([[[x, 0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    height = _walls().clearance(vertex, torch.tensor([own]), margin=MARGIN)
    (slope,) = torch.autograd.grad(height.sum(), vertex)
    return float(height.detach()), slope[0, 0].tolist()


TORSO, ARM, BOTH = (True, False, False), (False, True, False), (True, True, False)


@pytest.mark.parametrize("x", [0.055, 0.07, 0.08, 0.099, 0.102])
def test_cloth_of_the_torso_inside_the_arm_is_pulled_home(x: float) -> None:
    height, slope = _height_and_slope(x, TORSO)
    nearest = (0.05 - x) if x < 0.075 else (x - 0.10)
    assert height == pytest.approx(nearest)  # as deep as it is
    assert slope == pytest.approx([-1, 0, 0])  # but the way out leads to the torso


def test_the_sleeve_is_pushed_off_its_own_arm_the_shortest_way() -> None:
    assert _height_and_slope(0.055, ARM) == (pytest.approx(-0.005), pytest.approx([-1, 0, 0]))
    assert _height_and_slope(0.099, ARM) == (pytest.approx(-0.001), pytest.approx([1, 0, 0]))


def test_cloth_of_both_parts_is_pushed_as_by_a_whole_body() -> None:
    for x in (-0.01, 0.004, 0.06, 0.099):
        vertex = torch.tensor([[[x, 0.0, 0.0]]], dtype=torch.float64)
        whole = float(clearance(vertex, _walls().whole))
        assert _height_and_slope(x, BOTH)[0] == pytest.approx(whole)


def test_a_sleeve_in_the_torso_is_pulled_to_its_arm() -> None:
    height, slope = _height_and_slope(-0.002, ARM)
    assert height == pytest.approx(-0.002)
    assert slope == pytest.approx([1, 0, 0])


def test_without_room_only_the_own_part_counts() -> None:
    points = torch.zeros(1, 2, 3, dtype=torch.float64)
    points[0, 1, 0] = 0.003  # a skin against this one, 3 mm off
    normals = torch.tensor([[[1.0, 0, 0], [-1.0, 0, 0]]], dtype=torch.float64)
    pressed = PartedBody.of(Surface(points, normals), torch.tensor([[True, False], [False, True]]))
    vertex = torch.tensor([[[0.002, 0.0, 0.0]]], dtype=torch.float64)
    found = pressed.clearance(vertex, torch.tensor([[True, False]]), margin=MARGIN)
    assert float(found) == pytest.approx(0.002)


def test_clear_cloth_is_left_to_the_whole_body() -> None:
    for x in (0.02, 0.04, 0.2):
        vertex = torch.tensor([[[x, 0.0, 0.0]]], dtype=torch.float64)
        height = _walls().clearance(vertex, torch.tensor([TORSO]), margin=MARGIN)
        assert torch.equal(height, clearance(vertex, _walls().whole))


def test_where_the_own_part_is_missing_the_whole_body_counts() -> None:
    vertex = torch.tensor([[[0.09, 0.0, 0.0]]], dtype=torch.float64)
    height = _walls().clearance(vertex, torch.tensor([[False, False, True]]), margin=MARGIN)
    assert torch.equal(height, clearance(vertex, _walls().whole))


def test_descending_brings_caught_cloth_home() -> None:
    """What the plain nearest skin would push out on the far side of the arm comes back."""
    body, own = _walls(), torch.tensor([TORSO])

    def settle(height_of) -> float:
        vertex = torch.tensor([[[0.09, 0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
        for _ in range(200):
            lacking: Tensor = torch.relu(MARGIN - height_of(vertex)).sum()
            (slope,) = torch.autograd.grad(lacking, vertex, allow_unused=True)
            vertex = (vertex - 0.001 * (0 if slope is None else slope)).detach().requires_grad_()
        return float(vertex.detach()[0, 0, 0])

    assert settle(lambda v: body.clearance(v, own, margin=MARGIN)) <= 0.05 - MARGIN + 0.001
    assert settle(lambda v: clearance(v, body.whole)) >= 0.10 + MARGIN - 0.001


def test_parts_of_skinning_weights() -> None:
    names, weights = list(BODY_PARTS), np.zeros((3, 24))
    weights[0, 0] = 1.0
    weights[1, [13, 16]] = 0.85, 0.15  # the shoulder: of the torso, but the arm may touch it
    weights[2, [13, 16]] = 0.5, 0.5
    parts, extended = body_parts(weights)
    torso, arm = names.index("torso"), names.index("left_arm")
    assert parts[:, torso].all()
    assert parts[:, arm].tolist() == [False, False, True]
    assert extended[:, arm].tolist() == [False, True, True]
    assert parts.sum() == 4


def test_arms_are_limbs_of_their_own_and_legs_belong_to_the_rest() -> None:
    parts = list(BODY_PARTS)
    one_hot = torch.eye(len(parts), dtype=torch.bool)
    limbs = arms_and_rest(one_hot)
    assert limbs.shape == (len(parts), 3)
    assert (limbs.sum(1) == 1).all()
    group = dict(zip(parts, limbs.float().argmax(1).tolist(), strict=True))
    assert group["torso"] == group["left_leg"] == group["right_leg"] == group["head"]
    assert len({group["torso"], group["left_arm"], group["right_arm"]}) == 3
