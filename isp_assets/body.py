"""The body: a mesh in SMPL's format, and its forward pass.

Positions are in metres, Y up, facing +Z. ``Body.load("default")`` gives the free
body that ships with this package; official SMPL ``.npz`` and ``.pkl`` files load
the same way. The shape coefficients (betas) of different bodies mean different
things: never carry betas from one body file to another.

Reference: Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.conventions import JOINT_NAMES, JOINT_PARENTS
from isp_assets.errors import BodyError
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.safe_pickle import read_smpl_pickle

_DEFAULT_FILE = Path(__file__).parent / "data" / "default_body.npz"
_JOINTS = len(JOINT_NAMES)
_POSE_FEATURES = 9 * (_JOINTS - 1)
_NO_PARENT = 4294967295  # how SMPL files write -1: the root's parent, wrapped round to 32 unsigned bits
_REAL_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights")
_KEYS = (*_REAL_KEYS, "f", "kintree_table")

BETA_PRESETS: dict[str, list[float]] = {
    "man": [0.95, 1.05, -0.60, 0.05, -0.13, -0.14, -0.43, -0.55, -1.22, 0.16],
    "woman": [-0.77, -0.72, 0.02, -0.05, -0.72, -0.29, 0.36, 0.95, 0.49, 0.63],
    "neutral": [0.0] * 10,
}
"""Shape coefficients of the default body: a man of 1.77 m, a woman of 1.63 m, the mean of 1.69 m."""


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body over T frames, in world space."""

    vertices: Float[Tensor, "T N 3"]
    """Skin positions [m]."""
    joints: Float[Tensor, "T 24 3"]
    """Joint positions [m]."""
    joint_transforms: Float[Tensor, "T 24 4 4"]
    """Skinning transforms, world from rest: ``v = sum_k w_k A_k [v_rest; 1]``, translation included."""
    pose_feature: Float[Tensor, "T 207"]
    """``R - I`` of joints 1 to 23, row-major: what the pose blend shapes multiply."""


