"""Drape an outfit over a shot: the ladder of solvers, chunk by chunk.

Rungs, in order: ``skin`` (Eqs. 6-7), ``displace`` (D_s), ``tuck`` (a wide inner layer gives
way to a held one worn over it), ``layering`` (D_m, Eqs. 9-12), ``project`` (leaves no contact),
``relax`` (moves what a pose strains as a whole).
Each layer is corrected once against everything beneath it, so the cost of layering grows
linearly with the number of layers. A rung that a frame does not need is skipped there, and
the chunk says what ran.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import PosedBody
from isp_assets.clearing import RELAXED_STRAIN, Calm, clear_layer, relax_layer
from isp_assets.conventions import NUM_JOINTS, FrameRange
from isp_assets.displacement import displace, displacements
from isp_assets.drape_features import drape_features
from isp_assets.drape_state import ChunkState, note
from isp_assets.dressing import WornGarment, dress
from isp_assets.errors import DrapeError
from isp_assets.frames import DrapedFrames, FrameChunk, Scene, StageTimes
from isp_assets.geometry.buried import BodyObstacle, HomeSkin, lay_on_skin
from isp_assets.geometry.contact import Surface
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.projection import BODY_MARGIN, LAYER_MARGIN, Projection, ProjectionOptions
from isp_assets.layering import correct_layer
from isp_assets.outfit import Outfit
from isp_assets.shot import DEFAULT_RESOLUTION, Shot
from isp_assets.skinning import skin_garment
from isp_assets.tucking import Tucking

STEPS = ("skin", "displace", "tuck", "layering", "project", "relax")


@dataclass(frozen=True)
class DrapeOptions:
    """What to run, and where."""

    steps: tuple[str, ...] = STEPS
    """Rungs to run; ``skin`` is always needed."""
    resolution: int = DEFAULT_RESOLUTION
    """Grid cells across a panel, 32 to 512."""
    chunk: int = 8
    """Frames held at once."""
    device: str = "cpu"
    body_margin: float = BODY_MARGIN
    """Clearance that projection leaves over the body [m]."""
    layer_margin: float = LAYER_MARGIN
    """Clearance that projection leaves over an inner garment [m]."""
    projection: ProjectionOptions = field(default_factory=ProjectionOptions)
    smoothing: float = 0.0
    """Share of the frame before in what projection moves, 0 to below 1: calms what flickers where cloth
    is caught between surfaces, for a second, short projection a frame. Frames then depend on those before."""
    strain: float = RELAXED_STRAIN
    """Strain (p99) of a layer that relaxing leaves alone, .1 to .5; less costs time. Hard poses, cloth
    on other cloth, tucked hems and armholes keep more than that, up to .28."""
    keep_stages: bool = False
    """Keep the positions after every rung, to measure what each one did."""

    def __post_init__(self) -> None:
        unknown = [s for s in self.steps if s not in STEPS]
        if unknown or "skin" not in self.steps:
            raise DrapeError(
                f"steps must be some of {', '.join(STEPS)}, with skin; got {', '.join(self.steps)}"
            )
        if not 0 <= self.smoothing < 1:
            raise DrapeError(f"smoothing must be at least 0 and below 1, got {self.smoothing:g}")
        if not 0.1 <= self.strain <= 0.5:
            raise DrapeError(f"strain must be .1 to .5, got {self.strain:g}")
        if self.chunk < 1:
            raise DrapeError(f"chunk must be at least 1 frame, got {self.chunk}")


def drape(outfit: Outfit, shot: Shot, options: DrapeOptions | None = None) -> DrapedFrames:
    """Drape an outfit over a shot.

    Decoding and binding happen here; frames are draped while the result is iterated.

    Args:
        outfit: Garments, innermost first.
        shot: The body in motion.
        options: Rungs, device, chunk size.

    Raises:
        DrapeError: If the shot's body is not the outfit's, or a result is not finite.
        DecodeError: If a code gives no valid garment.
    """
    options = options or DrapeOptions()
    draper = Draper(outfit, shot, options)
    return DrapedFrames(draper.scene, (draper.chunk(rows) for rows in chunk_rows(shot, options)))


def chunk_rows(shot: Shot, options: DrapeOptions) -> list[slice]:
    """The rows of a shot's motion that are draped together, in order."""
    starts = range(0, len(shot.motion), options.chunk)
    return [slice(start, start + options.chunk) for start in starts]


