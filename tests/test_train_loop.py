"""The training loop: budgets, resuming, interruption, divergence."""

import csv
import io
import os
import signal

import pytest
import torch
from torch import nn

from isp_assets.errors import TrainError
from isp_assets.train.loop import CHECKPOINT, RunOptions, read_checkpoint, train
from isp_assets.train.optimizers import OptimizerName


class LineTask:
    """Fit a line to noisy points; the noise is drawn from the loop's generator."""

    name = "line"

    def __init__(
        self, *, width: int = 4, interrupt_at: int | None = None, poison_at: int | None = None,
        optimizer: OptimizerName = "adam",
    ) -> None:  # fmt: skip
        torch.manual_seed(1)
        self.optimizer = optimizer
        self.config = {"width": width, "sizes": (1, width)}
        self.module = nn.Sequential(nn.Linear(1, width), nn.Tanh(), nn.Linear(width, 1))
        self.interrupt_at, self.poison_at, self.calls = interrupt_at, poison_at, 0

    def parameter_groups(self):
        return [
            {"params": self.module[0].parameters(), "lr": 1e-2},
            {"params": self.module[2].parameters(), "lr": 3e-2},
        ]

    def losses(self, generator, progress):
        self.calls += 1
        if self.calls == self.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)
        x = torch.rand(32, 1, generator=generator)
        y = 2 * x + 0.01 * torch.randn(32, 1, generator=generator)
        error = (self.module(x) - y).square().mean()
        return {
            "fit": error * (float("nan") if self.calls == self.poison_at else 1),
            "size": 1e-4 * self.module[0].weight.square().sum(),
        }

    def measure(self):
        x = torch.linspace(0, 1, 11)[:, None]
        return {"error": float((self.module(x) - 2 * x).abs().mean())}


def run(**changes) -> RunOptions:
    return RunOptions(**{"steps": 40, "report_seconds": 0.0, "checkpoint_seconds": 1e9, **changes})


def weights(folder):
    return read_checkpoint(folder / CHECKPOINT)[0]


def table(folder):
    return list(csv.DictReader(io.StringIO((folder / "history.csv").read_text())))


def test_training_learns_and_leaves_its_files(tmp_path):
    report = train(LineTask(), tmp_path, run(steps=400, report_seconds=1e9))
    assert report.steps == 400
    assert report.metrics["error"] < 0.05
    assert {p.name for p in tmp_path.iterdir()} == {CHECKPOINT, "history.csv", "curves.png"}
    rows = table(tmp_path)
    assert [int(row["step"]) for row in rows] == list(range(50, 401, 50))
    assert float(rows[-1]["loss.fit"]) < 0.5 * float(rows[0]["loss.fit"])
    assert all(float(row["metric.error"]) > 0 for row in rows)
    manifest = read_checkpoint(tmp_path / CHECKPOINT)[1]
    assert (manifest["task"], manifest["step"], manifest["config"]["width"]) == ("line", 400, 4)


def test_the_same_seed_gives_the_same_weights_and_another_does_not(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(LineTask(), tmp_path / name, run(seed=seed))
    a, b, c = (weights(tmp_path / name) for name in "abc")
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not torch.equal(a["0.weight"], c["0.weight"])


@pytest.mark.parametrize("optimizer", ["adam", "soap"])
def test_an_interrupted_run_resumes_as_if_it_had_gone_on(tmp_path, optimizer):
    """To the last bit but one: on some processors a sum depends on where in memory its terms lie."""
    train(LineTask(optimizer=optimizer), tmp_path / "whole", run())
    with pytest.raises(KeyboardInterrupt, match="step 17"):
        train(LineTask(interrupt_at=17, optimizer=optimizer), tmp_path / "parts", run())
    assert read_checkpoint(tmp_path / "parts" / CHECKPOINT)[1]["step"] == 17
    report = train(LineTask(optimizer=optimizer), tmp_path / "parts", run(resume=True))
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    assert report.steps == 40
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-6)
    steps = [int(row["step"]) for row in table(tmp_path / "parts")]
    assert steps == list(range(1, 41))


def test_interruption_gives_the_handler_back(tmp_path):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(LineTask(interrupt_at=3), tmp_path, run())
    assert signal.getsignal(signal.SIGINT) is before


def test_a_checkpoint_of_another_task_is_refused(tmp_path):
    train(LineTask(), tmp_path, run(steps=2))
    with pytest.raises(TrainError, match="another task, configuration or dataset"):
        train(LineTask(width=5), tmp_path, run(steps=4, resume=True))


def test_resuming_without_a_checkpoint_starts_anew(tmp_path):
    assert train(LineTask(), tmp_path, run(steps=3, resume=True)).steps == 3


def test_divergence_is_named_and_not_saved(tmp_path):
    with pytest.raises(TrainError, match="loss 'fit' became nan by step 5"):
        train(LineTask(poison_at=5), tmp_path, run())
    assert not (tmp_path / CHECKPOINT).exists()


def test_a_time_budget_ends(tmp_path):
    report = train(LineTask(), tmp_path, run(steps=None, minutes=0.005))
    assert report.seconds == pytest.approx(0.3, abs=0.2)
    assert report.steps > 3


def test_budgets_are_checked():
    for wrong in ({}, {"steps": 3, "minutes": 1.0}, {"steps": 0}, {"minutes": -1.0}):
        with pytest.raises(TrainError):
            RunOptions(**wrong)


def test_the_rate_is_held_and_then_falls():
    options = RunOptions(steps=10, hold=0.4)
    rates = [options.rate(p / 20) for p in range(21)]
    assert rates[:9] == [1.0] * 9
    assert rates[-1] == pytest.approx(0.01)
    assert rates == sorted(rates, reverse=True)