@dataclass(frozen=True, eq=False)
class Body:
    """A skinned body of N vertices, F faces, 24 joints and B shape directions; checked at construction."""

    template: Float[Tensor, "N 3"]
    """Rest positions of the mean shape [m]."""
    faces: Int[Tensor, "F 3"]
    shape_dirs: Float[Tensor, "N 3 B"]
    """Displacement [m] per unit of each shape coefficient."""
    pose_dirs: Float[Tensor, "N 3 207"]
    """Displacement [m] per unit of each pose feature, in rest space."""
    joint_regressor: Float[Tensor, "24 N"]
    """Joint positions = regressor @ shaped vertices; rows sum to 1."""
    weights: Float[Tensor, "N 24"]
    """Skinning weights; rows sum to 1."""
    parents: tuple[int, ...]
    name: str
    sha256: str
    """Digest of the numeric content at float32: the same body has one digest, whatever file it came from."""

    def __post_init__(self) -> None:
        _check(self)

    @classmethod
    def load(cls, source: str | Path = "default") -> "Body":
        """Read a body on the CPU in float32.

        Args:
            source: ``"default"``, or the path of an SMPL ``.npz`` or ``.pkl`` file (24 joints).

        Raises:
            BodyError: If the file is missing, lacks a key, or holds something that is no SMPL body.
        """
        path = _DEFAULT_FILE if source == "default" else Path(source)
        name = "default" if source == "default" else path.stem
        return _from_arrays(_read(path), name=name, where=str(path))

    def shaped(self, betas: Float[Tensor, "*frames K"] | None = None) -> Float[Tensor, "*frames N 3"]:
        """Rest positions [m] for K <= B shape coefficients; the missing ones count as zero."""
        if betas is None:
            return self.template
        count = betas.shape[-1]
        if count > self.shape_dirs.shape[-1]:
            raise BodyError(
                f"betas: body '{self.name}' has {self.shape_dirs.shape[-1]} shape coefficients, got {count}; "
                "pass no more than the body has (betas belong to one body file)"
            )
        directions = self.shape_dirs[..., :count]
        return self.template + torch.einsum("...b,ncb->...nc", betas.to(self.template), directions)

    def pose(
        self,
        poses: Float[Tensor, "T 24 3"],
        *,
        betas: Float[Tensor, "*frames K"] | None = None,
        translation: Float[Tensor, "T 3"] | None = None,
    ) -> PosedBody:
        """Pose the body; differentiable in every argument.

        Args:
            poses: Axis-angle rotation of each joint relative to its parent [rad].
            betas: Shape coefficients, ``[K]`` for all frames or ``[T, K]``, K <= B.
            translation: Added to every position [m]; the root turns about the rest pelvis joint.

        Raises:
            BodyError: If the shapes do not agree or there are more betas than the body has.
        """
        poses = poses.to(self.template)
        _check_pose_arguments(poses, betas, translation)
        frames = poses.shape[0]
        shaped = self.shaped(betas)
        rest_joints = (self.joint_regressor @ shaped).expand(frames, -1, -1)
        rotations = axis_angle_to_matrix(poses)
        identity = torch.eye(3, dtype=poses.dtype, device=poses.device)
        feature = (rotations[:, 1:] - identity).flatten(1)
        world = _joint_frames(rotations, rest_joints, self.parents)
        if translation is not None:
            world = _translate(world, translation.to(poses))
        transforms = _relative_to_rest(world, rest_joints)
        corrected = shaped + (feature @ self.pose_dirs.flatten(0, 1).T).unflatten(-1, (-1, 3))
        return PosedBody(
            vertices=_skin(corrected, self.weights, transforms),
            joints=world[..., :3, 3],
            joint_transforms=transforms,
            pose_feature=feature,
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Body":
        """A copy on another device or in another floating type (faces stay integers)."""
        fields = ("template", "shape_dirs", "pose_dirs", "joint_regressor", "weights")
        moved = {field: getattr(self, field).to(device=device, dtype=dtype) for field in fields}
        return replace(self, faces=self.faces.to(device=device), **moved)


def _joint_frames(
    rotations: Float[Tensor, "T 24 3 3"], rest_joints: Float[Tensor, "T 24 3"], parents: tuple[int, ...]
) -> Float[Tensor, "T 24 4 4"]:
    """World from joint, by walking the tree from the root."""
    parent_index = list(parents[1:])
    offsets = torch.cat([rest_joints[:, :1], rest_joints[:, 1:] - rest_joints[:, parent_index]], 1)
    bottom = rotations.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rotations.shape[:2], 1, 4)
    local = torch.cat([torch.cat([rotations, offsets[..., None]], -1), bottom], -2)
    world = [local[:, 0]]
    for joint, parent in enumerate(parent_index, start=1):
        world.append(world[parent] @ local[:, joint])
    return torch.stack(world, 1)


def _translate(
    transforms: Float[Tensor, "T 24 4 4"], translation: Float[Tensor, "T 3"]
) -> Float[Tensor, "T 24 4 4"]:
    return transforms + torch.nn.functional.pad(translation[:, None, :, None], (3, 0, 0, 1))


def _relative_to_rest(
    world: Float[Tensor, "T 24 4 4"], rest_joints: Float[Tensor, "T 24 3"]
) -> Float[Tensor, "T 24 4 4"]:
    """World from rest: undo the joint's rest position, then apply its world frame."""
    moved = world[..., :3, :3] @ rest_joints[..., None]
    return world - torch.nn.functional.pad(moved, (3, 0, 0, 1))


def _skin(
    rest: Float[Tensor, "T N 3"], weights: Float[Tensor, "N 24"], transforms: Float[Tensor, "T 24 4 4"]
) -> Float[Tensor, "T N 3"]:
    """Linear blend skinning: blend the upper 3x4 of the transforms, then apply them."""
    blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ rest[..., None]).squeeze(-1) + blended[..., 3]


def _check_pose_arguments(poses: Tensor, betas: Tensor | None, translation: Tensor | None) -> None:
    if poses.ndim != 3 or poses.shape[1:] != (_JOINTS, 3):
        raise BodyError(
            f"poses: expected [T, {_JOINTS}, 3] axis-angle, got {list(poses.shape)}; "
            "reshape [T, 72] with .reshape(-1, 24, 3)"
        )
    frames = poses.shape[0]
    if betas is not None and tuple(betas.shape[:-1]) not in ((), (1,), (frames,)):
        raise BodyError(f"betas: expected [K] or [{frames}, K] for {frames} frames, got {list(betas.shape)}")
    if translation is not None and tuple(translation.shape) != (frames, 3):
        got = list(translation.shape)
        raise BodyError(f"translation: expected [{frames}, 3] for {frames} frames, got {got}")


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise BodyError(f"{path}: no such body file; give 'default' or the path of an SMPL .npz or .pkl file")
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as data:
                return {key: data[key] for key in data.files}
        except (ValueError, OSError) as error:
            raise BodyError(f"{path}: not a readable .npz of plain arrays ({error})") from error
    if path.suffix == ".pkl":
        return read_smpl_pickle(path, _KEYS)
    raise BodyError(f"{path}: expected a file ending in .npz or .pkl, got '{path.suffix}'")


