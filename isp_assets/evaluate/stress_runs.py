"""Ways to drape a stress case other than plainly: placed contact, smoothing, other numbers, other devices."""

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from torch import Tensor, nn

from isp_assets.body import PosedBody
from isp_assets.conventions import PANELS
from isp_assets.dressing import WornGarment, dress
from isp_assets.evaluate.stress_case import StressCase, StressRun, drape_case
from isp_assets.evaluate.temporal import skin_beneath
from isp_assets.garment import Garment
from isp_assets.geometry.closest import SurfaceNormals
from isp_assets.geometry.contact import Surface
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.projection import Projection, project
from isp_assets.layering import correct_layer
from isp_assets.motion import Motion
from isp_assets.networks.drape_field import DrapeField
from isp_assets.networks.layering_net import LayeringNet
from isp_assets.outfit import Outfit

_GAP = 0.006  # that the outer of two placed copies keeps over the inner [m]
_BACK_FADE = 0.06  # distance from the seams at which contact of the back reaches its depth [m]
_SIDE_FADE = 0.05  # distance from a side seam at which its contact ends [m]
_SIDES = ("side", "outseam")  # how the names of side seams begin

Region = Callable[[Garment, dict[int, str]], Float[np.ndarray, " V"]]
"""Share of the depth, 0..1, that each vertex of a garment gets; from the garment and its edges' names."""


def placed_contact(region: Region) -> Callable[[StressCase], StressRun]:
    """Contact only where ``region`` says: a copy of the inner layer around itself, into which it is pushed.

    The case's outfit is one garment twice. The inner copy is draped; the outer one
    starts 6 mm above it, and the inner one is moved through it by the sweep's value [mm].
    """

    def run(case: StressCase) -> StressRun:
        alone = replace(case.outfit, items=case.outfit.items[:1])
        base = drape_case(replace(case, outfit=alone, run=None))
        worn = _worn(case)
        garment = worn[0].layer.garment
        share = region(garment, dict(case.outfit.items[0].bundle.model.edge_names))
        out = np.stack([SurfaceNormals(p.astype(float), garment.faces).of_vertices for p in base.layers[0]])
        depth = np.array(case.values)[:, None] / 1000
        inner = base.layers[0] + (share * (_GAP + depth))[..., None] * out
        outer = base.layers[0] + _GAP * out
        start = time.perf_counter()
        lifted, settled = _settle(case, worn[1], inner, outer)
        return StressRun(
            scene=replace(base.scene, layers=tuple(w.layer for w in worn)),
            body=base.body,
            layers=(inner.astype(np.float32), settled),
            before=(inner.astype(np.float32), lifted),
            placed=1,
            seconds=base.seconds + time.perf_counter() - start,
        )

    return run


def at_the_back(garment: Garment, names: dict[int, str]) -> Float[np.ndarray, " V"]:
    """1 on the back panel away from the seams, 0 on the front."""
    share = np.zeros(garment.num_vertices)
    panel = garment.panels[PANELS[1]]
    sewn = np.concatenate([seam.back for seam in garment.seams])
    share[panel.vertex_index] = _ramp(panel.panel_xy, panel.panel_xy[sewn], _BACK_FADE)
    return share


def along_the_sides(garment: Garment, names: dict[int, str]) -> Float[np.ndarray, " V"]:
    """1 on the side seams, 0 from 5 cm beside them."""
    share = np.zeros(garment.num_vertices)
    sides = [seam for seam in garment.seams if names[seam.labels[0]].startswith(_SIDES)]
    for side, panel in garment.panels.items():
        sewn = np.concatenate([getattr(seam, side) for seam in sides])
        near = 1 - _ramp(panel.panel_xy, panel.panel_xy[sewn], _SIDE_FADE)
        share[panel.vertex_index] = np.maximum(share[panel.vertex_index], near)
    return share


def smoothed(width: int) -> Callable[[StressCase], StressRun]:
    """Average over ``width`` frames how the finished cloth lies to its skin, then project once more."""

    def run(case: StressCase) -> StressRun:
        base = drape_case(replace(case, run=None))
        calm = tuple(_calmed(positions, base.body, width) for positions in base.layers)
        start = time.perf_counter()
        worn = _worn(case)
        skin = _body_collision(case)
        done = [np.empty_like(p) for p in calm]
        for t, body in enumerate(base.body):
            beneath = [Obstacle(skin, body, margin=case.options.body_margin)]
            for garment, before, after in zip(worn, calm, done, strict=True):
                found = _projected(case, garment, before[t], beneath)
                after[t] = found.vertices
                margin = case.options.layer_margin
                beneath.append(Obstacle(garment.collision, after[t], margin=margin, tight=found.tight))
        seconds = base.seconds + time.perf_counter() - start
        return replace(base, layers=tuple(done), before=calm, seconds=seconds)

    return run


def compared_with(
    *, motion: Motion | None = None, every: int = 1, change: Callable[[StressCase], StressCase] | None = None
) -> Callable[[StressCase], StressRun]:
    """Drape plainly, and note the distance of every vertex from another run.

    Args:
        motion: What the other run moves like, if not like the case.
        every: The frame of the case that is the second frame of the other run.
        change: What else differs in the other run.
    """

    def run(case: StressCase) -> StressRun:
        plain = replace(case, run=None)
        own = drape_case(plain)
        other = plain if change is None else change(plain)
        if motion is not None:
            values = (0.0,) * len(motion)
            other = replace(other, values=values, shot=replace(other.shot, motion=motion))
        reference = drape_case(other)
        return replace(
            own,
            difference=_distance(own.layers, reference.layers, every),
            difference_before=_distance(own.before or (), reference.before or (), every),
        )

    return run


