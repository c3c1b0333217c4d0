"""The training loop that all networks share.

A task gives named losses and named metrics; the loop does the rest: the learning
rate, checkpoints, resuming, progress, a history table and a drawing of it.
Resuming a run that has a step budget gives, on one machine, the very weights of the
uninterrupted run. With a time budget the schedule follows the clock, so it does not.
"""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from isp_assets.errors import TrainError
from isp_assets.storage import load_tensors, save_tensors
from isp_assets.train.cpu import prepare_cpu
from isp_assets.train.history import History
from isp_assets.train.optimizers import OptimizerName, make_optimizer, restore_state, state_tensors
from isp_assets.train.progress import ProgressView, interrupt_flag

CHECKPOINT = "checkpoint.safetensors"
_SCHEMA, _VERSION = "isp-assets/checkpoint", 2


@runtime_checkable
class Task(Protocol):
    """What is trained."""

    name: str
    optimizer: OptimizerName
    config: Mapping[str, Any]
    """Plain JSON values that a checkpoint must share with the task that resumes it."""

    @property
    def module(self) -> nn.Module:
        """Owns every parameter."""

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Groups for the optimizer, each with its peak ``lr``."""

    def losses(self, generator: torch.Generator, progress: float) -> Mapping[str, Tensor]:
        """Weighted terms of one random batch; their sum is minimised. ``progress`` runs from 0 to 1."""

    def measure(self) -> Mapping[str, float]:
        """Metrics; called now and then, without gradients."""


@dataclass(frozen=True)
class RunOptions:
    """How long and where to train. Give ``steps`` or ``minutes``."""

    steps: int | None = None
    minutes: float | None = None
    """Time spent in steps; measuring and saving come on top."""
    seed: int = 0
    device: str = "cpu"
    threads: int | None = 1
    """CPU threads; None leaves them alone. More than one rarely helps networks of this size."""
    resume: bool = False
    """Go on from the folder's checkpoint, if there is one."""
    checkpoint_seconds: float = 60.0
    """Training time between checkpoints [s]."""
    report_seconds: float = 10.0
    """Training time between rows of the history [s]."""
    measurements: int = 8
    """How often metrics are taken over the whole run, the end included."""
    hold: float = 0.5
    """Share of the run at the peak learning rate; a cosine leads from there to 1 % of it."""

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.minutes is None):
            raise TrainError("give either a number of steps or of minutes to train, not both and not neither")
        if (self.steps or self.minutes or 0) <= 0:
            raise TrainError(f"the training budget must be positive, got {self.steps or self.minutes}")

    def progress(self, step: int, seconds: float) -> float:
        """Share of the budget that is spent, 0 to 1."""
        spent = step / self.steps if self.steps else seconds / (60 * (self.minutes or 1))
        return min(spent, 1.0)

    def rate(self, progress: float) -> float:
        """Factor on the peak learning rate."""
        if progress <= self.hold:
            return 1.0
        return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (progress - self.hold) / (1 - self.hold)))


@dataclass(frozen=True)
class RunReport:
    """How a run ended."""

    steps: int
    seconds: float
    """Wall time spent in steps, over all resumed parts [s]."""
    metrics: Mapping[str, float]
    device: str


def train(task: Task, folder: Path, options: RunOptions) -> RunReport:
    """Train until the budget is spent.

    Writes ``checkpoint.safetensors``, ``history.csv`` and ``curves.png`` into ``folder``.

    Raises:
        TrainError: If a loss is no longer finite, or a checkpoint does not belong to the task.
        KeyboardInterrupt: After saving a checkpoint, if the user interrupted.
    """
    prepare_cpu(options.threads)
    run = _Run(task, Path(folder), options)
    if options.resume:
        run.restore()
    with interrupt_flag() as interrupted, ProgressView(task.name) as view:
        while run.progress < 1:
            run.take_step()
            if run.report_due() or interrupted():
                view.show(run.progress, run.report())
            if interrupted():
                run.save()
                raise KeyboardInterrupt(f"stopped at step {run.step}; resume to go on")
            if run.save_due():
                run.save()
    run.history.draw(run.folder / "curves.png", title=task.name)
    return RunReport(run.step, run.seconds, run.metrics, options.device)


