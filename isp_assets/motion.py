"""Motion: SMPL pose sequences, read from AMASS-style files.

Angles are axis-angle [rad], translations metres, Y up. Frame numbers are
integers; frame ``n`` lies at time ``n / fps``. Shape coefficients in motion files
belong to the captured actor's body file and are not read.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from isp_assets.conventions import JOINT_NAMES, FrameRange
from isp_assets.errors import MotionError
from isp_assets.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp

_FOLDER = Path(__file__).parent / "data" / "motions"
_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate", "fps")
_BODY_JOINTS = 22  # pelvis to wrists: the joints that SMPL, SMPL-H and SMPL-X share, in one order
_SMPL_PELVIS = (0.0, -0.22, 0.03)
# Where the pelvis joint rests in each model [m], by the number of pose columns. The root turns about this
# point, so a change of axes or of model moves the translation with it. Shape moves it by a centimetre or so.
_REST_PELVIS = {72: _SMPL_PELVIS, 66: _SMPL_PELVIS, 156: _SMPL_PELVIS, 165: (0.0, -0.35, 0.01)}
_Y_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Motion:
    """T samples of a moving SMPL skeleton; checked at construction."""

    poses: Float[np.ndarray, "T 24 3"]
    """Axis-angle rotation of each joint relative to its parent [rad]."""
    translation: Float[np.ndarray, "T 3"]
    """Root translation [m], Y up."""
    fps: float | int
    """Frame numbers per second."""
    start_frame: int = 1
    name: str = "motion"
    frame_step: int = 1
    """Frame numbers between two samples; 1 unless a stepped range was selected."""

    def __post_init__(self) -> None:
        _check(self)

    @classmethod
    def load(cls, source: str | Path, *, up: Literal["auto", "y", "z"] = "auto") -> "Motion":
        """Read a motion.

        SMPL (72 columns), SMPL-H (156) and SMPL-X (165) poses are read; the first 22 joints
        are kept and the hands set to zero rotation.

        Args:
            source: The name of a shipped motion (see ``builtin_motions``) or the path of an ``.npz``.
            up: Axis that points up in the file. ``"auto"`` looks at which way the spine points on average.

        Raises:
            MotionError: If the file is missing or incomplete, or holds NaN, or ``"auto"`` cannot tell.
        """
        if isinstance(source, str) and source in builtin_motions():
            path = _FOLDER / f"{source}.npz"
        else:
            path = Path(source)
        return _from_arrays(_read(path), up=up, name=path.stem, where=str(path))

    def __len__(self) -> int:
        return int(self.poses.shape[0])

    @property
    def frames(self) -> Int[np.ndarray, " T"]:
        """Frame number of every sample."""
        return self.start_frame + self.frame_step * np.arange(len(self))

    def resample(self, fps: float | int) -> "Motion":
        """The same motion at another rate: rotations along the shortest arc, translations linearly.

        The first frame keeps its number; the last is the last that lies within the motion.
        """
        if not (np.isfinite(fps) and fps > 0):
            raise MotionError(f"motion '{self.name}': resample: fps must be above 0, got {fps:g}")
        rate = self.fps / self.frame_step
        last = len(self) - 1
        # The small slack keeps the end frame when rounding puts it a hair outside.
        count = int(np.floor(last / rate * fps + 1e-6)) + 1
        position = np.minimum(np.arange(count) * rate / fps, last)
        lower = np.minimum(position.astype(np.int64), max(last - 1, 0))
        upper = np.minimum(lower + 1, last)
        fraction = position - lower
        poses = slerp(
            torch.from_numpy(self.poses[lower]).double(),
            torch.from_numpy(self.poses[upper]).double(),
            torch.from_numpy(fraction)[:, None].expand(-1, self.poses.shape[1]),
        )
        weight = fraction[:, None]
        translation = (1 - weight) * self.translation[lower] + weight * self.translation[upper]
        return replace(
            self,
            poses=poses.numpy().astype(self.poses.dtype),
            translation=translation.astype(self.translation.dtype),
            fps=float(fps),
            frame_step=1,
        )

    def select(self, frames: FrameRange) -> "Motion":
        """The samples of an inclusive range of frame numbers, which keep their numbers.

        Raises:
            MotionError: If the range asks for a frame that the motion does not have.
        """
        wanted = np.asarray(list(frames))
        index, rest = np.divmod(wanted - self.start_frame, self.frame_step)
        bad = (index < 0) | (index >= len(self)) | (rest != 0)
        if bad.any():
            available = FrameRange(int(self.frames[0]), int(self.frames[-1]), self.frame_step)
            raise MotionError(
                f"motion '{self.name}' has frames {available}, asked for {frames}; choose a range within it"
            )
        return replace(
            self,
            poses=self.poses[index],
            translation=self.translation[index],
            start_frame=int(wanted[0]),
            frame_step=int(frames.step),
        )


def builtin_motions() -> tuple[str, ...]:
    """Names of the motions that ship with the package, sorted."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.npz")))


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise MotionError(
            f"{path}: no such motion; expected the path of an .npz file or one of: "
            f"{', '.join(builtin_motions())}"
        )
    try:
        with np.load(path, allow_pickle=False) as data:
            # Markers, soft-tissue data and object arrays of some releases are not wanted and may not load.
            wanted = ("poses", "root_orient", "pose_body", "trans", "up", *_RATE_KEYS)
            return {key: data[key] for key in wanted if key in data.files}
    except (ValueError, OSError) as error:
        raise MotionError(f"{path}: expected an .npz of plain arrays ({error})") from error


