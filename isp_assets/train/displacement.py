"""Train the displacement network D_s of a category, from physics alone (Eq. 8).

A step draws eight poses on one body shape and drapes two garments of the wardrobe in
them. No draped example is needed: the network learns to lower the energy of what
skinning gives.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import Body, PosedBody
from isp_assets.bundle import GarmentBundle, SkinBundle
from isp_assets.displacement import displace
from isp_assets.drape_features import drape_features
from isp_assets.geometry.contact import Surface
from isp_assets.geometry.energy import Fabric, gravity_energy
from isp_assets.geometry.grading import graded_rest
from isp_assets.networks.drape_field import DrapeField, DrapeFieldConfig
from isp_assets.networks.placement import on_device
from isp_assets.skinning import shape_garment, skin_garment
from isp_assets.train.body_contact import PartedBody, arms_and_rest, body_limbs
from isp_assets.train.drape_energy import Contact, drape_energies, reference_energy
from isp_assets.train.drape_metrics import DrapeCase, energy_gap, measure_drape
from isp_assets.train.loop import CHECKPOINT, RunOptions, read_checkpoint, train
from isp_assets.train.optimizers import OptimizerName
from isp_assets.train.poses import BETA_RANGE, PoseSource, draw_poses, load_clips
from isp_assets.train.wardrobe import WardrobeOptions, WornSample, build_wardrobe, require_same_body

_QUICK_GARMENTS, _TEST_FRAMES = 3, 8


@dataclass(frozen=True)
class DisplacementOptions:
    """What D_s is trained on."""

    network: DrapeFieldConfig = field(default_factory=DrapeFieldConfig)
    """Size of a new network; code size and code scale are the bundle's."""
    wardrobe: WardrobeOptions = field(default_factory=WardrobeOptions)
    poses: PoseSource = field(default_factory=PoseSource)
    contact: Contact = field(default_factory=Contact)
    frames: int = 8
    """Poses a step."""
    garments: int = 2
    """Garments a step, all in the same poses."""
    learning_rate: float = 1e-3
    optimizer: OptimizerName = "soap"


@dataclass(frozen=True, eq=False)
class PosedBatch:
    """A body shape in some poses, and its skin as an obstacle, part by part."""

    betas: Float[Tensor, " B"]
    posed: PosedBody
    skin: PartedBody