def lower_precision(outfit: Outfit, dtype: torch.dtype) -> Outfit:
    """The outfit with displacement and layering networks that compute in 16 bits."""
    items = tuple(
        replace(item, bundle=replace(item.bundle, drape_field=_rounded_field(item.bundle.drape_field, dtype)))
        for item in outfit
    )
    layering = outfit.layering
    if layering is not None:
        network: LayeringNet = copy.deepcopy(layering.layering_net).to(dtype)
        _cast_calls(network, dtype)
        layering = replace(layering, layering_net=network)
    return replace(outfit, items=items, layering=layering)


def _rounded_field(field: DrapeField | None, dtype: torch.dtype) -> DrapeField | None:
    if field is None:
        return None
    field = copy.deepcopy(field)
    for parameter in field.parameters():
        parameter.data = parameter.data.to(dtype).float()
    field.mlp.to(dtype)
    _cast_calls(field.mlp, dtype)
    return field


def _cast_calls(network: nn.Module, dtype: torch.dtype) -> None:
    """Let a network of ``dtype`` be called with, and give back, float32."""
    network.register_forward_pre_hook(lambda module, inputs: tuple(x.to(dtype) for x in inputs))
    network.register_forward_hook(lambda module, inputs, output: output.float())


def _settle(
    case: StressCase, worn: WornGarment, inner: Float[np.ndarray, "T V 3"], outer: Float[np.ndarray, "T V 3"]
) -> tuple[Float[np.ndarray, "T V 3"], Float[np.ndarray, "T V 3"]]:
    """The outer layer after the layering network, and after projection."""
    posed = _posed(case)
    skin, body_mesh = posed.vertices.numpy(), _body_collision(case)
    vertices = torch.as_tensor(outer, dtype=torch.float32)
    if worn.layering is not None:
        placed = Surface.of_mesh(torch.as_tensor(inner, dtype=torch.float32), worn.faces, reach=0.05)
        beneath = [Surface.of_mesh(posed.vertices, case.shot.body.faces), placed]
        vertices = _corrected(worn, vertices, beneath, posed)
    lifted = vertices.numpy()
    settled = np.empty_like(lifted)
    for t, positions in enumerate(inner):
        obstacles = [
            Obstacle(body_mesh, skin[t], margin=case.options.body_margin),
            Obstacle(worn.collision, positions, margin=case.options.layer_margin),
        ]
        settled[t] = _projected(case, worn, lifted[t], obstacles).vertices
    return lifted, settled


@torch.no_grad()
def _corrected(
    worn: WornGarment, vertices: Float[Tensor, "T V 3"], beneath: Sequence[Surface], posed: PosedBody
) -> Float[Tensor, "T V 3"]:
    assert worn.layering is not None
    return correct_layer(worn.layering, vertices, beneath, posed, ramp=worn.ramp)[0]


def _projected(
    case: StressCase, worn: WornGarment, vertices: Float[np.ndarray, "V 3"], beneath: Sequence[Obstacle]
) -> Projection:
    options = case.options.projection
    return project(vertices, worn.collision, beneath, options, stretch=worn.stretch)


def _posed(case: StressCase) -> PosedBody:
    motion = case.shot.motion
    return case.shot.body.pose(
        torch.as_tensor(motion.poses, dtype=torch.float32),
        betas=torch.as_tensor(case.shot.betas, dtype=torch.float32),
        translation=torch.as_tensor(motion.translation, dtype=torch.float32),
    )


def _distance(
    own: Sequence[Float[np.ndarray, "T _ 3"]], others: Sequence[Float[np.ndarray, "S _ 3"]], every: int
) -> Float[np.ndarray, " T"]:
    """Largest distance of a vertex in the frames that both runs have, 0 in the others."""
    difference = np.zeros(len(own[0]))
    for mine, theirs in zip(own, others, strict=True):
        shared = difference[::every][: len(theirs)]
        shared[:] = np.maximum(shared, np.linalg.norm(mine[::every][: len(theirs)] - theirs, axis=2).max(1))
    return difference


def _calmed(
    positions: Float[np.ndarray, "T V 3"], body: Float[np.ndarray, "T N 3"], width: int
) -> Float[np.ndarray, "T V 3"]:
    """Offsets from the skin beneath, averaged over time; so cloth does not lag behind a walking body."""
    skin = body[:, skin_beneath(positions[0], body[0])]
    return skin + uniform_filter1d(positions - skin, width, axis=0, mode="nearest")


def _worn(case: StressCase) -> tuple[WornGarment, ...]:
    betas = torch.as_tensor(case.shot.betas, dtype=torch.float32)
    return dress(case.outfit, case.shot.body, betas, resolution=case.options.resolution)


def _body_collision(case: StressCase) -> CollisionMesh:
    return CollisionMesh.build(case.shot.body.faces.numpy(), case.shot.body.weights.numpy())


def _ramp(
    points: Float[np.ndarray, "P 2"], border: Float[np.ndarray, "n 2"], length: float
) -> Float[np.ndarray, " P"]:
    """0 on the border, rising to 1 at ``length``."""
    distance = np.linalg.norm(points[:, None] - border[None], axis=2).min(1)
    return np.clip(distance / length, 0, 1)


__all__ = ["along_the_sides", "at_the_back", "compared_with", "lower_precision", "placed_contact", "smoothed"]