def read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights of the trained module, and the manifest, of a checkpoint.

    Raises:
        BundleError: If the file is missing, damaged or of another kind.
    """
    tensors, manifest = load_tensors(path, schema=_SCHEMA, version=_VERSION)
    weights = {name.removeprefix("module."): t for name, t in tensors.items() if name.startswith("module.")}
    return weights, manifest


class _Run:
    """The state of a training that a checkpoint keeps."""

    def __init__(self, task: Task, folder: Path, options: RunOptions) -> None:
        self.task, self.folder, self.options = task, folder, options
        self.generator = torch.Generator().manual_seed(options.seed)
        self.optimizer = make_optimizer(task.optimizer, task.parameter_groups())
        self.peaks = [group["lr"] for group in self.optimizer.param_groups]
        self.history = History(folder / "history.csv")
        self.step, self.seconds = 0, 0.0
        self.metrics: dict[str, float] = {}
        self._sums: dict[str, Tensor] = {}
        self._summed = 0
        self._reported = self._saved = 0.0
        self._measured = 0

    @property
    def progress(self) -> float:
        return self.options.progress(self.step, self.seconds)

    def take_step(self) -> None:
        began = time.perf_counter()
        progress = self.progress
        for group, peak in zip(self.optimizer.param_groups, self.peaks, strict=True):
            group["lr"] = peak * self.options.rate(progress)
        terms = self.task.losses(self.generator, progress)
        self.optimizer.zero_grad(set_to_none=True)
        total = torch.stack(list(terms.values())).sum()
        if total.requires_grad:  # a batch in which nothing touches teaches nothing
            total.backward()
            self.optimizer.step()
        for name, value in terms.items():
            self._sums[name] = self._sums.get(name, 0) + value.detach()
        self._summed += 1
        self.step += 1
        self.seconds += time.perf_counter() - began

    def report_due(self) -> bool:
        late = self.seconds - self._reported >= self.options.report_seconds
        return late or self.save_due() or self._measurement_due()

    def _measurement_due(self) -> bool:
        return self.progress * self.options.measurements >= self._measured + 1

    def save_due(self) -> bool:
        return self.seconds - self._saved >= self.options.checkpoint_seconds or self.progress >= 1

    def report(self) -> str:
        """Add a row to the history, with metrics when it is time for them; give it as text."""
        losses = {name: float(value) / self._summed for name, value in self._sums.items()}
        for name, value in losses.items():
            if not math.isfinite(value):
                raise TrainError(
                    f"{self.task.name}: loss {name!r} became {value} by step {self.step}; "
                    f"lower the learning rate, or resume from the last checkpoint in {self.folder}"
                )
        self._sums, self._summed, self._reported = {}, 0, self.seconds
        row = {
            "step": self.step,
            "seconds": round(self.seconds, 2),
            "lr": self.optimizer.param_groups[0]["lr"],
        }
        row |= {f"loss.{name}": value for name, value in losses.items()}
        if self._measurement_due():
            self._measured = int(self.progress * self.options.measurements)
            with torch.no_grad():
                self.metrics = dict(self.task.measure())
            row |= {f"metric.{name}": value for name, value in self.metrics.items()}
        self.history.add(row)
        return "  ".join(f"{name.removeprefix('metric.')} {value:.4g}" for name, value in row.items())

    def save(self) -> None:
        self._saved = self.seconds
        tensors = {f"module.{name}": value for name, value in self.task.module.state_dict().items()}
        state, rest = state_tensors(self.optimizer)
        tensors |= {f"optimizer.{name}": value for name, value in state.items()}
        tensors["random.task"] = self.generator.get_state()
        tensors["random.torch"] = torch.get_rng_state()
        manifest = {
            "task": self.task.name, "config": self.task.config, "seed": self.options.seed, "step": self.step,
            "seconds": self.seconds, "metrics": self.metrics, "measured": self._measured,
            "device": self.options.device, "threads": torch.get_num_threads(), "optimizer": rest,
        }  # fmt: skip
        save_tensors(self.folder / CHECKPOINT, tensors, manifest, schema=_SCHEMA, version=_VERSION)

    def restore(self) -> None:
        """Take up the folder's checkpoint, if there is one."""
        path = self.folder / CHECKPOINT
        if not path.is_file():
            return
        tensors, manifest = load_tensors(path, schema=_SCHEMA, version=_VERSION)
        if manifest["task"] != self.task.name or manifest["config"] != _as_json(self.task.config):
            raise TrainError(
                f"{path}: this checkpoint is of another task, configuration or dataset; "
                "resume with the settings it was made with, or train into another folder"
            )
        weights, _ = read_checkpoint(path)
        self.task.module.load_state_dict(weights)
        state = {name.removeprefix("optimizer."): t for name, t in tensors.items()}
        restore_state(self.optimizer, state, manifest["optimizer"])
        self.generator.set_state(tensors["random.task"])
        torch.set_rng_state(tensors["random.torch"])
        self.step, self.seconds = manifest["step"], manifest["seconds"]
        self.metrics, self._measured = manifest["metrics"], manifest["measured"]
        self._reported = self._saved = self.seconds
        self.history.take_up(self.step)


def _as_json(config: Mapping[str, Any]) -> Any:
    """What a JSON file gives back for the configuration."""
    return json.loads(json.dumps(config))