class DisplacementTask:
    """What `train` needs: the network, its physics, losses and metrics."""

    def __init__(
        self, bundle: GarmentBundle, skin: SkinBundle, body: Body, options: DisplacementOptions, *,
        device: str = "cpu", seed: int = 0,
    ) -> None:  # fmt: skip
        codes = np.stack(list(bundle.codes.values()))
        scale = float(1 / max(codes.std(), 1e-6))
        earlier = bundle.drape_field
        config = (
            earlier.config
            if earlier
            else replace(options.network, code_size=codes.shape[1], code_scale=scale)
        )
        torch.manual_seed(seed)
        self.name = f"drape {bundle.category}"
        self.config: Mapping[str, Any] = {
            "field": config.to_dict(), "contact": asdict(options.contact), "body": body.sha256,
            "wardrobe": asdict(options.wardrobe), "frames": options.frames, "garments": options.garments,
            "held_out": list(options.poses.held_out), "learning_rate": options.learning_rate,
            "optimizer": options.optimizer,
        }  # fmt: skip
        self.optimizer = options.optimizer
        self.options, self.device, self.fabric = options, torch.device(device), Fabric()
        self.body = body.to(self.device)
        self.body_limbs = body_limbs(self.body)
        wardrobe = replace(options.wardrobe, map_size=config.map_size)
        skin_field = on_device(skin.skin_field, self.device)
        samples = build_wardrobe(bundle, self.body, skin_field, wardrobe, seed=seed)
        self.wardrobe = [sample.to(self.device) for sample in samples]
        self.clips = load_clips(options.poses)
        self.module, self.is_further = DrapeField(config), earlier is not None
        if earlier is not None:
            self.module.load_state_dict(earlier.state_dict())
        self.module.to(self.device)

    def parameter_groups(self) -> list[dict[str, Any]]:
        rate = self.options.learning_rate
        groups = [{"params": list(self.module.mlp.parameters()), "lr": rate}]
        # Adam moves every texel alike, and neighbours that move apart strain the cloth: fine maps go slowly.
        groups.append({"params": [self.module.fine], "lr": 0.3 * rate})
        if self.module.config.coarse_size:
            groups.append({"params": [self.module.coarse], "lr": 2 * rate})
        return groups

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        """The terms of Eq. 8 on a scale on which hard poses do not drown the others."""
        poses = draw_poses(list(self.clips.train.values()), self.options.frames, generator)
        betas = BETA_RANGE * (2 * torch.rand(self.module.config.num_betas, generator=generator) - 1)
        batch = self.pose(poses, betas)
        maps = self.module.maps()
        chosen = torch.randint(len(self.wardrobe), (self.options.garments,), generator=generator)
        # What is trained further must not sink into the body first.
        stiffness = self.options.contact.at(1.0 if self.is_further else progress)
        totals: dict[str, Tensor] = {}
        for index in chosen.tolist():
            sample = self.wardrobe[index]
            skinned, vertices = self.drape(sample, batch, maps=maps)
            for name, value in self._scaled(sample, skinned, vertices, batch, stiffness).items():
                totals[name] = totals.get(name, 0.0) + value / len(chosen)
        return totals

    def pose(self, poses: Float[Tensor, "T 24 3"], betas: Float[Tensor, " B"]) -> PosedBatch:
        """Pose the body; only its tilt matters, so it stays at the origin."""
        with torch.no_grad():
            betas = betas.to(self.device)
            posed = self.body.pose(poses.to(self.device), betas=betas)
            skin = PartedBody.of(Surface.of_mesh(posed.vertices, self.body.faces), self.body_limbs)
            return PosedBatch(betas, posed, skin)

    def drape(
        self, sample: WornSample, batch: PosedBatch, *, maps: tuple[Tensor, Tensor]
    ) -> tuple[Float[Tensor, "T V 3"], Float[Tensor, "T V 3"]]:
        """Skin a garment, then displace it by the network; differentiable in the network.

        Returns:
            Positions after skinning, and after displacing [m].
        """
        with torch.no_grad():
            skinned, linear = skin_garment(sample.bound, batch.posed, batch.betas)
        basis, mean = maps
        features = drape_features(
            batch.posed, batch.betas, sample.code, num_betas=self.module.config.num_betas
        )
        coefficients = self.module.coefficients(features)
        drawn = (coefficients @ basis.flatten(1)).unflatten(1, mean.shape) + mean
        return skinned, displace(skinned, linear, sample.sampler.sample(drawn) * sample.ramp)

    def case(self, sample: WornSample, batch: PosedBatch) -> DrapeCase:
        """What measuring a garment in some poses needs besides its positions."""
        shaped = shape_garment(sample.bound, batch.betas)
        rest = graded_rest(sample.rest, sample.bound.canonical, shaped)
        return DrapeCase(rest, self.fabric, batch.skin.whole, self.options.contact)

    def _scaled(
        self, sample: WornSample, skinned: Tensor, vertices: Tensor, batch: PosedBatch, stiffness: float
    ) -> dict[str, Tensor]:
        case = self.case(sample, batch)
        height = batch.skin.clearance(vertices, arms_and_rest(sample.parts), margin=case.contact.margin)
        terms = drape_energies(vertices, height, case.rest, self.fabric, case.contact, stiffness=stiffness)
        reference = reference_energy(case.rest)
        present = sum(value.detach() for name, value in terms.items() if name != "gravity")
        # The gradient is that of the energy's square root where the energy is large.
        weight = (reference * (reference + present)).rsqrt()
        terms["gravity"] = terms["gravity"] - gravity_energy(skinned, case.rest)
        return {name: (weight * value).mean() for name, value in terms.items()}

    @torch.no_grad()
    def measure(self) -> dict[str, float]:
        """Figures of a few garments on held-out poses, against skinning alone."""
        return self.measure_on(self.wardrobe[:_QUICK_GARMENTS])

    @torch.no_grad()
    def measure_on(self, samples: list[WornSample]) -> dict[str, float]:
        """Mean figures of garments on held-out poses, on the mean body and on two others."""
        maps, rows = self.module.maps(), []
        for poses, betas in self.test_batches():
            batch = self.pose(poses, betas)
            for sample in samples:
                case = self.case(sample, batch)
                skinned, vertices = self.drape(sample, batch, maps=maps)
                row = measure_drape(case, skinned, prefix="skin.")
                rows.append(row | measure_drape(case, vertices, prefix=""))
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def test_batches(self) -> list[tuple[Float[Tensor, "T 24 3"], Float[Tensor, " B"]]]:
        """Held-out poses (of the training clips if none are held out) on three body shapes."""
        frames = np.concatenate(list((self.clips.test or self.clips.train).values()))
        count = self.module.config.num_betas
        generator = torch.Generator().manual_seed(1)
        shapes = [torch.zeros(count)]
        shapes += [BETA_RANGE * (2 * torch.rand(count, generator=generator) - 1) for _ in range(2)]
        rows = np.linspace(0, len(frames) - 1, len(shapes) * _TEST_FRAMES).astype(int)
        return [
            (torch.tensor(frames[rows[k :: len(shapes)]], dtype=torch.float32), betas)
            for k, betas in enumerate(shapes)
        ]


