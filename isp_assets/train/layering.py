"""Train the layering network D_m on random stacks of garments, from physics alone (Eqs. 10-12).

A step draws two to five garments of all categories, drapes them independently on one
body shape in some poses, makes the inner ones final, and corrects the outermost with the
network. No example is needed: the network learns to lower the garment's energy, which
holds the contact with the body and with every inner garment.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2, Eqs. 10-12.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import Body, PosedBody
from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.errors import TrainError
from isp_assets.geometry.contact import Surface, clearance, force
from isp_assets.geometry.energy import Fabric, gravity_energy
from isp_assets.geometry.grading import graded_rest
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.tuck import tuck
from isp_assets.layering import correct_layer
from isp_assets.networks.layering_net import LayeringConfig, LayeringNet
from isp_assets.skinning import shape_garment
from isp_assets.train.body_contact import PartedBody, arms_and_rest, body_limbs
from isp_assets.train.drape_energy import Contact, drape_energies, reference_energy
from isp_assets.train.layering_metrics import measure_layering
from isp_assets.train.loop import RunOptions, train
from isp_assets.train.optimizers import OptimizerName
from isp_assets.train.poses import BETA_RANGE, PoseSource, draw_poses, load_clips
from isp_assets.train.wardrobe import WardrobeOptions, require_same_body
from isp_assets.train.wearers import Wearer, build_wearers

LAYER_REACH = 0.05
"""Samples of an inner garment further than this [m] do not touch."""


@dataclass(frozen=True)
class LayeringOptions:
    """What D_m is trained on."""

    network: LayeringConfig = field(default_factory=LayeringConfig)
    garments: int = 24
    """Garments of each category."""
    held_out: int = 4
    """The last garments of each category are kept for the test."""
    edge_length: float = 0.02
    """Length of the garments' edges [m]."""
    poses: PoseSource = field(default_factory=PoseSource)
    contact: Contact = field(default_factory=lambda: Contact(margin=0.005))
    """Contact with the body and, times ``layer_weight``, with inner garments."""
    layer_weight: float = 1.0
    """Weight of the contact with inner garments (lambda_g of Eq. 11)."""
    regular_weight: float = 0.02
    """Weight of the mean square displacement, in units of the network (lambda_r of Eq. 11)."""
    frames: int = 2
    """Poses a step."""
    depth_shares: tuple[float, ...] = (0.4, 0.3, 0.2, 0.1)
    """Shares of the stacks that have 2, 3, 4 and 5 layers."""
    learning_rate: float = 1e-3
    optimizer: OptimizerName = "soap"


@dataclass(frozen=True, eq=False)
class Stack:
    """The outermost garment of a stack in some poses, and all that lies beneath it."""

    wearer: Wearer
    posed: PosedBody
    betas: Float[Tensor, " B"]
    draped: Float[Tensor, "T V 3"]
    """The garment after D_s, before any correction."""
    beneath: tuple[Surface, ...]
    """The body first, then the inner garments, final."""
    inner: tuple[tuple[Wearer, Float[Tensor, "T _ 3"]], ...]
    """The inner garments, and where they are."""


