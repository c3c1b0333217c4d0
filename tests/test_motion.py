"""Motions keep what they mean through file formats, axes, rates and frame ranges."""

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES, FrameRange
from isp_assets.errors import MotionError
from isp_assets.motion import Motion, builtin_motions

Z_FROM_Y = Rotation.from_euler("x", 90, degrees=True)  # a Y-up world stood up in a Z-up one


@pytest.fixture(scope="module")
def body():
    return Body.load()


@pytest.fixture
def no_annotation_checks():
    """Outside of tests annotations are not checked: wrong shapes must then give our own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def random_motion(count=10, *, fps=30.0, start_frame=1, seed=0):
    rng = np.random.default_rng(seed)
    poses = 0.4 * rng.normal(size=(count, 24, 3))
    return Motion(poses, rng.normal(size=(count, 3)), fps=fps, start_frame=start_frame, name="random")


def write(path, **keys):
    defaults = {"poses": np.zeros((3, 72)), "trans": np.zeros((3, 3)), "mocap_framerate": 30.0}
    np.savez(path, **{key: value for key, value in (defaults | keys).items() if value is not None})
    return path


def pose_body(body, poses, translation):
    posed = body.pose(torch.from_numpy(poses).float(), translation=torch.from_numpy(translation).float())
    return posed.vertices.numpy()


def assert_same_rotations(a, b, atol):
    difference = Rotation.from_rotvec(a.reshape(-1, 3)).inv() * Rotation.from_rotvec(b.reshape(-1, 3))
    assert difference.magnitude().max() < atol


# ---- the motions that ship


def test_shipped_motions_are_there():
    assert {"walk", "turn", "arm_raise", "squat", "arms_crossed"} <= set(builtin_motions())


@pytest.mark.parametrize("name", builtin_motions())
def test_shipped_motions_stand_on_the_floor_and_move_smoothly(body, name):
    motion = Motion.load(name)
    assert (motion.fps, motion.start_frame, motion.name) == (30, 1, name)
    posed = body.pose(torch.from_numpy(motion.poses), translation=torch.from_numpy(motion.translation))
    lowest = posed.vertices[..., 1].amin(1)
    assert lowest.min() > -0.012, "a foot sinks into the floor"
    assert lowest.max() < 0.012, "the body floats"
    acceleration = np.diff(posed.joints.numpy(), n=2, axis=0) * motion.fps**2
    assert np.linalg.norm(acceleration, axis=-1).max() < 60


@pytest.mark.parametrize("name", builtin_motions())
def test_feet_on_the_floor_stay_where_they_are(body, name):
    motion = Motion.load(name)
    vertices = pose_body(body, motion.poses, motion.translation)
    velocity = np.diff(vertices[..., [0, 2]], axis=0) * motion.fps
    on_floor = (vertices[:-1, :, 1] < 0.006) & (vertices[1:, :, 1] < 0.006)
    assert on_floor.any()
    assert np.median(np.linalg.norm(velocity, axis=-1)[on_floor]) < 0.03


def test_walk_keeps_the_arms_clear_of_the_torso(body):
    motion = Motion.load("walk")
    assert len(motion) >= 96
    vertices = pose_body(body, motion.poses, motion.translation)
    owner = body.weights.argmax(1).numpy()
    arms = np.isin(
        owner, [JOINT_NAMES.index(f"{s}_{j}") for s in ("left", "right") for j in ("elbow", "wrist", "hand")]
    )
    trunk = np.isin(
        owner, [JOINT_NAMES.index(j) for j in ("pelvis", "spine1", "spine2", "left_hip", "right_hip")]
    )
    distance = [cKDTree(frame[trunk]).query(frame[arms])[0].min() for frame in vertices[::4]]
    assert min(distance) > 0.04
    wrists = vertices[:, owner == JOINT_NAMES.index("left_wrist"), 2].mean(1) - motion.translation[:, 2]
    assert np.ptp(wrists) > 0.25, "the arms swing"


# ---- axes and file kinds


@pytest.mark.parametrize("up", ["auto", "z"])
def test_z_up_file_gives_the_same_body_in_y_up(body, tmp_path, up):
    """AMASS files are Z up: what they describe must come out turned, not tilted or sunk."""
    walk = Motion.load("walk").select(FrameRange(1, 40, 13))
    poses = walk.poses.copy()
    poses[:, 0] = (Z_FROM_Y * Rotation.from_rotvec(walk.poses[:, 0])).as_rotvec()
    translation = Z_FROM_Y.apply(walk.translation)
    as_stored = pose_body(body, poses, translation)
    path = write(tmp_path / "z.npz", poses=poses.reshape(-1, 72), trans=translation)
    motion = Motion.load(path, up=up)
    turned = pose_body(body, motion.poses, motion.translation)
    np.testing.assert_allclose(
        turned, Z_FROM_Y.inv().apply(as_stored.reshape(-1, 3)).reshape(turned.shape), atol=2e-6
    )
    assert_same_rotations(motion.poses, walk.poses, 1e-5)


def test_y_up_file_is_kept_as_it_is(tmp_path):
    walk = Motion.load("walk")
    path = write(tmp_path / "y.npz", poses=walk.poses.reshape(-1, 72), trans=walk.translation)
    motion = Motion.load(path)
    np.testing.assert_allclose(motion.poses[:, :22], walk.poses[:, :22], atol=1e-7)
    np.testing.assert_allclose(motion.translation, walk.translation, atol=1e-7)


def test_lying_body_is_not_guessed_at(tmp_path):
    poses = np.zeros((3, 72))
    poses[:, :3] = Rotation.from_euler("z", 90, degrees=True).as_rotvec()
    path = write(tmp_path / "lying.npz", poses=poses)
    with pytest.raises(MotionError, match="say up='y' or up='z'"):
        Motion.load(path)
    np.testing.assert_allclose(Motion.load(path, up="y").poses[:, 0], poses[:, :3], atol=1e-6)


@pytest.mark.parametrize("columns", [72, 156, 165])
def test_body_joints_are_kept_and_hands_are_straightened(tmp_path, columns):
    poses = 0.2 * np.random.default_rng(0).normal(size=(3, columns))
    motion = Motion.load(write(tmp_path / "m.npz", poses=poses), up="y")
    np.testing.assert_allclose(motion.poses[:, :22].reshape(3, 66), poses[:, :66], atol=1e-7)
    assert not motion.poses[:, 22:].any()


def test_smplx_parts(tmp_path):
    root, parts = np.full((3, 3), 0.1), np.full((3, 63), 0.2)
    path = write(
        tmp_path / "m.npz", poses=None, root_orient=root, pose_body=parts, mocap_framerate=None, fps=24
    )
    motion = Motion.load(path)
    assert motion.fps == 24
    np.testing.assert_allclose(motion.poses[:, 0], root)
    np.testing.assert_allclose(motion.poses[:, 1:22].reshape(3, 63), parts)


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate", "fps"])
def test_frame_rate_keys(tmp_path, key):
    path = write(tmp_path / "m.npz", **{"mocap_framerate": None, key: np.array([120.0])})
    assert Motion.load(path).fps == 120


# ---- resampling


def test_resampling_to_the_same_rate_changes_nothing():
    motion = random_motion()
    again = motion.resample(motion.fps)
    np.testing.assert_array_equal(again.frames, motion.frames)
    assert_same_rotations(again.poses, motion.poses, 1e-7)
    np.testing.assert_allclose(again.translation, motion.translation, atol=1e-12)


def test_doubling_the_rate_keeps_the_samples_and_adds_the_halfway_ones():
    motion = random_motion()
    double = motion.resample(60)
    assert (len(double), double.fps, double.start_frame) == (19, 60, 1)
    assert_same_rotations(double.poses[::2], motion.poses, 1e-7)
    np.testing.assert_allclose(
        double.translation[1::2], (motion.translation[1:] + motion.translation[:-1]) / 2
    )
    back, forth = (Rotation.from_rotvec(double.poses[k::2][:9].reshape(-1, 3)) for k in (0, 1))
    ahead = Rotation.from_rotvec(motion.poses[1:].reshape(-1, 3))
    np.testing.assert_allclose(
        (back.inv() * forth).as_rotvec(), (forth.inv() * ahead).as_rotvec(), atol=1e-12
    )


def test_a_steady_turn_is_resampled_exactly_through_the_half_turn():
    """Angles near pi flip sign in axis-angle form: interpolating their numbers would spin the body."""
    poses = np.zeros((25, 24, 3))
    poses[:, 0, 1] = np.radians(np.arange(25) * 20.0)
    poses[:, 0] = Rotation.from_rotvec(poses[:, 0]).as_rotvec()
    motion = Motion(poses, np.zeros((25, 3)), fps=24.0).resample(25)
    expected = np.zeros((26, 3))
    expected[:, 1] = np.radians(np.arange(26) * 20.0 * 24 / 25)
    assert_same_rotations(motion.poses[:, 0], expected, 1e-7)


RATES = [23.976, 24.0, 25.0, 29.97, 30.0, 60.0, 120.0]


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 60), st.sampled_from(RATES), st.sampled_from(RATES))
def test_resampled_motion_lasts_as_long(count, before, after):
    motion = Motion(np.zeros((count, 24, 3)), np.zeros((count, 3)), fps=before)
    resampled = motion.resample(after)
    lost = (count - 1) / before - (len(resampled) - 1) / after
    assert -1e-6 <= lost < 1 / after


def test_resampling_a_stepped_selection_keeps_time():
    motion = random_motion(9)
    motion.translation[:] = np.arange(9)[:, None]
    stepped = motion.select(FrameRange(1, 9, 4)).resample(30)
    np.testing.assert_allclose(stepped.translation[:, 0], np.arange(9), atol=1e-12)


@pytest.mark.parametrize("fps", [0, -30, float("nan"), float("inf")])
def test_resampling_needs_a_positive_rate(fps):
    with pytest.raises(MotionError, match="fps must be above 0"):
        random_motion().resample(fps)


# ---- frame ranges


def test_select_keeps_frame_numbers():
    motion = random_motion(10, start_frame=1001)
    part = motion.select(FrameRange.parse("1003-1009x3"))
    assert part.frames.tolist() == [1003, 1006, 1009]
    np.testing.assert_array_equal(part.poses, motion.poses[[2, 5, 8]])
    assert part.select(FrameRange(1006, 1009, 3)).frames.tolist() == [1006, 1009]
    assert part.fps == motion.fps


@given(st.integers(-5, 2000), st.integers(1, 60), st.data())
def test_any_range_within_the_motion_can_be_selected(start, count, data):
    motion = Motion(np.zeros((count, 24, 3)), np.arange(3 * count).reshape(count, 3) * 1.0, 30.0, start)
    first = data.draw(st.integers(start, start + count - 1))
    last = data.draw(st.integers(first, start + count - 1))
    wanted = FrameRange(first, last, data.draw(st.integers(1, 7)))
    part = motion.select(wanted)
    assert part.frames.tolist() == list(wanted)
    np.testing.assert_array_equal(part.translation[:, 0], 3 * (np.asarray(list(wanted)) - start))


@pytest.mark.parametrize("text", ["0-3", "5-11", "11", "1-100x99"])
def test_frames_outside_are_refused_with_the_available_range(text):
    with pytest.raises(MotionError, match=f"has frames 1-10, asked for {FrameRange.parse(text)}"):
        random_motion(10).select(FrameRange.parse(text))


def test_frames_between_the_samples_are_refused():
    stepped = random_motion(10).select(FrameRange(1, 9, 2))
    with pytest.raises(MotionError, match="has frames 1-9x2, asked for 2-4"):
        stepped.select(FrameRange(2, 4))


# ---- bad input


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_rotation_is_named_by_frame_and_joint(tmp_path, value):
    poses = np.zeros((5, 72))
    poses[3, 3 * JOINT_NAMES.index("left_elbow") + 1] = value
    poses[4, 0] = value
    path = write(tmp_path / "m.npz", poses=poses, trans=np.zeros((5, 3)))
    with pytest.raises(MotionError, match=r"frame 4, joint 'left_elbow' \(2 bad rotations in all\)"):
        Motion.load(path)


def test_bad_translation_is_named_by_frame(tmp_path):
    translation = np.zeros((3, 3))
    translation[1, 2] = np.inf
    with pytest.raises(MotionError, match="translation: NaN or infinity at frame 2"):
        Motion.load(write(tmp_path / "m.npz", trans=translation))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"poses": None}, "expected the key 'poses'"),
        ({"trans": None}, "expected the key 'trans'"),
        ({"mocap_framerate": None}, "expected the frame rate under mocap_framerate or"),
        ({"mocap_framerate": np.array([30.0, 60.0])}, "frame rate: expected one number"),
        ({"mocap_framerate": 0.0}, "expected fps above 0"),
        ({"mocap_framerate": np.array("fast")}, "frame rate: expected one number"),
        ({"poses": np.zeros((3, 75))}, r"165 \(SMPL-X\) columns, got shape \[3, 75\]"),
        ({"poses": np.zeros((0, 72)), "trans": np.zeros((0, 3))}, "at least one row"),
        ({"trans": np.zeros((2, 3))}, r"trans: expected shape \[3, 3\], got \[2, 3\]"),
        ({"poses": np.array([{}], dtype=object)}, r"expected an \.npz of plain arrays"),
    ],
)
def test_bad_files_are_refused(tmp_path, keys, message):
    with pytest.raises(MotionError, match=message):
        Motion.load(write(tmp_path / "m.npz", **keys))


def test_unknown_name_lists_the_shipped_motions():
    with pytest.raises(MotionError, match=r"moonwalk: no such motion.*arm_raise.*walk"):
        Motion.load("moonwalk")


def test_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "m.npz").write_text("hello")
    with pytest.raises(MotionError, match=r"expected an \.npz of plain arrays"):
        Motion.load(tmp_path / "m.npz")


@pytest.mark.usefixtures("no_annotation_checks")
@pytest.mark.parametrize(
    ("poses", "translation", "message"),
    [
        (
            np.zeros((4, 72)),
            np.zeros((4, 3)),
            r"poses: expected shape \[T, 24, 3\] with T >= 1, got \[4, 72\]",
        ),
        (np.zeros((4, 24, 3)), np.zeros((3, 3)), r"translation: expected shape \[4, 3\], got \[3, 3\]"),
        (np.zeros((0, 24, 3)), np.zeros((0, 3)), "with T >= 1"),
    ],
)
def test_constructor_refuses_wrong_shapes(poses, translation, message):
    with pytest.raises(MotionError, match=message):
        Motion(poses, translation, fps=30.0)
