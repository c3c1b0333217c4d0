"""Draping under stress: limits, resuming, errors as rows, and one small real case of every way to drape."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from isp_assets.errors import DrapeError, InputError
from isp_assets.evaluate import stress_runs as runs
from isp_assets.evaluate.criteria import CRITERIA, failures, severity
from isp_assets.evaluate.draping import LIMITS, digest_of, evaluate_draping, find_limits, layer_times
from isp_assets.evaluate.stress_case import StressCase, StressRun, drape_case
from isp_assets.evaluate.stress_measures import FIGURES, measure
from isp_assets.evaluate.stress_setup import StressSetup, Sweep
from isp_assets.evaluate.stress_tests import TESTS, stress_cases
from isp_assets.evaluate.temporal import skin_beneath
from isp_assets.synthetic import synthetic_shot


@pytest.fixture(scope="module")
def setup() -> StressSetup:
    return StressSetup.load(quick=True)


def row(value: float, **figures: float) -> dict:
    made = {"test": "T0", "case": "made up", "parameter": "x", "value": value, **figures}
    return made | {"passed": not failures(made), "failed": "; ".join(failures(made))}


class TestLimits:
    def test_the_first_failure_is_the_limit(self):
        rows = [row(x, strain_p99_max=0.1 * x, body_area_max=0.0) for x in (1.0, 2.0, 3.0, 4.0, 5.0)]
        (limit,) = find_limits(rows)
        assert (limit["good_up_to"], limit["fails_at"], limit["end_value"]) == (3.0, 4.0, 5.0)
        assert limit["fails_first"] == "strain_p99_max 0.4 > 0.35"
        assert limit["at_the_end"] == "finite; strain_p99_max 0.5 > 0.35"
        assert set(limit) == {"test", "case", *LIMITS}

    def test_a_recovery_does_not_hide_a_failure(self):
        (limit,) = find_limits([row(1.0, jump_ratio=9.0), row(2.0, jump_ratio=1.0)])
        assert (limit["good_up_to"], limit["fails_at"]) == (None, 1.0)
        assert limit["at_the_end"] == "all criteria hold"

    def test_every_criterion_has_its_own_limit(self):
        rows = [row(1.0, flipped_percent=1.0), row(2.0), row(3.0, strain_p99_max=1.0, flipped_percent=1.0)]
        (limit,) = find_limits(rows)
        assert set(limit["each"].split("; ")) == {"flipped_percent at 1", "strain_p99_max at 3"}

    def test_sweeps_without_failure_have_no_limit(self):
        (limit,) = find_limits([row(1.0), row(2.0)])
        assert (limit["good_up_to"], limit["fails_at"], limit["fails_first"]) == (2.0, None, "")

    def test_sweeps_stay_apart(self):
        other = row(1.0, flipped_percent=1.0) | {"case": "other"}
        assert [x["fails_at"] for x in find_limits([row(1.0), other, row(2.0)])] == [None, 1.0]

    def test_errors_come_first(self):
        (limit,) = find_limits([row(1.0), row(2.0, error="too deep")])  # type: ignore[arg-type]
        assert limit["fails_first"] == "error: too deep"
        assert limit["at_the_end"] == "stops: too deep"


def test_criteria_are_inclusive_and_severity_counts_limits():
    for criterion in CRITERIA:
        assert failures({criterion.column: criterion.limit}) == []
        assert failures({criterion.column: 1.01 * criterion.limit + (criterion.limit == 0)})
    assert severity({"strain_p99_max": 0.7, "jump_ratio": 1.5}) == pytest.approx(2)
    assert severity({"non_finite": 1.0}) == np.inf
    assert {c.column for c in CRITERIA} <= set(FIGURES)


def test_layer_times_are_a_straight_line():
    rows = [{"case": "mixed layers", "layers": n, "seconds": 0.2 + 0.5 * n} for n in (1, 2, 4, 8)]
    found = layer_times([*rows, {"case": "other", "layers": 3, "seconds": 99.0}])
    assert found["seconds_a_layer"] == pytest.approx(0.5)
    assert found["offset_seconds"] == pytest.approx(0.2)
    assert found["explained"] == pytest.approx(1)
    assert layer_times(rows[:2]) == {}


class TestCases:
    def test_every_test_has_cases_with_their_own_keys(self, setup):
        cases = stress_cases(setup)
        assert {case.test for case in cases} == set(TESTS)
        assert len({case.key for case in cases}) == len(cases)
        whole = stress_cases(replace(setup, quick=False))
        assert len({case.key for case in whole}) == len(whole)
        assert sum(len(case.values) for case in cases) < 0.5 * sum(len(case.values) for case in whole)

    def test_a_sweep_ends_with_its_hardest_value(self, setup):
        assert setup.sweep(0, 90, 10) == (0.0, 30.0, 60.0, 90.0)
        assert setup.sweep(40, -30, -5)[-1] == -30
        assert replace(setup, quick=False).sweep(1, 2, 0.5) == (1.0, 1.5, 2.0)

    def test_unknown_tests_and_clips_without_a_folder_are_refused(self, setup):
        with pytest.raises(InputError, match=r"no draping test T99; there are T1, .*T22"):
            stress_cases(setup, ["T1", "T99"])
        with pytest.raises(InputError, match="--motions"):
            StressSetup.load(clips=["walk"])

    def test_values_must_fit_the_frames(self, setup):
        with pytest.raises(InputError, match="a value for each of 2 frames, got 3"):
            setup.case("T0", "x", ["tee"], setup.walk(2), Sweep("x", (1.0, 2.0, 3.0)))

    def test_the_fingerprint_sees_what_matters(self, setup):
        case = setup.case("T0", "x", ["tee"], setup.walk(2), Sweep("x", (1.0, 2.0)))
        again = setup.case("T0", "x", ["tee"], setup.walk(2), Sweep("x", (1.0, 2.0)))
        assert case.fingerprint("a") == again.fingerprint("a")
        betas = replace(case, shot=replace(case.shot, betas=np.ones(10, np.float32)))
        cells = replace(case, options=replace(case.options, resolution=65))
        marks = {c.fingerprint("a") for c in (case, betas, cells, replace(case, values=(1.0, 3.0)))}
        assert len(marks | {case.fingerprint("b")}) == 5


class Fake:
    """Gives the frames of the synthetic shot; from a value on it breaks, in one way or another."""

    def __init__(self, *, breaks_at: float = np.inf, error: type[Exception] | None = None) -> None:
        self.breaks_at, self.error, self.calls = breaks_at, error, 0

    def __call__(self, case: StressCase) -> StressRun:
        self.calls += 1
        shot = synthetic_shot(frames=f"1-{len(case.values)}")
        layers = tuple(layer.copy() for layer in shot.layers)
        for t, value in enumerate(case.values):
            if value >= self.breaks_at:
                if self.error is not None:
                    raise self.error("broken on purpose")
                layers[1][t, 0, 0] = np.nan
        return StressRun(shot.scene, shot.body, layers, layers, seconds=0.5 * len(case.values))


def fake_case(setup: StressSetup, fake: Fake, label: str = "x") -> StressCase:
    motion = setup.walk(2)
    poses, translation = (np.repeat(a[:1], 4, 0) for a in (motion.poses, motion.translation))
    sweep = Sweep("x", (1.0, 1.0, 2.0, 3.0), ("jumps",))
    case = setup.case("T0", label, ["tee"], replace(motion, poses=poses, translation=translation), sweep)
    return replace(case, run=fake)


class TestMeasuring:
    def test_rows_follow_the_values(self, setup):
        case = fake_case(setup, Fake())
        rows = measure(case, case.drape()).rows
        assert [r["value"] for r in rows] == [1.0, 2.0, 3.0]
        assert [r["frames"] for r in rows] == [2, 1, 1]
        assert all(r["passed"] and r["layers"] == 2 and r["seconds"] == 0.5 for r in rows)
        assert set(rows[0]) <= {"test", "case", *FIGURES}
        json.dumps(rows, allow_nan=False)

    def test_positions_that_are_not_finite_are_counted_not_measured(self, setup):
        case = fake_case(setup, Fake(breaks_at=3.0))
        found = measure(case, case.drape())
        assert [r["non_finite"] for r in found.rows] == [0, 0, 1]
        assert found.rows[2]["failed"] == "non_finite 1 > 0"
        assert "strain_p99_max" not in found.rows[2]
        assert (found.worst, found.severity) == (3, np.inf)
        json.dumps(found.rows, allow_nan=False)

    def test_layers_put_in_the_way_are_not_judged(self, setup):
        case = fake_case(setup, Fake())
        run = case.drape()
        broken = run.layers[0].copy()
        broken[:, ::2] += 0.3  # strained and folded, and in the way of nobody
        run = replace(run, layers=(broken, run.layers[1]), before=None)
        judged, spared = (measure(case, replace(run, placed=n)).rows[0] for n in (0, 1))
        assert judged["strain_p99_max"] > 1
        assert spared["strain_p99_max"] == measure(case, case.drape()).rows[0]["strain_p99_max"]

    @pytest.mark.parametrize("error", [DrapeError, ZeroDivisionError])
    def test_an_error_is_a_row_and_spares_the_other_values(self, setup, error, tmp_path):
        case = fake_case(setup, Fake(breaks_at=2.0, error=error))
        rows = evaluate_draping([case], tmp_path, networks="n", pictures=False).rows
        assert [r["value"] for r in rows] == [1.0, 2.0, 3.0]
        assert [r["passed"] for r in rows] == [True, False, False]
        assert "broken on purpose" in rows[1]["error"]

    def test_a_resumed_run_equals_a_whole_one(self, setup, tmp_path):
        cases = [fake_case(setup, Fake(breaks_at=b), f"case {b}") for b in (9.0, 3.0)]
        whole = evaluate_draping(cases, tmp_path / "whole", networks="n", pictures=False)
        evaluate_draping(cases[:1], tmp_path / "part", networks="n", pictures=False)
        calls = cases[0].run.calls  # type: ignore[union-attr]
        resumed = evaluate_draping(cases, tmp_path / "part", networks="n", pictures=False)
        assert resumed.rows == whole.rows
        assert cases[0].run.calls == calls, "the finished case was taken from its file"
        evaluate_draping(cases, tmp_path / "part", networks="other", pictures=False)
        assert cases[0].run.calls == calls + 1, "with other networks nothing is finished"

    def test_a_damaged_case_file_is_draped_again(self, setup, tmp_path):
        case = fake_case(setup, Fake())
        first = evaluate_draping([case], tmp_path, networks="n", pictures=False)
        (path,) = (tmp_path / "cases").iterdir()
        path.write_text("{")
        assert evaluate_draping([case], tmp_path, networks="n", pictures=False).rows == first.rows

    def test_progress_ends_with_all_cases(self, setup, tmp_path):
        seen: list[tuple[int, int]] = []
        case = fake_case(setup, Fake())
        evaluate_draping(
            [case], tmp_path, networks="n", pictures=False, progress=lambda d, t, x: seen.append((d, t))
        )
        assert seen == [(0, 1), (1, 1)]


def test_runs_are_compared_in_the_frames_they_share(setup):
    """At twice the rate every second frame is one of the slow run; there the shift is found."""
    case = fake_case(setup, Fake())

    def shifted(case: StressCase) -> StressRun:
        run = Fake()(case)
        return replace(run, layers=tuple(layer + np.float32(0.01) for layer in run.layers))

    found = runs._distance(shifted(case).layers, [layer[::2] for layer in case.drape().layers], 2)
    np.testing.assert_allclose(found, [0.01 * 3**0.5, 0, 0.01 * 3**0.5, 0], rtol=1e-4)


class TestRealCases:
    """Coarse and short: the paths through draping, not its quality."""

    def small(self, setup: StressSetup, names: list[str], values: tuple[float, ...]) -> StressCase:
        case = setup.case("T0", "x", names, setup.walk(2), Sweep("x", values, ("corrections", "far")))
        return replace(case, options=replace(case.options, resolution=40))

    def test_a_plain_case_with_a_picture(self, setup, tmp_path):
        case = self.small(setup, ["tee"], (1.0, 2.0))
        table = evaluate_draping([case], tmp_path, networks="n")
        assert len(table.rows) == 2
        assert {"before_body_area_max", "corrected_mm", "far_percent"} <= set(table.rows[0])
        assert (tmp_path / "pictures" / "T0.png").stat().st_size > 10_000

    def test_the_same_run_in_other_chunks_and_in_16_bits(self, setup):
        case = self.small(setup, ["tee", "open_jacket"], (1.0, 2.0))
        chunked = replace(case, options=replace(case.options, chunk=1))
        run = runs.compared_with(change=lambda c: replace(c, options=replace(c.options, chunk=16)))(chunked)
        assert run.difference is not None
        assert run.difference.max() < 0.02, "the last bits differ, and what crosses is lifted or not"
        assert run.difference_before is not None
        assert run.difference_before[0] >= 0
        low = replace(case, outfit=runs.lower_precision(case.outfit, torch.bfloat16))
        run = runs.compared_with(change=lambda c: replace(c, outfit=case.outfit))(low)
        assert run.difference is not None
        assert 0 < run.difference.max() < 0.02

    @pytest.mark.parametrize("region", [runs.at_the_back, runs.along_the_sides])
    def test_placed_contact_is_where_it_should_be(self, setup, region):
        case = self.small(setup, ["tee", "tee"], (2.0, 10.0))
        run = runs.placed_contact(region)(case)
        garment = run.scene.layers[0].garment
        share = region(garment, dict(case.outfit.items[0].bundle.model.edge_names))
        assert share.min() == 0
        assert share.max() == 1
        assert run.before is not None
        way = np.linalg.norm(run.layers[0][1] - run.layers[0][0], axis=1)
        moved = np.linalg.norm(run.layers[1] - run.before[1], axis=2)
        assert np.isfinite(moved).all()
        assert way.shape == share.shape
        front_only = np.setdiff1d(garment.panels["front"].vertex_index, garment.panels["back"].vertex_index)
        if region is runs.at_the_back:
            assert share[front_only].max() == 0
        else:
            assert share[front_only].max() > 0.3

    def test_smoothing_projects_again(self, setup):
        case = self.small(setup, ["tee", "open_jacket"], (3.0, 3.0))
        run = runs.smoothed(3)(case)
        assert run.before is not None
        plain = drape_case(case)
        nearest = skin_beneath(plain.layers[0][0], plain.body[0])
        first, second = plain.layers[0] - plain.body[:, nearest]
        expected = plain.body[0, nearest] + (2 * first + second) / 3
        np.testing.assert_allclose(run.before[0][0], expected, atol=1e-6)
        (row,) = measure(case, run).rows
        assert {"before_body_area_max", "before_inner_area_max", "body_area_max"} <= set(row)
        assert row["corrected_mm"] > 0


def test_the_digest_of_a_collection_follows_its_files(tmp_path: Path):
    (tmp_path / "collection.toml").write_text("a")
    first = digest_of(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    assert digest_of(tmp_path) == first
    (tmp_path / "top.safetensors").write_bytes(b"x")
    assert digest_of(tmp_path) != first