class LayeringTask:
    """What `train` needs: the network, stacks of garments, losses and metrics."""

    def __init__(
        self, bundles: Sequence[GarmentBundle], skin: SkinBundle, body: Body, options: LayeringOptions, *,
        earlier: LayeringBundle | None = None, device: str = "cpu", seed: int = 0,
    ) -> None:  # fmt: skip
        torch.manual_seed(seed)
        self.name, self.is_further = "layering", earlier is not None
        if earlier is not None:
            options = replace(options, network=earlier.layering_net.config)
        self.config: Mapping[str, Any] = {
            "network": options.network.to_dict(), "further": self.is_further,
            "contact": asdict(options.contact), "body": body.sha256,
            "categories": [bundle.category for bundle in bundles], "garments": options.garments,
            "held_out": [options.held_out, *options.poses.held_out], "frames": options.frames,
            "layer_weight": options.layer_weight, "regular_weight": options.regular_weight,
            "depth_shares": list(options.depth_shares), "learning_rate": options.learning_rate,
            "optimizer": options.optimizer,
        }  # fmt: skip
        self.options, self.device, self.fabric = options, torch.device(device), Fabric()
        self.optimizer = options.optimizer
        self.body = body.to(self.device)
        self.body_collision = CollisionMesh.build(body.faces.numpy(), body.weights.numpy())
        self.body_limbs = body_limbs(self.body)
        self.module = LayeringNet(options.network)
        if earlier is not None:
            self.module.load_state_dict(earlier.layering_net.state_dict())
        self.module.to(self.device)
        wardrobe = WardrobeOptions(
            garments=options.garments, edge_length=options.edge_length, map_size=options.network.map_size
        )
        by_category = [
            build_wearers(bundle, body, skin, wardrobe, self.module, device=self.device, seed=seed)
            for bundle in bundles
        ]
        self.wearers = [w for wearers in by_category for w in wearers[: -options.held_out or None]]
        self.test_wearers = [w for wearers in by_category for w in wearers[-options.held_out :]]
        self.clips = load_clips(options.poses)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.module.parameters()), "lr": self.options.learning_rate}]

    def losses(self, generator: torch.Generator, progress: float) -> dict[str, Tensor]:
        """The terms of Eqs. 10-12 on a scale on which hard contacts do not drown the others."""
        poses = draw_poses(list(self.clips.train.values()), self.options.frames, generator)
        stack = self.stack(self.wearers, poses, self._betas(generator), generator)
        lifted, _ = correct_layer(
            stack.wearer.layering, stack.draped, stack.beneath, stack.posed, ramp=stack.wearer.ramp
        )
        # What is trained further must not sink into what lies beneath it first.
        stiffness = self.options.contact.at(1.0 if self.is_further else progress)
        return self._scaled(stack, lifted, stiffness)

    @torch.no_grad()
    def stack(
        self,
        wearers: Sequence[Wearer],
        poses: Float[Tensor, "T 24 3"],
        betas: Float[Tensor, " B"],
        generator: torch.Generator,
    ) -> Stack:
        """Drape a random stack, innermost first, and make all but the outermost garment final."""
        posed = self.body.pose(poses.to(self.device), betas=betas.to(self.device))
        beneath = [Surface.of_mesh(posed.vertices, self.body.faces)]
        shares = torch.tensor(self.options.depth_shares)
        depth = 2 + int(torch.multinomial(shares, 1, generator=generator))
        chosen = [wearers[int(i)] for i in torch.randint(len(wearers), (depth,), generator=generator)]
        skin = [Obstacle(self.body_collision, v, margin=0.0) for v in posed.vertices.cpu().numpy()]
        draped = [wearer.drape(posed, betas.to(self.device)) for wearer in chosen]
        layers = _tucked(chosen, [vertices for _, vertices in draped], skin)
        inner: list[tuple[Any, Tensor]] = []
        for wearer, (skinned, _), vertices in zip(chosen[:-1], draped[:-1], layers[:-1], strict=True):
            if inner:
                vertices, _ = correct_layer(wearer.layering, vertices, beneath, posed, ramp=wearer.ramp)
            # A plain push stands in for the projection that follows in use.
            vertices = vertices + force(vertices, beneath, margin=self.options.contact.margin / 2)
            inner.append((wearer, vertices))
            beneath.append(Surface.of_cloth(vertices, wearer.rest.faces, skinned, reach=LAYER_REACH))
        return Stack(chosen[-1], posed, betas.to(self.device), layers[-1], tuple(beneath), tuple(inner))

    def _scaled(self, stack: Stack, vertices: Tensor, stiffness: float) -> dict[str, Tensor]:
        options, contact = self.options, self.options.contact
        bound = stack.wearer.bound
        rest = graded_rest(stack.wearer.rest, bound.canonical, shape_garment(bound, stack.betas))
        skin = PartedBody.of(stack.beneath[0], self.body_limbs)
        height = skin.clearance(vertices, arms_and_rest(stack.wearer.parts), margin=contact.margin)
        terms = drape_energies(vertices, height, rest, self.fabric, contact, stiffness=stiffness)
        layers = vertices.new_zeros(len(vertices))
        for surface in stack.beneath[1:]:
            lacking = torch.relu(contact.margin - clearance(vertices, surface))
            cost = contact.cubic * lacking.pow(3) + 0.5 * stiffness * rest.mass * lacking.square()
            layers = layers + options.layer_weight * cost.sum(-1)
        terms["layers"] = layers
        reference = reference_energy(rest)
        present = sum(value.detach() for name, value in terms.items() if name != "gravity")
        # The gradient is that of the energy's square root where the energy is large.
        weight = (reference * (reference + present)).rsqrt()
        terms["gravity"] = terms["gravity"] - gravity_energy(stack.draped, rest)
        scaled = {name: (weight * value).mean() for name, value in terms.items()}
        moved = (vertices - stack.draped) / options.network.displacement_scale
        scaled["regular"] = options.regular_weight * moved.square().sum(-1).mean()
        return scaled

    def _betas(self, generator: torch.Generator) -> Float[Tensor, " B"]:
        count = self.body.shape_dirs.shape[-1]
        return BETA_RANGE * (2 * torch.rand(count, generator=generator) - 1)

    @torch.no_grad()
    def measure(self) -> dict[str, float]:
        """Intersections and strain of held-out stacks in held-out poses, before and after D_m."""
        return self.measure_on(stacks=4)

    @torch.no_grad()
    def measure_on(self, *, stacks: int) -> dict[str, float]:
        """Means over a fixed choice of stacks of test garments (of training garments without any)."""
        generator = torch.Generator().manual_seed(7)
        frames = list((self.clips.test or self.clips.train).values())
        wearers = self.test_wearers or self.wearers
        rows = []
        for _ in range(stacks):
            clip = torch.tensor(frames[int(torch.randint(len(frames), (), generator=generator))])
            row = int(torch.randint(len(clip), (), generator=generator))
            stack = self.stack(wearers, clip[row : row + 1].float(), self._betas(generator), generator)
            lifted, _ = correct_layer(
                stack.wearer.layering, stack.draped, stack.beneath, stack.posed, ramp=stack.wearer.ramp
            )
            rows.append(measure_layering(stack, lifted, self.body))
        return {name: float(sum(row[name] for row in rows) / len(rows)) for name in rows[0]}


