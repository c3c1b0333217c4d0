"""Calming over time: exact in any pieces, nothing in the first frame, a fixed point where nothing moves.

Cloth in the crease of a hip: clear of thighs and belly, and steady.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.body import Body
from isp_assets.clearing import MOST_LEFT, Calm, clear_layer, strain_left
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions, drape
from isp_assets.dressing import WornGarment, dress
from isp_assets.errors import DrapeError
from isp_assets.evaluate.frames import FrameMeter
from isp_assets.geometry.buried import LaidCloth
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.projection import Projection, ProjectionOptions, project
from isp_assets.motion import Motion
from isp_assets.shot import Shot
from isp_assets.skinning import skin_garment

OPTIONS = ProjectionOptions()
FRAMES = 4


class Scene:
    """A tee, skinned and not yet projected, on a few frames of the walk."""

    def __init__(self) -> None:
        body, betas = Body.load("default"), torch.zeros(10)
        self.worn: WornGarment = dress(Collection.load().outfit(["tee"]), body, betas, resolution=40)[0]
        motion = Motion.load("walk")
        posed = body.pose(torch.as_tensor(motion.poses[40 : 40 + FRAMES], dtype=torch.float32))
        skinned = skin_garment(self.worn.skin, posed, betas)[0].double().numpy()
        self.before = [LaidCloth(frame, self.worn.collision.parts) for frame in skinned]
        mesh = CollisionMesh.build(body.faces.numpy(), body.weights.numpy())
        self.obstacles = [[Obstacle(mesh, v, margin=0.003)] for v in posed.vertices.numpy()]
        self.turns = posed.joint_transforms[:, 0, :3, :3].numpy()
        self.cleared = clear_layer(self.worn, self.before, self.obstacles, OPTIONS)

    def calm(self, calm: Calm, rows: slice) -> np.ndarray:
        done = self.cleared[rows]
        return calm.follow(
            self.worn, self.before[rows], done, self.obstacles[rows], self.turns[rows],
            relaxed=[False] * len(done),
        )  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_pieces_give_what_the_whole_gives(scene: Scene) -> None:
    whole = scene.calm(Calm(0.5, OPTIONS), slice(None))
    calm = Calm(0.5, OPTIONS)
    parts = [scene.calm(calm, slice(k, k + 2)) for k in range(0, FRAMES, 2)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_the_first_frame_has_nothing_to_follow(scene: Scene) -> None:
    first = scene.calm(Calm(0.5, OPTIONS), slice(0, 1))[0]
    done = scene.cleared[0]
    caught = done.tight | done.pressed
    assert caught.any()
    np.testing.assert_allclose(first[caught], done.vertices[caught], atol=1e-6)
    later = scene.calm(Calm(0.5, OPTIONS), slice(None))[-1]
    assert np.abs(later - scene.cleared[-1].vertices).max() > 1e-4


def test_moves_that_stay_the_same_are_kept(scene: Scene) -> None:
    """The same frame again and again, the body turning: the moves turn with it and do not decay."""
    calm = Calm(0.75, OPTIONS)
    same = [scene.calm(calm, slice(0, 1))[0] for _ in range(3)]
    caught = scene.cleared[0].tight | scene.cleared[0].pressed
    np.testing.assert_allclose(same[2][caught], same[0][caught], atol=1e-6)
    assert calm.moved is not None
    moved = (scene.cleared[0].vertices - scene.before[0].vertices) @ scene.turns[0]
    np.testing.assert_allclose(calm.moved, moved, atol=1e-6)


def test_moves_follow_exponentially(scene: Scene) -> None:
    """After frames whose projection moves nothing, each keeps the share of the one before."""
    calm = Calm(0.5, OPTIONS)
    scene.calm(calm, slice(0, 1))
    start = calm.moved
    assert start is not None
    still = [
        Projection(cloth.vertices, False, 0, 0.0, done.tight, done.pressed, 0)
        for cloth, done in zip(scene.before, scene.cleared, strict=True)
    ]
    calm.follow(
        scene.worn, scene.before[:2], still[:2], scene.obstacles[:2], scene.turns[:2], relaxed=[False] * 2
    )
    np.testing.assert_allclose(calm.moved, 0.25 * start, atol=1e-7)


def test_positions_that_are_not_finite_are_refused(scene: Scene) -> None:
    broken = list(scene.before)
    vertices = broken[1].vertices.copy()
    vertices[5] = np.nan
    broken[1] = replace(broken[1], vertices=vertices)
    with pytest.raises(DrapeError, match="L00_tee: positions are not finite"):
        clear_layer(scene.worn, broken, scene.obstacles, OPTIONS)


@pytest.mark.parametrize("name", ["a_line_skirt", "long_sleeved_shirt"])
def test_cloth_lies_on_thighs_and_belly_alike_in_a_squat(name: str) -> None:
    motion = Motion.load("squat").select(FrameRange(38, 39))
    shot = Shot("squat", Body.load("default"), motion)
    frames = drape(Collection.load().outfit([name]), shot, DrapeOptions(resolution=64))
    (chunk,) = list(frames)
    moved = np.linalg.norm(np.diff(chunk.layers[0], axis=0), axis=2).max()
    skin_moved = np.linalg.norm(np.diff(chunk.body, axis=0), axis=2).max()
    assert moved < 2 * skin_moved
    meter = FrameMeter(frames.scene)
    layer = frames.scene.layers[0].name
    for index in range(2):
        assert meter.measure(chunk, index)[f"final/{layer}/body_area_percent"] < 0.1


def test_a_tee_stays_outside_trousers_whose_waist_folds_over_itself_in_a_squat() -> None:
    motion = Motion.load("squat").select(FrameRange(31, 31))
    shot = Shot("squat", Body.load("default"), motion)
    options = DrapeOptions(resolution=64, keep_stages=True)
    frames = drape(Collection.load().outfit(["trousers", "tee"]), shot, options)
    (chunk,) = list(frames)
    found = FrameMeter(frames.scene).measure(chunk, 0, stages=True)
    tee = frames.scene.layers[1].name
    assert found[f"layering/{tee}/body_area_percent"] < 0.1
    assert found[f"final/{tee}/inner_area_percent"] < 0.05
    assert found[f"final/{tee}/strain_p99"] < 0.3


def test_a_tucked_hem_and_outer_layers_keep_to_their_own_parts(scene: Scene) -> None:
    """Drawn in from the thighs, not lifted over them."""
    cloth, beneath = scene.before[0], scene.obstacles[0]
    tucked = replace(scene.worn, tucked=np.ones(scene.worn.layer.garment.num_vertices, bool))

    def cleared(worn: WornGarment, over: list[Obstacle]) -> np.ndarray:
        return clear_layer(worn, [cloth], [over], OPTIONS)[0].vertices

    def projected(over: list[Obstacle]) -> np.ndarray:
        own = project(cloth.vertices, scene.worn.collision, over, OPTIONS, stretch=scene.worn.stretch)
        return own.vertices

    np.testing.assert_array_equal(cleared(tucked, beneath), projected(beneath))
    two = [*beneath, beneath[0]]
    np.testing.assert_array_equal(cleared(scene.worn, two), projected(two))


def test_calming_does_not_strain_anew_what_was_relaxed() -> None:
    motion = Motion.load("squat").select(FrameRange(38, 41))
    outfit = Collection.load().outfit(["trousers"])
    shot = Shot("squat", Body.load("default"), motion)
    strain = {}
    for smoothing in (0.0, 0.5):
        draped = drape(outfit, shot, DrapeOptions(resolution=48, smoothing=smoothing))
        (chunk,) = list(draped)
        assert "relax" in chunk.steps[3][0]
        figures = FrameMeter(draped.scene).measure(chunk, 3)
        assert figures["final/L00_trousers/body_area_percent"] < 0.1
        strain[smoothing] = figures["final/L00_trousers/strain_p99"]
    assert strain[0.5] < strain[0.0] + 0.03


_SHARES = st.floats(0, 1, allow_subnormal=False)


@given(st.floats(0.1, 1), _SHARES, st.floats(0.1, 0.5), st.floats(0, 0.02, allow_subnormal=False))
def test_the_strain_that_relaxing_leaves_is_steady_and_within_its_bounds(
    strain: float, on_cloth: float, allowed: float, more: float
) -> None:
    left = strain_left(strain, on_cloth, allowed)
    assert allowed <= left <= max(allowed, MOST_LEFT)
    for changed in (
        strain_left(strain + more, on_cloth, allowed),
        strain_left(strain, on_cloth + more, allowed),
    ):
        assert 0 <= changed - left + 1e-12 < 2.5 * more + 1e-9


def test_strain_is_left_to_hard_poses_and_on_other_cloth() -> None:
    assert strain_left(0.2, 0.0, 0.15) == 0.15
    assert strain_left(0.2, 1.0, 0.15) == MOST_LEFT
    assert 0.15 < strain_left(0.3, 0.0, 0.15) < MOST_LEFT
    assert strain_left(0.9, 0.0, 0.15) == MOST_LEFT
    for strain, on_cloth in ((0.3, 0.0), (0.9, 1.0)):
        assert strain_left(strain, on_cloth, MOST_LEFT) == MOST_LEFT
        assert strain_left(strain, on_cloth, 0.4) == 0.4
