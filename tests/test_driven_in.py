"""Clear cloth that was driven into the skin goes back: by its depth, near creases, where it has room."""

import numpy as np
import pytest
import torch
from collision_shapes import ball, collision, obstacle

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.drape import DrapeOptions, drape
from isp_assets.dressing import dress
from isp_assets.evaluate.frames import FrameMeter
from isp_assets.evaluate.stress_motions import deep_squat
from isp_assets.geometry import projection
from isp_assets.geometry.buried import BodyObstacle
from isp_assets.geometry.driven_in import driven_in
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.shot import Shot
from isp_assets.train.leg_ik import Figure


@pytest.fixture(scope="module")
def shot() -> Shot:
    """A shallow squat with arms held forward: creases in front of the armpits."""
    body = Body.load("default")
    return Shot("squat", body, deep_squat(Figure.of(body), [10.0]))


@pytest.fixture(scope="module")
def skin(shot: Shot) -> BodyObstacle:
    posed = shot.body.pose(torch.as_tensor(shot.motion.poses, dtype=torch.float32))
    mesh = CollisionMesh.build(shot.body.faces.numpy(), shot.body.weights.numpy())
    return BodyObstacle(mesh, posed.vertices[0].numpy(), margin=0.003)


@pytest.fixture(scope="module")
def tee() -> CollisionMesh:
    body = Body.load("default")
    return dress(Collection.load().outfit(["tee"]), body, torch.zeros(10), resolution=64)[0].collision


def _draped(shot: Shot) -> tuple[np.ndarray, dict[str, float]]:
    """A tee in the body's own frame, and its figures."""
    frames = drape(Collection.load().outfit(["tee"]), shot, DrapeOptions(resolution=64))
    (chunk,) = list(frames)
    layer = frames.scene.layers[0].name
    figures = FrameMeter(frames.scene).measure(chunk, 0)
    names = ("body_area_percent", "strain_p99")
    cloth = chunk.layers[0][0].astype(float) - shot.motion.translation[0]
    return cloth, {name: figures[f"final/{layer}/{name}"] for name in names}


def test_no_skin_shows_in_front_of_the_armpits(shot: Shot) -> None:
    _, kept = _draped(shot)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(projection, "driven_in", lambda position, *other, tight: np.zeros(len(position)))
        _, driven = _draped(shot)
    assert driven["body_area_percent"] > 0.05
    assert kept["body_area_percent"] < 0.02
    assert kept["strain_p99"] < driven["strain_p99"] + 0.03


def test_cloth_goes_back_by_its_depth_and_only_with_room(
    shot: Shot, skin: BodyObstacle, tee: CollisionMesh
) -> None:
    start, _ = _draped(shot)
    free = np.zeros(len(start), bool)
    found = skin.whole(start)
    crease, buried = (
        np.linalg.norm(start[:, None] - skin.vertices[rows][None], axis=2).min(axis=1, initial=1.0)
        for rows in (skin.tight, skin.blocked)
    )
    sure = (crease < 0.04) & (buried > 0.05) & (found.height > 0.002) & (found.height < 0.01)
    chosen = np.flatnonzero(sure & ~skin.winding.inside(start))[:1]
    assert len(chosen) == 1

    def share(depth: float, tight: np.ndarray, body: BodyObstacle = skin) -> float:
        position = start.copy()
        position[chosen] = found.point[chosen] - depth * found.normal[chosen]
        return float(driven_in(position, start, tee, body, tight=tight)[chosen[0]])

    assert share(0.0008, free) == 0
    assert 0.2 < share(0.0025, free) < 0.8
    assert share(0.006, free) == 1
    tight = free.copy()
    tight[np.unique(tee.topology.faces[(tee.topology.faces == chosen[0]).any(axis=1)])] = True
    assert share(0.006, tight) == 0
    assert not driven_in(start, start, tee, skin, tight=free).any()
    beside = BodyObstacle(skin.mesh, skin.vertices, margin=skin.margin)
    beside.depth_in = np.zeros_like(skin.depth_in)
    beside.depth_in[np.linalg.norm(skin.vertices - start[chosen[0]], axis=1).argmin()] = 0.01
    assert share(0.006, free, beside) == 0  # next to skin that another part hides


def test_skin_without_creases_sends_nothing_back() -> None:
    body, (cloth, faces) = obstacle(ball(0.1)), ball(0.104)
    sunk = driven_in(0.9 * cloth, cloth, collision((cloth, faces)), body, tight=np.zeros(len(cloth), bool))
    assert not sunk.any()
