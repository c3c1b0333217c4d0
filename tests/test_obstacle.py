"""Body parts of collision meshes, contact sought by part, and places without room."""

import numpy as np
import pytest
from collision_shapes import (
    LEFT_ARM,
    TORSO,
    ball,
    beside_fold,
    collision,
    folded_tube,
    obstacle,
    sheet,
    tube,
    weights,
)

from isp_assets.errors import GeometryError
from isp_assets.geometry.obstacle import (
    BODY_PARTS,
    NO_ROOM,
    CollisionMesh,
    Obstacle,
    joined_at_hips,
    mean_edge,
)

PARTS = list(BODY_PARTS)


def test_every_joint_belongs_to_one_part() -> None:
    joints = sorted(joint for group in BODY_PARTS.values() for joint in group)
    assert joints == list(range(24))


def test_parts_follow_the_weights_and_overlap_at_their_seams() -> None:
    vertices, faces = tube(0.1)
    share = np.clip((vertices[:, 1] + 0.1) / 0.2, 0, 1)  # torso below, arm above, blended between
    mixed = (1 - share)[:, None] * weights(len(vertices), TORSO) + share[:, None] * weights(
        len(vertices), LEFT_ARM
    )
    mesh = CollisionMesh.build(faces, mixed)
    torso, arm = PARTS.index("torso"), PARTS.index("left_arm")
    assert mesh.parts[share == 0][:, torso].all()
    assert not mesh.parts[share == 0][:, arm].any()
    assert mesh.parts[np.abs(share - 0.5) < 0.1][:, [torso, arm]].all()
    assert set(mesh.part_faces[torso]) & set(mesh.part_faces[arm])
    assert len(mesh.part_faces[torso]) + len(mesh.part_faces[arm]) > len(faces)


def test_a_vertex_of_many_parts_belongs_to_its_strongest() -> None:
    faces = np.array([[0, 1, 2]])
    even = np.zeros((3, 24))
    even[:, [0, 16, 17, 1, 2, 15]] = [0.15, 0.2, 0.15, 0.2, 0.15, 0.15]
    assert CollisionMesh.build(faces, even).parts.sum(1).tolist() == [1, 1, 1]


def test_torso_and_legs_are_joined_at_the_hips_but_not_leg_to_leg() -> None:
    each = np.eye(len(PARTS), dtype=bool)
    joined = {
        part: {other for other, own in zip(PARTS, row, strict=True) if own}
        for part, row in zip(PARTS, joined_at_hips(each), strict=True)
    }
    assert joined.pop("torso") == {"torso", "left_leg", "right_leg"}
    assert joined.pop("left_leg") == {"left_leg", "torso"}
    assert joined.pop("right_leg") == {"right_leg", "torso"}
    assert all(others == {part} for part, others in joined.items())
    np.testing.assert_array_equal(each, np.eye(len(PARTS)))


def test_contact_is_sought_on_shared_parts_only() -> None:
    below, points = obstacle(ball()), np.array([[0.0, 0.105, 0.0], [0.0, 0.0, 0.09]])
    own = below.contacts(points, collision((points, np.array([[0, 1, 0]]))).parts, within=0.01)
    np.testing.assert_allclose(own.height, [0.005, -0.01], atol=3e-4)
    foreign = below.contacts(points, np.zeros((2, 6), bool), within=0.01)
    assert np.isinf(foreign.height).all()
    assert np.array_equal(foreign.point, points)


def test_points_far_from_a_part_are_not_sought_there() -> None:
    below, points = obstacle(ball()), np.array([[0.0, 0.2, 0.0]])
    parts = np.ones((1, 6), bool)
    assert np.isinf(below.contacts(points, parts, within=0.05).height[0])
    assert below.contacts(points, parts, within=0.15).height[0] == pytest.approx(0.1, abs=3e-4)


def test_parts_together_find_what_the_whole_surface_finds() -> None:
    vertices, faces = ball()
    mesh = CollisionMesh.build(faces, np.where(vertices[:, :1] > 0, weights(1, TORSO), weights(1, LEFT_ARM)))
    below = Obstacle(mesh, vertices, margin=0.003)
    points = 0.1 * np.random.default_rng(0).normal(size=(200, 3))
    split = below.contacts(points, np.ones((200, 6), bool), within=1.0)
    np.testing.assert_allclose(split.height, below.whole(points).height, atol=1e-12)


def test_points_outside_a_fold_that_cuts_itself_are_not_beneath_it() -> None:
    layer, (points, within) = obstacle(folded_tube()), beside_fold()
    misled = ~within & (layer.whole(points).height < 0)
    assert misled.sum() > 300  # by the nearest triangle
    found = layer.contacts(points, np.tile(layer.mesh.parts[:1], (len(points), 1)), within=0.1)
    assert np.isposinf(found.height[misled]).all()
    assert not (~within & (found.height < 0)).any()
    np.testing.assert_array_equal(found.height[~misled], layer.whole(points[~misled]).height)


def test_room_is_missing_only_where_surfaces_press_together() -> None:
    left, right = ball(centre=(-0.102, 0, 0)), ball(centre=(0.102, 0, 0))
    vertices = np.concatenate([left[0], right[0]])
    shape = (vertices, np.concatenate([left[1], right[1] + len(left[0])]))
    assert not obstacle(ball()).tight.any()
    tight = obstacle(shape, margin=0.003).tight
    gap = np.linalg.norm(vertices * [0, 1, 1], axis=1) + 10 * (np.abs(vertices[:, 0]) > 0.05)
    assert tight[gap < 0.005].all()
    assert not tight[gap > 0.06].any()
    given = gap > 9
    named = Obstacle(collision(shape), vertices, margin=0.003, tight=given).tight
    assert np.array_equal(named, tight | given)


@pytest.mark.parametrize("margin", [0.0, 0.001, 0.003])
@pytest.mark.parametrize("gap", [0.001, 0.004, 0.007, 0.03])
def test_room_is_the_gap_and_margins_shrink_with_it(margin: float, gap: float) -> None:
    """Two sheets that face each other: the lower one sees how far away the upper one is."""
    (low, faces), (high, _) = sheet(11), sheet(11, height=gap)
    vertices = np.concatenate([low, high])
    both = obstacle((vertices, np.concatenate([faces, faces[:, ::-1] + len(low)])), margin=margin)
    seen = 2 * max(2 * margin, NO_ROOM)
    np.testing.assert_allclose(both.room, min(gap, seen), atol=1e-9)
    assert both.tight.all() == (gap < NO_ROOM)
    np.testing.assert_allclose(both.margins, min(margin, max(min(0.0005, margin), gap / 4)), atol=1e-9)
    found = both.whole(np.array([[0.001, -0.002, 0.003]]))
    np.testing.assert_allclose(both.margin_at(found), both.margins[:1], atol=1e-9)


def test_mean_edge_and_refusals() -> None:
    assert mean_edge(np.array([[0, 0, 0], [0, 3, 0], [4, 0, 0]], float), np.array([[0, 1, 2]])) == 3.0
    with pytest.raises(GeometryError, match="margin"):
        obstacle(ball(), margin=-1.0)
