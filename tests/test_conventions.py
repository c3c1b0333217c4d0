"""Frame ranges and the joint tree."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.conventions import JOINT_NAMES, JOINT_PARENTS, NUM_JOINTS, FrameRange
from isp_assets.errors import MotionError


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("1001-1004", [1001, 1002, 1003, 1004]),
        ("1001", [1001]),
        (" 1-7x3 ", [1, 4, 7]),
        ("1-8x3", [1, 4, 7]),
        ("-2-1", [-2, -1, 0, 1]),
        ("-5--3", [-5, -4, -3]),
        ("0-0", [0]),
    ],
)
def test_both_ends_belong_to_a_range(text, frames):
    parsed = FrameRange.parse(text)
    assert list(parsed) == frames
    assert len(parsed) == len(frames)


@given(st.integers(-5000, 5000), st.integers(0, 60), st.integers(1, 20))
@settings(max_examples=30, deadline=None)
def test_text_round_trip(start, length, step):
    frames = FrameRange(start, start + length, step)
    assert FrameRange.parse(str(frames)) == frames
    assert len(frames) == len(list(frames))
    for number in range(start - 2, start + length + 3):
        assert (number in frames) == (number in list(frames))


def test_only_whole_numbers_are_frames():
    frames = FrameRange(1, 5)
    assert 2.0 not in frames
    assert "2" not in frames
    assert None not in frames


@pytest.mark.parametrize("text", ["", "a-b", "1-", "1..5", "1-5x", "1,2", "1-5x-1", "1.5-3", "1-2-3"])
def test_text_that_is_no_range(text):
    with pytest.raises(MotionError, match=r"not a frame range.*START-END"):
        FrameRange.parse(text)


def test_a_range_runs_forwards():
    with pytest.raises(MotionError, match="ends before it starts; swap"):
        FrameRange.parse("10-1")
    with pytest.raises(MotionError, match="step must be at least 1"):
        FrameRange(1, 2, 0)
    with pytest.raises(MotionError, match="step"):
        FrameRange.parse("1-5x0")


def test_the_joint_tree_is_the_body_formats():
    assert NUM_JOINTS == len(JOINT_NAMES) == len(JOINT_PARENTS) == len(set(JOINT_NAMES)) == 24
    assert JOINT_PARENTS[0] == -1
    assert all(0 <= parent < joint for joint, parent in enumerate(JOINT_PARENTS) if joint)


def test_left_and_right_mirror_each_other():
    def mirrored(name: str) -> str:
        return name.replace("left", "#").replace("right", "left").replace("#", "right")

    for joint, parent in enumerate(JOINT_PARENTS[1:], start=1):
        twin = JOINT_NAMES.index(mirrored(JOINT_NAMES[joint]))
        assert JOINT_NAMES[JOINT_PARENTS[twin]] == mirrored(JOINT_NAMES[parent])