def _from_arrays(data: Mapping[str, Any], *, up: str, name: str, where: str) -> Motion:
    poses, columns = _pose_columns(data, where)
    count = len(poses)
    if "trans" not in data:
        raise MotionError(f"{where}: expected the key 'trans' (root translation, {count} x 3); it is missing")
    translation = np.asarray(data["trans"], dtype=np.float64)
    if translation.shape != (count, 3):
        raise MotionError(f"{where}: trans: expected shape [{count}, 3], got {list(translation.shape)}")
    rate = next((data[key] for key in _RATE_KEYS if key in data), None)
    if rate is None:
        raise MotionError(f"{where}: expected the frame rate under {' or '.join(_RATE_KEYS)}; none is there")
    if np.size(rate) != 1 or not np.issubdtype(np.asarray(rate).dtype, np.number):
        raise MotionError(f"{where}: frame rate: expected one number, got {rate!r}")
    full = np.zeros((count, len(JOINT_NAMES), 3))
    full[:, :_BODY_JOINTS] = poses[:, : 3 * _BODY_JOINTS].reshape(count, _BODY_JOINTS, 3)
    # Checked before the axes are looked at, so that a NaN is reported as a NaN.
    motion = Motion(full, translation, fps=float(np.asarray(rate).item()), name=name)
    axis = _up_axis(data, full[:, 0], where) if up == "auto" else up
    root, translation = _to_y_up(full[:, 0], translation, axis, _REST_PELVIS[columns])
    full[:, 0] = root
    return replace(motion, poses=full.astype(np.float32), translation=translation.astype(np.float32))


def _pose_columns(data: Mapping[str, Any], where: str) -> tuple[Float[np.ndarray, "T C"], int]:
    """The pose table and the number of columns that tells the model it was made for."""
    if "poses" in data:
        poses = np.asarray(data["poses"], dtype=np.float64)
        if poses.ndim == 3 and poses.shape[2] == 3:
            poses = poses.reshape(len(poses), -1)
    elif "root_orient" in data and "pose_body" in data:
        poses = np.concatenate([data["root_orient"], data["pose_body"]], axis=1, dtype=np.float64)
    else:
        raise MotionError(
            f"{where}: expected the key 'poses', or 'root_orient' and 'pose_body'; found neither"
        )
    if poses.ndim != 2 or poses.shape[1] not in _REST_PELVIS or len(poses) == 0:
        raise MotionError(
            f"{where}: poses: expected at least one row of 72 (SMPL), 156 (SMPL-H) or 165 (SMPL-X) columns, "
            f"got shape {list(poses.shape)}"
        )
    return poses, poses.shape[1]


def _up_axis(data: Mapping[str, Any], root: Float[np.ndarray, "T 3"], where: str) -> str:
    """Which axis is up: what the file says, else where the body's own up direction points on average."""
    if "up" in data:
        return str(data["up"]).lower()
    upward = axis_angle_to_matrix(torch.from_numpy(root))[:, :, 1].mean(0)
    if max(upward[1], upward[2]) < 0.5:
        raise MotionError(
            f"{where}: cannot tell which axis is up (the body's mean up direction is "
            f"{', '.join(f'{float(x):.2f}' for x in upward)}); say up='y' or up='z'"
        )
    return "y" if upward[1] >= upward[2] else "z"


def _to_y_up(
    root: Float[np.ndarray, "T 3"],
    translation: Float[np.ndarray, "T 3"],
    axis: str,
    pelvis: tuple[float, ...],
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Turn the world, and move the translation from the source's rest pelvis to SMPL's."""
    if axis not in ("y", "z"):
        raise MotionError(f"up axis: expected 'auto', 'y' or 'z', got '{axis}'")
    position = translation + np.asarray(pelvis)
    if axis == "z":
        turned = torch.from_numpy(_Y_FROM_Z_UP) @ axis_angle_to_matrix(torch.from_numpy(root))
        root = matrix_to_axis_angle(turned).numpy()
        position = position @ _Y_FROM_Z_UP.T
    return root, position - np.asarray(_SMPL_PELVIS)


def _check(motion: Motion) -> None:
    """Raise MotionError unless the arrays agree and are finite."""
    count = len(motion.poses)
    if motion.poses.shape != (count, len(JOINT_NAMES), 3) or count == 0:
        raise MotionError(
            f"motion '{motion.name}': poses: expected shape [T, {len(JOINT_NAMES)}, 3] with T >= 1, "
            f"got {list(motion.poses.shape)}"
        )
    if motion.translation.shape != (count, 3):
        raise MotionError(
            f"motion '{motion.name}': translation: expected shape [{count}, 3], "
            f"got {list(motion.translation.shape)}"
        )
    if not (np.isfinite(motion.fps) and motion.fps > 0 and motion.frame_step >= 1):
        raise MotionError(
            f"motion '{motion.name}': expected fps above 0 and frame_step of at least 1, "
            f"got {motion.fps} and {motion.frame_step}"
        )
    bad = np.argwhere(~np.isfinite(motion.poses).all(2))
    if len(bad):
        sample, joint = bad[0]
        raise MotionError(
            f"motion '{motion.name}': poses: NaN or infinity at frame {motion.frames[sample]}, "
            f"joint '{JOINT_NAMES[joint]}' ({len(bad)} bad rotations in all); repair or cut these frames"
        )
    bad = np.argwhere(~np.isfinite(motion.translation).all(1))
    if len(bad):
        raise MotionError(
            f"motion '{motion.name}': translation: NaN or infinity at frame {motion.frames[bad[0, 0]]} "
            f"({len(bad)} bad rows in all); repair or cut these frames"
        )
