"""Joint regressor and shape directions, learnt from a population in the T-pose."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from jaxtyping import Float, Int

from isp_assets.train.default_body.joint_regressor import fit_joint_regressor
from isp_assets.train.default_body.makehuman import MakeHuman
from isp_assets.train.default_body.people import random_adult
from isp_assets.train.default_body.rig import FLIP, MIRROR, PELVIS, Rig, to_t_pose
from isp_assets.train.default_body.topology import Topology

NUM_PEOPLE = 600
NUM_BETAS = 10
_SEED = 0
_MOST_BONES = 4
_LEAST_WEIGHT = 5e-3
_TOE_SPREAD = 0.005  # MakeHuman's fourth and fifth toes cut into each other: moved apart by up to this [m]
_TOE_SHARES = {"toe5": 1.0, "toe4": 0.35, "toe3": 0.0, "toe2": -0.2, "toe1": -0.35}


@dataclass(frozen=True)
class ShapeSpace:
    """Everything of the body but its pose directions."""

    template: Float[np.ndarray, "V 3"]
    shape_dirs: Float[np.ndarray, "V 3 B"]
    joint_regressor: Float[np.ndarray, "24 V"]
    weights: Float[np.ndarray, "V 24"]

    @property
    def joints(self) -> Float[np.ndarray, "24 3"]:
        """Rest joints of the mean shape [m]."""
        return self.joint_regressor @ self.template


def build_shape_space(makehuman: MakeHuman, topology: Topology, *, log: Callable[[str], None]) -> ShapeSpace:
    """Sample people, regress their joints, and take the principal directions of their shapes."""
    generator = np.random.default_rng(_SEED)
    rig = Rig(makehuman)
    weights = _limited_weights(rig.weights[topology.base_vertices], topology.mirror)
    people, joints = _population(makehuman, topology, rig, weights, generator)
    log(f"{NUM_PEOPLE} people in the T-pose")
    regressor = fit_joint_regressor(people, joints, weights, topology, generator)
    regressed = np.einsum("jv,nvd->njd", regressor, people)
    error = 1e3 * np.linalg.norm(regressed - joints, axis=2).mean(0)
    log(f"joint regressor: mean error {error.mean():.1f} mm, of the worst joint {error.max():.1f} mm")
    people = people - regressed[:, :1] + PELVIS
    template = people.mean(0)
    shape_dirs, explained = _principal_directions(people, topology)
    log(f"{NUM_BETAS} shape directions explain {100 * explained:.1f} % of the variance")
    return ShapeSpace(template, shape_dirs, regressor, weights)


def _limited_weights(
    weights: Float[np.ndarray, "V 24"], mirror: Int[np.ndarray, " V"]
) -> Float[np.ndarray, "V 24"]:
    """Symmetric weights of at most four joints a vertex, as SMPL has them."""
    weights = 0.5 * (weights + weights[mirror][:, MIRROR])
    weights[weights < _LEAST_WEIGHT] = 0
    order = np.argsort(-weights, axis=1, kind="stable")
    np.put_along_axis(weights, order[:, _MOST_BONES:], 0.0, axis=1)
    return weights / weights.sum(1, keepdims=True)


def _population(
    makehuman: MakeHuman, topology: Topology, rig: Rig, weights: Float[np.ndarray, "V 24"],
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "P V 3"], Float[np.ndarray, "P 24 3"]]:  # fmt: skip
    """Symmetric T-posed people and their joints, pelvis in place [m]."""
    smooth = _chest_smoother(makehuman, topology)
    toes = _toe_offsets(makehuman)[topology.base_vertices]
    all_vertices, all_joints = [], []
    for _ in range(NUM_PEOPLE):
        base = makehuman.shape(random_adult(generator))
        vertices, joints = to_t_pose(smooth @ base[topology.base_vertices] + toes, rig.joints(base), weights)
        vertices = 0.5 * (vertices + vertices[topology.mirror] * FLIP)
        joints = 0.5 * (joints + joints[MIRROR] * FLIP)
        all_vertices.append(vertices + (PELVIS - joints[0]))
        all_joints.append(joints + (PELVIS - joints[0]))
    return np.array(all_vertices), np.array(all_joints)


def _chest_smoother(makehuman: MakeHuman, topology: Topology) -> sp.csr_matrix:
    """Linear map that flattens the nipples: there the bi-Laplacian is made to vanish."""
    hot: set[int] = set()
    for name in ("breast/nipple-size-incr", "breast/nipple-point-incr"):
        index, offset = makehuman.target(name)
        hot |= set(index[np.linalg.norm(offset, axis=1) > 2e-4].tolist())
    inside = np.nonzero(np.isin(topology.base_vertices, list(hot)))[0]
    adjacency = mesh_adjacency(topology.faces, len(topology.base_vertices))
    laplacian = sp.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    bilaplacian = (laplacian @ laplacian).tocsr()
    outside = np.setdiff1d(np.arange(len(topology.base_vertices)), inside)
    rows = bilaplacian[inside]
    filled = spl.spsolve(rows[:, inside].tocsc(), -rows[:, outside].tocsc()).toarray()
    smoother = sp.eye(len(topology.base_vertices)).tolil()
    smoother[inside] = 0
    smoother[np.ix_(inside, outside)] = filled
    return smoother.tocsr()


def mesh_adjacency(faces: Int[np.ndarray, "F 3"], count: int) -> sp.csr_matrix:
    """1 where two vertices share an edge."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = sp.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count)).tocsr()
    return ((directed + directed.T) > 0).astype(float)


def _toe_offsets(makehuman: MakeHuman) -> Float[np.ndarray, "M 3"]:
    offsets = np.zeros_like(makehuman.vertices)
    for bone, rows in makehuman.bone_weights().items():
        share = _TOE_SHARES.get(bone[:4], 0.0)
        for vertex, weight in rows:
            offsets[vertex, 0] += share * weight * _TOE_SPREAD * np.sign(makehuman.vertices[vertex, 0])
    return offsets


def _principal_directions(
    people: Float[np.ndarray, "P V 3"], topology: Topology
) -> tuple[Float[np.ndarray, "V 3 B"], float]:
    """Area-weighted principal directions for coefficients of unit variance; the variance they explain."""
    mean, faces = people.mean(0), topology.faces
    corners = mean[faces]
    third = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 6
    area = np.bincount(faces.ravel(), weights=np.repeat(third, 3), minlength=len(mean))
    area = area / area.sum()
    centred = people - mean
    scores, spread, _ = np.linalg.svd(
        (centred * np.sqrt(area)[:, None]).reshape(len(people), -1), full_matrices=False
    )
    betas = scores[:, :NUM_BETAS] * np.sqrt(len(people))
    directions = np.einsum("nvd,nk->vdk", centred, betas) / len(people)
    # The sign of a direction is arbitrary: the first shall make taller, the others larger.
    height = np.ptp(people[:, :, 1], axis=1)
    for k in range(NUM_BETAS):
        step = directions[:, :, k]
        growth = _volume(mean + step, faces) - _volume(mean - step, faces)
        directions[:, :, k] *= np.sign(np.corrcoef(betas[:, 0], height)[0, 1] if k == 0 else growth)
    directions = 0.5 * (directions + directions[topology.mirror] * FLIP[:, None])
    return directions, float((spread[:NUM_BETAS] ** 2).sum() / (spread**2).sum())


def _volume(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
