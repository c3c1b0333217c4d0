"""The comparison of rest shapes, on tubes whose answer is known; its files; and robustness counts."""

import csv
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model
from training_sets import tube_dataset

from isp_assets.bundle import GarmentBundle
from isp_assets.errors import BundleError, DatasetError, GeometryError, InputError, PluginError
from isp_assets.evaluate.paper import PAPER_SHIRTS
from isp_assets.evaluate.reconstruction import (
    FIGURES,
    Decoded,
    IspReconstructor,
    ReconstructionOptions,
    evaluate_reconstruction,
    garment_surface,
    half_diagonal,
    load_peer,
)
from isp_assets.evaluate.robustness import RobustnessOptions, evaluate_robustness
from isp_assets.evaluate.table import write_table
from isp_assets.geometry.surface_distance import Surface

OPTIONS = ReconstructionOptions(resolutions=(8, 16), garments=3, finest=1, samples=3000)


class Tubes:
    """Gives back the garments of a data set, moved by the code; refuses one by name."""

    name = "tubes"

    def __init__(self, data, *, shift: float = 0.002, broken: str = "") -> None:
        self.surfaces = {g.name: garment_surface(g) for g in data.garments}
        self.codes = {name: np.array([k, shift]) for k, name in enumerate(self.surfaces)}
        self.broken = broken

    def decode(self, code, resolution):
        name = list(self.surfaces)[int(code[0])]
        if name == self.broken:
            raise GeometryError("broken on purpose")
        surface = self.surfaces[name]
        return Decoded(Surface(surface.vertices + np.array([0.0, code[1], 0.0]), surface.faces), 0.001)

    def fit(self, surface):
        sizes = [abs(np.ptp(s.vertices, axis=0).sum() - np.ptp(surface.vertices, axis=0).sum())
                 for s in self.surfaces.values()]  # fmt: skip
        return np.array([int(np.argmin(sizes)), 0.0])


@pytest.fixture(scope="module")
def data():
    return {"train": tube_dataset((0.4, 0.5, 0.6)), "test": tube_dataset((0.5,))}


def test_a_shift_shows_as_its_distance(data):
    table = evaluate_reconstruction([Tubes(data["train"])], data, OPTIONS)
    rows = {(row["split"], row["resolution"]): row for row in table.rows}
    assert set(rows) == {("train", 8), ("train", 16), ("test", 8), ("test", 16)}
    train = rows["train", 8]
    assert (train["garments"], train["failures"]) == (3, 0)
    # Shifted along itself, the tube leaves itself only at its ends: 2 mm of 500.
    assert train["mean_mm"] == pytest.approx(0.002 / 0.5 * 1, rel=0.5)
    assert train["max_mm"] == pytest.approx(2.0, rel=0.2)
    assert train["nc_percent"] > 95
    assert train["seam_mm"] == pytest.approx(1.0)
    assert rows["test", 8]["max_mm"] < 1e-6, "the fit found the very tube"
    assert rows["test", 8]["chd_1e4"] == pytest.approx(rows["test", 8]["floor_1e4"], rel=0.1)
    assert rows["train", 16]["garments"] == 1, "fewer garments at the finest resolution"
    assert rows["test", 8]["fit_s"] is not None
    assert len(table.garments) == 3 + 1 + 1 + 1


def test_the_unit_is_half_the_largest_diagonal(data):
    width = 0.6 / np.pi * 2
    assert half_diagonal(data["train"]) == pytest.approx(0.5 * np.sqrt(2 * width**2 + 0.25), rel=0.01)


def test_failures_are_counted_and_kept(data):
    table = evaluate_reconstruction([Tubes(data["train"], broken="tube_1")], data, OPTIONS)
    row = next(r for r in table.rows if r["split"] == "train" and r["resolution"] == 8)
    assert (row["garments"], row["failures"]) == (3, 1)
    assert any(g.get("error") == "broken on purpose" for g in table.garments)
    test = next(r for r in table.rows if r["split"] == "test")
    assert test["failures"] == 1
    assert "mean_mm" not in test


def test_a_method_trained_on_other_garments_is_refused(data):
    method = Tubes(data["train"])
    method.codes = {}
    with pytest.raises(DatasetError, match="no code for the training garment 'tube_0'"):
        evaluate_reconstruction([method], data, OPTIONS)


def test_a_garment_bundle_takes_part(data):
    bundle = GarmentBundle(
        polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,)),
        {f"tube_{k}": np.array([0.02 * k, 0.0], np.float32) for k in range(3)}, "0" * 64,
    )  # fmt: skip
    method = IspReconstructor(bundle)
    decoded = method.decode(bundle.codes["tube_1"], 32)
    assert decoded.seam_gap == pytest.approx(0.2)
    assert len(decoded.surface.faces) > 50


