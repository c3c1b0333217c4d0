"""Find the code of a garment that the field was not trained on; the field stays as it is."""

from dataclasses import dataclass, field

import numpy as np
import torch
from bench.udf.field import UdfField, distance_errors
from bench.udf.samples import UdfSamplingOptions, sample_distances
from torch import Tensor


@dataclass(frozen=True)
class FitOptions:
    """How long and from where the code is sought."""

    steps: int = 300
    trial_steps: int = 60
    """Steps that all starts take; the best goes on alone."""
    starts: int = 4
    """The mean code, and the training codes that fit best as they are."""
    points_per_step: int = 1024
    rate: float = 0.02
    code_weight: float = 1e-5
    seed: int = 0
    sampling: UdfSamplingOptions = field(default_factory=UdfSamplingOptions)


def fit_code(
    field_: UdfField,
    vertices: np.ndarray,
    faces: np.ndarray,
    training_codes: Tensor,
    options: FitOptions | None = None,
) -> np.ndarray:
    """The code [code_size] whose distances are closest to those of a mesh.

    Args:
        field_: A trained field.
        vertices: [V, 3], in metres.
        faces: [F, 3].
        training_codes: [G, code_size]; where to start.
        options: How long and from where the code is sought.
    """
    options = options or FitOptions()
    rng = np.random.default_rng(options.seed)
    places = field_.places.cpu().numpy()
    samples = sample_distances((field_.to_network(vertices), faces), places, options.sampling, rng)
    samples = samples.to(training_codes)
    with torch.no_grad():
        errors = torch.cat([_errors(field_, samples[:512], code[None]) for code in training_codes])
        best = training_codes[errors.argsort()[: options.starts - 1]]
        codes = torch.cat([training_codes.mean(0, keepdim=True), best])
    generator = torch.Generator().manual_seed(options.seed)
    codes, optimizer = _restart(codes, options.rate)
    for step in range(options.steps):
        if step == options.trial_steps:
            with torch.no_grad():
                winner = _errors(field_, samples[:4096], codes).argmin()
            codes, optimizer = _restart(codes[winner, None], options.rate)
        share = max(step - options.trial_steps, 0) / max(options.steps - options.trial_steps, 1)
        optimizer.param_groups[0]["lr"] = options.rate * (0.01 + 0.495 * (1 + np.cos(np.pi * share)))
        chosen = torch.randint(len(samples), (options.points_per_step,), generator=generator)
        loss = _errors(field_, samples[chosen.to(samples.device)], codes).sum()
        loss = loss + options.code_weight * codes.square().sum()
        (codes.grad,) = torch.autograd.grad(loss, codes)
        optimizer.step()
    with torch.no_grad():
        return codes[_errors(field_, samples[:4096], codes).argmin()].cpu().numpy()


def _restart(codes: Tensor, rate: float) -> tuple[Tensor, torch.optim.Optimizer]:
    codes = codes.detach().clone().requires_grad_()
    return codes, torch.optim.Adam([codes], lr=rate)


def _errors(field_: UdfField, samples: Tensor, codes: Tensor) -> Tensor:
    """Mean error of the distance [K] at samples [N, 8] for codes [K, code_size]."""
    found = field_(samples[None, :, :3], codes[:, None])
    return distance_errors(found, samples[:, 3], field_.config.clip).mean(-1)