def _tucked(
    wearers: Sequence[Wearer], layers: list[Float[Tensor, "T _ 3"]], skin: Sequence[Obstacle]
) -> list[Float[Tensor, "T _ 3"]]:
    """Layers whose wide inner ones gave way to the outer ones, as in use; the outermost stays as it is."""
    arrays = [layer.double().cpu().numpy() for layer in layers]
    for frame, body in enumerate(skin):
        covers: list[Obstacle] = []
        for index in reversed(range(len(wearers))):
            mesh = wearers[index].collision
            arrays[index][frame] = tuck(arrays[index][frame], mesh, covers, body)
            covers.append(Obstacle(mesh, arrays[index][frame], margin=0.0))
    return [torch.as_tensor(array).to(layer) for array, layer in zip(arrays, layers, strict=True)]


def train_layering(
    bundles: Sequence[GarmentBundle], skin: SkinBundle, out: Path, run: RunOptions, *,
    body: Body, options: LayeringOptions | None = None, earlier: LayeringBundle | None = None,
    stacks: int = 24,
) -> LayeringBundle:  # fmt: skip
    """Train D_m and write ``layering.safetensors`` into ``out``.

    Args:
        bundles: One of each category.
        skin: The skinning field of the body.
        out: Output folder.
        run: How long and where.
        body: The body that all were trained on.
        options: What to train on.
        earlier: A network to train further, with contact at its full stiffness from the start.
        stacks: Held-out stacks that the final metrics are taken on.

    Raises:
        TrainError: If bundles, skin field and body do not belong together.
    """
    if not bundles:
        raise TrainError("layering needs at least one garment bundle")
    made_for = {f"bundle {bundle.category!r}": bundle.body_sha256 for bundle in bundles}
    require_same_body(body, made_for | {"skin bundle": skin.body_sha256})
    options = options or LayeringOptions()
    task = LayeringTask(bundles, skin, body, options, earlier=earlier, device=run.device, seed=run.seed)
    report = train(task, out, run)
    metrics = task.measure_on(stacks=stacks)
    result = LayeringBundle(
        task.module.cpu().eval().requires_grad_(False),
        provenance={
            "steps": report.steps, "seconds": report.seconds, "device": report.device, "seed": run.seed,
            "config": dict(task.config), **({"earlier": dict(earlier.provenance)} if earlier else {}),
        },
        metrics=metrics,
    )  # fmt: skip
    result.save(Path(out) / "layering.safetensors")
    return result