def test_tables_come_back(data, tmp_path):
    table = evaluate_reconstruction([Tubes(data["train"])], data, OPTIONS)
    rows = [*table.rows, *PAPER_SHIRTS]
    write_table(tmp_path, "t", rows, meanings=FIGURES, details={"garments": table.garments})
    stored = json.loads((tmp_path / "t.json").read_text())
    assert stored["rows"] == rows
    assert stored["machine"]["device"] == "cpu"
    with (tmp_path / "t.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [float(r["chd_1e4"]) for r in read] == [row["chd_1e4"] for row in rows]
    text = (tmp_path / "t.md").read_text()
    assert "(quoted)" in text
    assert text.count("\n| ") == len(rows)
    assert "`nc_percent`" in text


def test_the_finest_resolution_is_measured_for_as_many_as_asked():
    options = ReconstructionOptions(resolutions=(128, 256), finest=6)
    assert sum(256 in options.resolutions_of(k, 20) for k in range(20)) == 6
    assert options.resolutions_of(0, 20) == (128, 256)
    assert all(256 in options.resolutions_of(k, 4) for k in range(4)), "all, if there are fewer"
    one = ReconstructionOptions(resolutions=(256,), finest=1)
    assert all(one.resolutions_of(k, 20) == (256,) for k in range(20))


@pytest.mark.parametrize("wrong", [{"resolutions": ()}, {"garments": 0}, {"samples": 0}])
def test_nothing_to_measure_is_refused(wrong):
    with pytest.raises(InputError, match="expected at least one"):
        ReconstructionOptions(**wrong)


def test_the_papers_figures_are_those_of_its_table():
    found = {(r["method"][:3], r["split"], r["resolution"]): r["chd_1e4"] for r in PAPER_SHIRTS}
    assert found["ISP", "train", 512] == 0.250
    assert found["ISP", "test", 128] == 0.579
    assert found["UDF", "test", 512] == 0.424
    assert len(found) == 12


PEER = """
class Nothing:
    name, codes, decode, fit = "nothing", {}, id, id

def reconstructor(argument, category):
    Nothing.codes = {argument: category}
    return Nothing()
"""


def test_peers_come_from_files(tmp_path):
    path = tmp_path / "peer.py"
    path.write_text(PEER)
    assert load_peer(f"{path}=runs/{{category}}", "skirt").codes == {"runs/skirt": "skirt"}
    with pytest.raises(PluginError, match=r"none\.py' cannot be used"):
        load_peer(str(tmp_path / "none.py"), "skirt")
    path.write_text("x = 1\n")
    with pytest.raises(PluginError, match="with a function reconstructor"):
        load_peer(str(path), "skirt")


MEMORY = """
import numpy as np
from isp_assets.evaluate.memory import PeakMemory
with PeakMemory() as nothing:
    pass
with PeakMemory() as memory:
    block = np.ones(40 * 2**20 // 8)
    del block
print(nothing.mib, memory.mib)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps this count")
def test_peak_memory_sees_what_was_given_back():
    """In a fresh process: one that holds free memory takes from it unseen."""
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    nothing, memory = done.stdout.split()
    if memory == "None":
        pytest.skip("the system does not let the count be set back")
    assert 35 < float(memory) < 60
    assert float(nothing) < 5


class TestRobustness:
    """Counts on analytic panels, where it is known which codes fail."""

    options = RobustnessOptions(
        pairs=3, steps=4, random=6, radii=(0.5, 30.0), odd=2, resolution=32, resolutions=(32, 48), garments=2
    )

    @pytest.fixture(scope="class")
    def bundle(self) -> GarmentBundle:
        codes = np.random.default_rng(0).uniform(-0.05, 0.05, (6, 2)).astype(np.float32)
        model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
        return GarmentBundle(model, {f"tube_{k}": code for k, code in enumerate(codes)}, "0" * 64)

    def test_good_codes_are_good_and_far_ones_fail(self, bundle):
        report = evaluate_robustness(bundle, self.options)
        rows = {row["test"]: row for row in report.rows}
        assert list(rows) == [
            "own codes", "mixtures", "random, 0.5 x radius", "random, 30 x radius", "32 cells", "48 cells",
        ]  # fmt: skip
        assert rows["mixtures"]["decodes"] == 12
        for test in ("own codes", "mixtures", "random, 0.5 x radius", "32 cells", "48 cells"):
            assert rows[test]["good_percent"] == 100, test
            assert rows[test]["folded_percent"] == 0
            assert rows[test]["seam_mm"] == pytest.approx(200, rel=0.01)
        far = rows["random, 30 x radius"]
        assert far["errors"] > 0
        assert far["errors"] == len(report.errors)
        assert all("Use a code nearer" in row["message"] for row in report.errors)

    def test_equal_seeds_give_equal_counts(self, bundle):
        first, second = (evaluate_robustness(bundle, self.options).rows for _ in range(2))
        for one, other in zip(first, second, strict=True):
            assert {**one, "seconds": 0} == {**other, "seconds": 0}

    def test_wrong_options_and_bundles_are_refused(self, bundle):
        with pytest.raises(InputError, match="2 mixtures or more"):
            RobustnessOptions(steps=1)
        one = replace(bundle, codes=dict(list(bundle.codes.items())[:1]))
        with pytest.raises(BundleError, match="mixing takes two"):
            evaluate_robustness(one, self.options)

    def test_odd_parameters_go_beyond_their_range_one_by_one(self, bundle):
        """Here the code's first number is the parameter, so pushing it by half its range is exact."""
        data = tube_dataset(tuple(np.linspace(0.4, 0.6, 6)))
        garments = tuple(
            replace(g, parameters={"grow": float(code[0]), "kind": "x"})
            for g, code in zip(data.garments, bundle.codes.values(), strict=True)
        )
        report = evaluate_robustness(bundle, self.options, data=replace(data, garments=garments))
        row = next(r for r in report.rows if r["test"] == "odd grow")
        assert row["decodes"] == 4
        assert row["good_percent"] == 100