def _from_arrays(data: Mapping[str, Any], *, name: str, where: str) -> Body:
    """Build a body from the arrays of an SMPL file, whatever their number types."""
    missing = [key for key in _KEYS if key not in data]
    if missing:
        raise BodyError(
            f"{where}: expected the SMPL keys {', '.join(_KEYS)}; missing {', '.join(missing)}; "
            f"found {', '.join(sorted(data)) or 'nothing'}"
        )
    for key in _KEYS:
        if np.asarray(data[key]).dtype.kind not in "fiu":
            raise BodyError(f"{where}: {key}: expected numbers, got type {np.asarray(data[key]).dtype}")
    # Adding 0 turns -0 into 0, which is equal but would change the digest.
    real = {key: np.ascontiguousarray(data[key], dtype=np.float32) + 0 for key in _REAL_KEYS}
    faces = np.ascontiguousarray(data["f"]).astype(np.int64)
    tree = np.asarray(data["kintree_table"]).astype(np.int64)
    if tree.ndim != 2 or tree.shape[1] != _JOINTS:
        raise BodyError(
            f"{where}: kintree_table: expected 2 rows of {_JOINTS} joints, got shape {list(tree.shape)}; "
            "SMPL-H and SMPL-X bodies are not supported, use the SMPL file"
        )
    parents = tuple(-1 if parent in (_NO_PARENT, -1) else int(parent) for parent in tree[0])
    return Body(
        template=torch.from_numpy(real["v_template"]),
        faces=torch.from_numpy(faces),
        shape_dirs=torch.from_numpy(real["shapedirs"]),
        pose_dirs=torch.from_numpy(real["posedirs"]),
        joint_regressor=torch.from_numpy(real["J_regressor"]),
        weights=torch.from_numpy(real["weights"]),
        parents=parents,
        name=name,
        sha256=_digest([*real.values(), faces, np.asarray(parents, dtype=np.int64)]),
    )


def _digest(arrays: list[np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(str((array.dtype.str, array.shape)).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _check(body: Body) -> None:
    """Raise BodyError unless the arrays agree with one another."""
    count = body.template.shape[0]
    expected = {
        "template": (count, 3),
        "faces": (body.faces.shape[0], 3),
        "shape_dirs": (count, 3, body.shape_dirs.shape[-1]),
        "pose_dirs": (count, 3, _POSE_FEATURES),
        "joint_regressor": (_JOINTS, count),
        "weights": (count, _JOINTS),
    }
    for field, shape in expected.items():
        got = tuple(getattr(body, field).shape)
        if got != shape:
            raise BodyError(f"body '{body.name}': {field}: expected shape {list(shape)}, got {list(got)}")
        if field != "faces" and not torch.isfinite(getattr(body, field)).all():
            raise BodyError(f"body '{body.name}': {field}: holds NaN or infinity; the file is damaged")
    if body.parents != tuple(JOINT_PARENTS):
        raise BodyError(
            f"body '{body.name}': parents: expected SMPL's joint tree {list(JOINT_PARENTS)}, "
            f"got {list(body.parents)}"
        )
    low, high = (int(body.faces.min()), int(body.faces.max())) if body.faces.numel() else (0, 0)
    if low < 0 or high >= count:
        raise BodyError(
            f"body '{body.name}': faces: expected vertex numbers in 0..{count - 1}, got {low}..{high}"
        )
    deviation = (body.weights.double().sum(1) - 1).abs()
    if bool((deviation > 1e-2).any()):
        worst = int(deviation.argmax())
        total = float(body.weights[worst].sum())
        raise BodyError(
            f"body '{body.name}': weights: expected rows that sum to 1; row {worst} sums to {total:g}"
        )