def train_displacement(
    bundle: GarmentBundle, skin: SkinBundle, out: Path, run: RunOptions, *,
    body: Body, options: DisplacementOptions | None = None, gap_iterations: int = 300,
) -> GarmentBundle:  # fmt: skip
    """Train D_s and write ``CATEGORY.safetensors``, the bundle with its displacement network, into ``out``.

    Args:
        bundle: The category's garments. A displacement network that it already has is trained further,
            with contact at its full stiffness from the start.
        skin: The diffused skinning of the body.
        out: Folder; also takes the checkpoint and the history.
        run: Budget and device.
        body: The body that all was made for.
        options: What to train on.
        gap_iterations: Effort of the reference minima that the last figures compare with.

    Raises:
        TrainError: If bundle, skin field and body do not belong together.
    """
    require_same_body(body, {"garment bundle": bundle.body_sha256, "skin bundle": skin.body_sha256})
    task = DisplacementTask(
        bundle, skin, body, options or DisplacementOptions(), device=run.device, seed=run.seed
    )
    train(task, out, run)
    metrics = task.measure_on(task.wardrobe[: 2 * _QUICK_GARMENTS]) | energy_gap(
        task, iterations=gap_iterations
    )
    result = with_displacement(bundle, out, metrics=metrics)
    result.save(Path(out) / f"{bundle.category}.safetensors")
    return result


def with_displacement(
    bundle: GarmentBundle, folder: Path, *, metrics: Mapping[str, float] | None = None
) -> GarmentBundle:
    """The bundle with the displacement network of a training's checkpoint, finished or not."""
    weights, manifest = read_checkpoint(Path(folder) / CHECKPOINT)
    network = DrapeField(DrapeFieldConfig.from_dict(manifest["config"]["field"]))
    network.load_state_dict(weights)
    notes = {key: manifest[key] for key in ("step", "seconds", "seed", "config")}
    if bundle.drape_field is not None:
        notes["earlier"] = bundle.provenance.get("drape", {})
    return replace(
        bundle,
        drape_field=network.eval().requires_grad_(False),
        provenance={**bundle.provenance, "drape": notes},
        metrics={**bundle.metrics, "drape": dict(metrics or manifest["metrics"])},
    )