class Draper:
    """An outfit decoded and bound for a shot; drapes any chunk of its frames.

    Args:
        outfit: Garments, innermost first.
        shot: The body in motion.
        options: Rungs, device, chunk size.

    Raises:
        DrapeError: If the shot's body is not the outfit's.
        DecodeError: If a code gives no valid garment.
    """

    def __init__(self, outfit: Outfit, shot: Shot, options: DrapeOptions) -> None:
        if shot.body.sha256 != outfit.body_sha256:
            raise DrapeError(
                f"shot {shot.name!r}: body {shot.body.name!r} ({shot.body.sha256[:12]}) is not the body that "
                f"the outfit was trained on ({outfit.body_sha256[:12]})"
            )
        self.shot, self.options = shot, options
        self.body = shot.body.to(options.device)
        self.betas = torch.as_tensor(shot.betas, dtype=torch.float32, device=options.device)
        worn = dress(outfit, self.body, self.betas, resolution=options.resolution, device=options.device)
        self.body_collision = CollisionMesh.build(shot.body.faces.numpy(), shot.body.weights.numpy())
        self.tucking = self._tucking(worn) if "tuck" in options.steps and len(worn) > 1 else None
        self.worn = self.tucking.worn if self.tucking else worn
        self.homes = [
            HomeSkin.find(
                w.skin.canonical.cpu().double().numpy(),
                shot.body.template.double().numpy(),
                self.body_collision,
            )
            for w in self.worn
        ]
        self.calm = [Calm(options.smoothing, options.projection) for _ in self.worn]
        numbers = shot.motion.frames
        self.scene = Scene(
            name=shot.name,
            body_faces=shot.body.faces.numpy(),
            layers=tuple(w.layer for w in self.worn),
            frames=FrameRange(int(numbers[0]), int(numbers[-1]), shot.motion.frame_step),
            fps=shot.motion.fps,
        )

    @torch.no_grad()
    def _tucking(self, worn: tuple[WornGarment, ...]) -> Tucking:
        """Find what is tucked in at rest."""
        posed = self.body.pose(torch.zeros(1, NUM_JOINTS, 3, device=self.options.device), betas=self.betas)
        rest = [skin_garment(garment.skin, posed, self.betas)[0][0] for garment in worn]
        skin = Obstacle(self.body_collision, posed.vertices[0].cpu().numpy(), margin=self.options.body_margin)
        return Tucking(worn, [vertices.cpu().numpy().astype(np.float64) for vertices in rest], skin)

    @torch.no_grad()
    def chunk(self, rows: slice) -> FrameChunk:
        """Drape some frames; with smoothing, they must follow those of the call before.

        Raises:
            DrapeError: If a result is not finite.
        """
        motion, device = self.shot.motion, self.options.device
        state = ChunkState()
        with state.timed("body"):
            posed = self.body.pose(
                torch.as_tensor(motion.poses[rows], dtype=torch.float32, device=device),
                betas=self.betas,
                translation=torch.as_tensor(motion.translation[rows], dtype=torch.float32, device=device),
            )
        skin = posed.vertices.cpu().numpy()
        state.beneath = [Surface.of_mesh(posed.vertices, self.body.faces)]
        margin = self.options.body_margin
        state.bodies = [BodyObstacle(self.body_collision, v, margin=margin) for v in skin]
        alone = [self._drape_alone(worn, posed, state) for worn in self.worn]
        self._tuck(alone, state)
        layers = tuple(self._settle(index, vertices, posed, state) for index, vertices in enumerate(alone))
        frames = motion.frames[rows]
        self._check_finite(layers, frames)
        return FrameChunk(
            frames=frames,
            body=skin,
            layers=layers,
            times=StageTimes(state.seconds),
            stages={name: tuple(positions) for name, positions in state.stages.items()},
            steps=tuple(tuple(tuple(layer[t]) for layer in state.steps) for t in range(len(frames))),
        )

    def _drape_alone(self, worn: WornGarment, posed: PosedBody, state: ChunkState) -> Float[Tensor, "T V 3"]:
        """One garment as if it were the only one."""
        ran: list[list[str]] = [["skin"] for _ in range(len(posed.vertices))]
        with state.timed("skin"):
            vertices, rotations = skin_garment(worn.skin, posed, self.betas)
        state.skinned.append(vertices)
        state.keep("skin", vertices, self.options.keep_stages)
        if "displace" in self.options.steps and worn.displacement is not None and worn.field is not None:
            with state.timed("displace"):
                features = drape_features(posed, self.betas, worn.code, num_betas=worn.field.config.num_betas)
                moved = displacements(worn.displacement, worn.field, features)
                vertices = displace(vertices, rotations, moved)
            note(ran, "displace")
        state.keep("displace", vertices, self.options.keep_stages)
        state.steps.append(ran)
        return vertices

    def _tuck(self, layers: list[Float[Tensor, "T _ 3"]], state: ChunkState) -> None:
        """Let wide inner layers give way to held layers over them; replaces entries of ``layers``."""
        if self.tucking is not None:
            with state.timed("tuck"):
                layers[:] = [vertices.clone() for vertices in layers]
                for t, body in enumerate(state.bodies):
                    before = [vertices[t].cpu().numpy().astype(np.float64) for vertices in layers]
                    for index, after in enumerate(self.tucking.frame(before, body)):
                        if after is not before[index]:
                            layers[index][t] = torch.as_tensor(after).to(layers[index])
                            state.steps[index][t].append("tuck")
        for vertices in layers:
            state.keep("tuck", vertices, self.options.keep_stages)

    def _settle(
        self, index: int, vertices: Float[Tensor, "T V 3"], posed: PosedBody, state: ChunkState
    ) -> Float[np.ndarray, "T V 3"]:
        """Correct one garment against everything beneath it, and add it to what lies beneath."""
        worn, ran = self.worn[index], state.steps[index]
        steps, keep = self.options.steps, self.options.keep_stages
        if "layering" in steps and worn.layering is not None and index > 0:
            with state.timed("layering"):
                vertices, touched = correct_layer(
                    worn.layering, vertices, state.beneath, posed, ramp=worn.ramp
                )
            note(ran, "layering", touched)
        state.keep("layering", vertices, keep)
        tight: list[np.ndarray | None] = [None] * len(vertices)
        result = vertices.cpu().numpy()
        if "project" in steps:
            result, tight = self._clear(index, vertices, posed, state)
        else:
            state.keep("project", vertices, keep)
        outside = torch.as_tensor(result, device=vertices.device)
        state.beneath.append(Surface.of_cloth(outside, worn.faces, state.skinned[index], reach=0.05))
        margin = self.options.layer_margin
        state.finished.append(
            [
                Obstacle(worn.collision, frame, margin=margin, tight=found)
                for frame, found in zip(result, tight, strict=True)
            ]
        )
        return result

    def _clear(
        self, index: int, vertices: Float[Tensor, "T V 3"], posed: PosedBody, state: ChunkState
    ) -> tuple[Float[np.ndarray, "T V 3"], list[np.ndarray | None]]:
        """Projected and relaxed vertices, and per frame which of them have no room."""
        worn, home, ran = self.worn[index], self.homes[index], state.steps[index]
        obstacles, options = state.obstacles, self.options
        with state.timed("project"):
            before, skinned = (part.cpu().double().numpy() for part in (vertices, state.skinned[index]))
            gap = 2 * options.body_margin + index * options.layer_margin
            laid = [
                lay_on_skin(frame, own, worn.collision, home, body, gap=gap)
                for frame, own, body in zip(before, skinned, state.bodies, strict=True)
            ]
            cleared = clear_layer(worn, laid, obstacles, options.projection)
        note(ran, "project", np.array([done.ran for done in cleared]))
        state.keep("project", _stacked(cleared), options.keep_stages)
        relaxed: list[Projection | None] = [None] * len(cleared)
        if "relax" in options.steps:
            with state.timed("relax"):
                relaxed = relax_layer(worn, laid, cleared, obstacles, allowed=options.strain)
            note(ran, "relax", np.array([found is not None for found in relaxed]))
            cleared = [found or done for found, done in zip(relaxed, cleared, strict=True)]
        result = _stacked(cleared)
        if options.smoothing:
            with state.timed("project"):
                turns = posed.joint_transforms[:, 0, :3, :3].cpu().numpy()
                changed = [found is not None for found in relaxed]
                calmed = self.calm[index].follow(worn, laid, cleared, obstacles, turns, relaxed=changed)
            result = torch.as_tensor(calmed, dtype=torch.float32)
        return result.numpy(), [done.tight for done in cleared]

    def _check_finite(self, layers: tuple[np.ndarray, ...], frames: np.ndarray) -> None:
        for worn, positions in zip(self.worn, layers, strict=True):
            bad = ~np.isfinite(positions).all((1, 2))
            if bad.any():
                raise DrapeError(
                    f"layer {worn.layer.name}: positions are not finite in frame {frames[bad][0]}; "
                    "the pose, betas or code lies far outside the trained range"
                )


def _stacked(cleared: Sequence[Projection]) -> Float[Tensor, "T V 3"]:
    return torch.from_numpy(np.stack([done.vertices for done in cleared]).astype(np.float32))
