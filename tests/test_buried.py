"""Skin inside another part: how deep it lies, which cloth stays with it, and what that leaves."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from collision_shapes import ball, collision, sheet, tube

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.drape import DrapeOptions, drape
from isp_assets.evaluate.frames import FrameMeter
from isp_assets.evaluate.stress_motions import arms_swept
from isp_assets.geometry.buried import BodyObstacle, HomeSkin, LaidCloth, lay_on_skin
from isp_assets.geometry.obstacle import BODY_PARTS, CollisionMesh
from isp_assets.motion import Motion
from isp_assets.shot import Shot
from isp_assets.train.leg_ik import Figure

TORSO, LEFT_ARM, LEFT_LEG = (list(BODY_PARTS).index(name) for name in ("torso", "left_arm", "left_leg"))
CHORD = 2e-4  # how far the triangles of a ball lie within it [m]
GAP = 0.006


def _body(centre: float, *, limb: int = LEFT_ARM) -> tuple[BodyObstacle, np.ndarray]:
    """A torso of 10 cm about the origin, a limb of 4 cm about a point of the x axis; its vertices."""
    torso, arm = ball(), ball(0.04, centre=(centre, 0, 0))
    vertices = np.concatenate([torso[0], arm[0]])
    mesh = collision((vertices, np.concatenate([torso[1], arm[1] + len(torso[0])])))
    of_limb = np.arange(len(vertices)) >= len(torso[0])
    return BodyObstacle(
        replace(mesh, main_part=np.where(of_limb, limb, TORSO)), vertices, margin=0.003
    ), of_limb


def _sleeve(centre: float, radius: float = 0.05) -> tuple[np.ndarray, CollisionMesh]:
    """A tube about the limb."""
    vertices, faces = tube(radius, low=-0.02, high=0.02)
    mesh = collision((vertices, faces))
    parts = np.zeros_like(mesh.parts)
    parts[:, [TORSO, LEFT_ARM]] = True
    return vertices + np.array([centre, 0, 0]), replace(mesh, parts=parts)


def _lay(centre: float, moved: np.ndarray | float = 0.0, radius: float = 0.05) -> tuple[LaidCloth, HomeSkin]:
    """A sleeve, bound where the limb hangs free, laid on it when it lies at ``centre``."""
    free, _ = _body(0.3)
    bound, mesh = _sleeve(0.3, radius)
    home = HomeSkin.find(bound, free.vertices, free.mesh)
    skinned, _ = _sleeve(centre, radius)
    return lay_on_skin(skinned + moved, skinned, mesh, home, _body(centre)[0], gap=GAP), home


def test_depth_is_the_distance_to_the_other_ball() -> None:
    body, of_arm = _body(0.11)
    inside_torso = 0.1 - np.linalg.norm(body.vertices, axis=1)
    inside_arm = 0.04 - np.linalg.norm(body.vertices - [0.11, 0, 0], axis=1)
    exact = np.where(of_arm, inside_torso, inside_arm).clip(0)
    assert (exact > 0.002).sum() > 200
    for found in (body.depth_at_arms, body.depth_in.max(axis=1)):
        np.testing.assert_allclose(found[exact > 0.002], exact[exact > 0.002], atol=CHORD)
        assert (found[exact == 0] < CHORD).all()


def test_parts_that_do_not_meet_hide_nothing() -> None:
    body, _ = _body(0.15)
    assert not body.depth_in.any()
    assert not body.blocked.any()


def test_buried_skin_has_no_room_however_deep_it_lies() -> None:
    body, of_arm = _body(0.0)
    assert body.blocked[of_arm].all()
    assert not body.room[of_arm].any()
    assert not body.blocked[~of_arm].any()


def test_thighs_in_the_belly_are_hidden_but_hold_no_cloth() -> None:
    body, _ = _body(0.11, limb=LEFT_LEG)
    assert body.blocked.any()
    assert not body.depth_at_arms.any()


def test_free_cloth_is_left_as_it_is() -> None:
    position, mesh = _sleeve(0.15)
    laid, _ = _lay(0.15, 0.01)
    np.testing.assert_array_equal(laid.vertices, position + 0.01)
    np.testing.assert_array_equal(laid.parts, mesh.parts)


def test_a_sleeve_that_was_drawn_out_of_the_torso_returns_to_its_arm() -> None:
    """All of it was moved 12 cm sideways, out of the torso and through its own arm."""
    centre = 0.02
    laid, home = _lay(centre, np.array([0.12, 0, 0]))
    skin = home.at(_body(centre)[0].vertices)
    assert np.linalg.norm(laid.vertices - skin, axis=1).max() < GAP + 1e-9
    assert np.linalg.norm((laid.vertices - [centre, 0, 0]), axis=1).min() > 0.04 - CHORD
    assert (laid.parts.nonzero()[1] == LEFT_ARM).all()


def test_cloth_follows_steadily_as_the_arm_goes_in() -> None:
    """In steps of half a millimetre no vertex moves by more than some of them."""
    centres = np.arange(0.16, 0.09, -0.0005)
    path = np.array([_lay(c, np.array([0.02, 0, 0]))[0].vertices - [c, 0, 0] for c in centres])
    moved = np.linalg.norm(np.diff(path, axis=0), axis=2)
    assert moved.max() < 0.008
    assert np.linalg.norm(path[-1] - path[0], axis=1).max() > 0.015


def test_a_turned_scene_gives_turned_cloth() -> None:
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    body, _ = _body(0.09)
    position, mesh = _sleeve(0.09)
    home = HomeSkin.find(position, body.vertices, body.mesh)
    there = BodyObstacle(body.mesh, body.vertices @ turn.T + 1, margin=0.003)
    moved = position + np.array([0.03, 0, 0])
    here = lay_on_skin(moved, position, mesh, home, body, gap=GAP)
    turned = lay_on_skin(moved @ turn.T + 1, position @ turn.T + 1, mesh, home, there, gap=GAP)
    assert np.abs(here.vertices - moved).max() > 0.01
    np.testing.assert_allclose(turned.vertices, here.vertices @ turn.T + 1, atol=1e-6)


def test_home_skin_is_the_skin_beneath() -> None:
    vertices, faces = sheet(11)
    mesh = collision((vertices, faces))
    home = HomeSkin.find(vertices[:50] + np.array([0, 0.02, 0]), vertices, mesh)
    np.testing.assert_allclose(home.at(vertices), vertices[:50], atol=1e-9)
    np.testing.assert_allclose(home.at(vertices[:, 0]), vertices[:50, 0], atol=1e-9)
    assert (home.part == TORSO).all()


def test_nobody_buries_skin_in_a_walk_and_arms_in_the_torso_do() -> None:
    body = Body.load("default")
    mesh = CollisionMesh.build(body.faces.numpy(), body.weights.numpy())

    def depth(motion: Motion) -> np.ndarray:
        poses = torch.as_tensor(motion.poses, dtype=torch.float32)
        return np.array(
            [BodyObstacle(mesh, v, margin=0.003).depth_in.max(1) for v in body.pose(poses).vertices.numpy()]
        )

    walk = Motion.load("walk")
    assert depth(replace(walk, poses=walk.poses[::30], translation=walk.translation[::30])).max() < 0.002
    swept = depth(arms_swept(Figure.of(body), [20.0, 10.0, -5.0, -10.0]))
    assert swept[:2].max() < 0.002
    assert (swept[2:] > 0.01).sum(axis=1).min() > 500


@pytest.mark.parametrize("garment", ["tee", "long_sleeved_shirt"])
def test_arms_twenty_degrees_into_the_torso_leave_no_cloth_in_the_body(garment: str) -> None:
    body = Body.load("default")
    shot = Shot("arms", body, arms_swept(Figure.of(body), [-20.0]))
    frames = drape(Collection.load().outfit([garment]), shot, DrapeOptions(resolution=64, keep_stages=True))
    chunk = next(iter(frames))
    found = FrameMeter(frames.scene).measure(chunk, 0, stages=True)
    name = frames.scene.layers[0].name
    left = found[f"final/{name}/body_area_percent"]
    assert left < 0.1
    assert found[f"displace/{name}/body_area_percent"] > 2 * left  # there was something to clear
    assert found[f"final/{name}/strain_p99"] < 0.35
