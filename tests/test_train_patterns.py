"""Pattern and atlas training on three sewn tubes, from data to a bundle that decodes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from training_sets import tube_dataset

from isp_assets.bundle import GarmentBundle
from isp_assets.errors import DatasetError, TrainError
from isp_assets.train import rehearsal
from isp_assets.train.assemble import assemble_bundle
from isp_assets.train.atlas import (
    AtlasOptions,
    AtlasTask,
    FurtherAtlasTask,
    train_atlas,
    train_atlas_further,
    weigh_slip,
)
from isp_assets.train.atlas_metrics import measure_atlases
from isp_assets.train.atlas_samples import AtlasSamples, network_xy, places, seam_indices
from isp_assets.train.loop import CHECKPOINT, RunOptions, read_checkpoint
from isp_assets.train.pattern_metrics import measure_fields
from isp_assets.train.patterns import PatternOptions, dataset_digest, panel_outline, train_patterns
from isp_assets.train.sampling import SamplingOptions

PATTERNS = PatternOptions(code_size=4, width=24, field_rate=3e-3, sampling=SamplingOptions(points=2000))
ATLAS = AtlasOptions(width=24, depth=4, skip=2, fold_size=2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder, dataset = tmp_path_factory.mktemp("tube"), tube_dataset()
    torch.manual_seed(0)
    train_patterns(dataset, folder / "patterns", run=RunOptions(steps=300, measurements=1), options=PATTERNS)
    checkpoint = folder / "patterns" / CHECKPOINT
    train_atlas(
        dataset, checkpoint, folder / "atlas", run=RunOptions(steps=300, measurements=1), options=ATLAS
    )
    return dataset, folder


def test_the_bundle_knows_the_garments(trained):
    dataset, folder = trained
    bundle = GarmentBundle.load(folder / "atlas" / "tube.safetensors")
    assert list(bundle.codes) == ["tube_0", "tube_1", "tube_2"]
    assert bundle.metrics["patterns"]["iou"] > 0.9
    assert bundle.metrics["patterns"]["border_mm"] < 10
    assert bundle.metrics["patterns"]["label_accuracy"] > 0.85
    assert bundle.metrics["atlas"]["vertex_mm"] < 15
    assert bundle.metrics["atlas"]["seam_mm"] < 15
    assert bundle.metrics["float32"]["atlas"]["vertex_mm"] == pytest.approx(
        bundle.metrics["atlas"]["vertex_mm"], rel=0.02
    )
    assert len(bundle.metrics["codes"]["std"]) == 4 + 2
    assert bundle.provenance["patterns"]["step"] == 300
    assert bundle.provenance["dataset_sha256"] == dataset_digest(dataset)
    garment = bundle.decode("tube_1", resolution=48)
    assert np.ptp(garment.panels["front"].panel_xy, axis=0) == pytest.approx([0.5, 0.5], abs=0.06)
    assert len(garment.seams) == 2


def test_metrics_of_stored_weights_are_those_of_the_file(trained):
    dataset, folder = trained
    bundle = GarmentBundle.load(folder / "atlas" / "tube.safetensors")
    codes = torch.from_numpy(np.stack(list(bundle.codes.values())))
    found = measure_atlases(bundle.model.atlases, codes, dataset, garments=range(3))
    assert found == pytest.approx(bundle.metrics["atlas"], rel=1e-4)


def test_parts_of_different_runs_are_refused(trained, tmp_path):
    dataset, folder = trained
    train_patterns(dataset, tmp_path, run=RunOptions(steps=2, measurements=1), options=PATTERNS)
    with pytest.raises(TrainError, match="step of the patterns"):
        assemble_bundle(dataset, tmp_path / CHECKPOINT, folder / "atlas" / CHECKPOINT)
    with pytest.raises(TrainError, match="another dataset"):
        AtlasTask(tube_dataset((0.3, 0.4)), tmp_path / CHECKPOINT, ATLAS, RunOptions(steps=1))


def test_atlases_trained_further_are_better_and_nothing_else_changes(trained, tmp_path):
    dataset, folder = trained
    old = GarmentBundle.load(folder / "atlas" / "tube.safetensors")
    options = replace(ATLAS, rate=1e-3)
    train_atlas_further(
        dataset, old, tmp_path, run=RunOptions(steps=200, hold=0.1, measurements=1), options=options
    )
    new = GarmentBundle.load(tmp_path / "tube.safetensors")
    assert new.metrics["atlas"]["vertex_mm"] < 0.9 * old.metrics["atlas"]["vertex_mm"]
    assert new.metrics["patterns"] == pytest.approx(old.metrics["patterns"], rel=1e-4)
    assert all(np.array_equal(new.codes[name], code) for name, code in old.codes.items())
    for side, field in old.model.panel_fields.items():
        kept = new.model.panel_fields[side].state_dict()
        assert all(torch.equal(kept[name], value) for name, value in field.state_dict().items())
    assert new.provenance["atlas"]["step"] == 200
    assert new.provenance["atlas"]["dataset_sha256"] == dataset_digest(dataset)
    assert new.provenance["atlas"]["earlier"] == old.provenance["atlas"]
    assert new.provenance["patterns"] == old.provenance["patterns"]


def test_atlases_are_trained_further_on_their_own_garments_only(trained):
    bundle = GarmentBundle.load(trained[1] / "atlas" / "tube.safetensors")
    with pytest.raises(TrainError, match="other garments of the same names"):
        FurtherAtlasTask(tube_dataset((0.3, 0.4, 0.9)), bundle, ATLAS, RunOptions(steps=1))
    with pytest.raises(TrainError, match="holds 'tube', the dataset 'hose'"):
        FurtherAtlasTask(replace(tube_dataset(), category="hose"), bundle, ATLAS, RunOptions(steps=1))
    with pytest.raises(TrainError, match=r"no codes for 1 of the dataset's 4 .*tube_3"):
        FurtherAtlasTask(tube_dataset((0.3, 0.4, 0.5, 0.6)), bundle, ATLAS, RunOptions(steps=1))


@pytest.mark.parametrize("widths", [(0.4, 0.5), (0.4, 0.5, 0.9)])
def test_garments_that_a_dataset_lacks_are_rehearsed(trained, widths, tmp_path, monkeypatch):
    """The third tube is missing, or another one bears its name: the bundle shows what it was."""
    monkeypatch.setattr(rehearsal, "_MOST_OTHERS", 0.5)
    bundle = GarmentBundle.load(trained[1] / "atlas" / "tube.safetensors")
    dataset = tube_dataset(widths)
    found = rehearsal.rehearse(dataset, bundle)
    assert [garment.name for garment in found.known.garments] == ["tube_0", "tube_1"]
    assert found.rehearsed == ["tube_2"]
    shown = found.all.garments[2]
    assert np.ptp(shown.panels["front"].xy, axis=0) == pytest.approx([0.6, 0.5], abs=0.06)
    assert shown.faces.max() < len(shown.rest_vertices)
    assert len(seam_indices(shown)["front"]) > 10
    run = RunOptions(steps=2, measurements=1)
    train_atlas_further(dataset, bundle, tmp_path, run=run, options=replace(ATLAS, rate=1e-5))
    assert GarmentBundle.load(tmp_path / "tube.safetensors").provenance["atlas"]["rehearsed"] == ["tube_2"]


def test_fold_codes_tell_apart_garments_of_one_pattern_and_leave_the_pattern_alone(tmp_path):
    dataset = tube_dataset((0.4, 0.4))
    bulged = dataset.garments[1].rest_vertices + np.array([0.0, 0.0, 0.02])
    garments = (dataset.garments[0], replace(dataset.garments[1], rest_vertices=bulged))
    dataset = replace(dataset, garments=garments)
    options = replace(PATTERNS, code_spread=0.0)
    train_patterns(dataset, tmp_path / "p", run=RunOptions(steps=20, measurements=1), options=options)
    errors = {}
    for size in (0, 2):
        train_atlas(
            dataset, tmp_path / "p" / CHECKPOINT, tmp_path / f"{size}",
            run=RunOptions(steps=400, hold=0.2, measurements=1), options=replace(ATLAS, fold_size=size),
        )  # fmt: skip
        bundle = GarmentBundle.load(tmp_path / f"{size}" / "tube.safetensors")
        errors[size] = bundle.metrics["atlas"]["vertex_mm"]
    assert errors[0] > 9.5  # in the middle between the two
    assert errors[2] < 0.5 * errors[0]
    xy = torch.linspace(-0.9, 0.9, 40).reshape(20, 2)
    code = torch.from_numpy(bundle.code("tube_0"))
    other = code + torch.tensor([0.0] * 4 + [3.0, -5.0])
    for field in bundle.model.panel_fields.values():
        for one, two in zip(field(xy, code), field(xy, other), strict=True):
            assert torch.equal(one, two)


def test_slip_is_what_lies_along_the_triangle():
    normal = torch.tensor([0.0, 0.0, 3.0])
    error = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0], [3.0, 4.0, -5.0]])
    expected = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 2.0], [1.5, 2.0, -5.0]])
    assert torch.allclose(weigh_slip(error, normal, 0.5), expected)
    assert torch.allclose(weigh_slip(error, normal, 1.0), error)


def test_resumed_pattern_training_ends_as_if_it_had_gone_on(tmp_path):
    dataset, options = tube_dataset(), PATTERNS
    train_patterns(
        dataset, tmp_path / "whole", run=RunOptions(steps=6, hold=1.0, measurements=1), options=options
    )
    for steps in (3, 6):
        run = RunOptions(steps=steps, hold=1.0, measurements=1, resume=True)
        train_patterns(dataset, tmp_path / "parts", run=run, options=options)
    whole, parts = (read_checkpoint(tmp_path / name / CHECKPOINT)[0] for name in ("whole", "parts"))
    torch.testing.assert_close(parts, whole, rtol=1e-4, atol=1e-5)  # the last bits depend on the processor


def test_an_empty_dataset_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="no garment"):
        train_patterns(tube_dataset(()), tmp_path, run=RunOptions(steps=1))


def test_the_digest_sees_every_garment():
    digests = {
        dataset_digest(tube_dataset(widths)) for widths in ((0.4, 0.5), (0.5, 0.4), (0.4, 0.5001), (0.4,))
    }
    assert len(digests) == 4


class _Rectangle(torch.nn.Module):
    """The exact field of a tube's panel, off by a constant."""

    def __init__(self, half: torch.Tensor, center: torch.Tensor, error: float) -> None:
        super().__init__()
        self.half, self.center, self.error = half, center, error

    def forward(self, xy, code):
        over = (xy - self.center).abs() - self.half
        distance = over.clamp_min(0).norm(dim=-1) + over.amax(-1).clamp_max(0)
        return distance + self.error, torch.nn.functional.one_hot(
            torch.ones(len(xy), dtype=torch.long), 5
        ).float()


@pytest.mark.parametrize("error", [0.0, 0.01])
def test_metrics_of_a_known_field(error):
    dataset = tube_dataset((0.5,))
    outline = panel_outline(dataset, dataset.garments[0].panels["front"]).points
    low, high = (torch.tensor(f(0), dtype=torch.float64) for f in (outline.min, outline.max))
    field = _Rectangle((high - low) / 2, (high + low) / 2, error)
    fields = {"front": field, "back": field}
    found = measure_fields(fields, torch.zeros(1, 4).double(), dataset, garments=[0])
    assert found["distance_mm"] == pytest.approx(1000 * error * dataset.panel_scale, abs=1e-3)
    assert found["border_mm"] == pytest.approx(1000 * error * dataset.panel_scale, abs=1e-3)
    assert found["border_label_accuracy"] == pytest.approx(0.25, abs=0.05)
    assert found["iou"] == pytest.approx(1 if error == 0 else (0.49 / 0.5) ** 2, abs=0.05)


def test_seam_samples_lie_on_both_panels():
    dataset = tube_dataset()
    samples = AtlasSamples(dataset, torch.device("cpu"))
    seam = samples.seams(torch.tensor([2, 0]), 50, torch.Generator().manual_seed(0))
    assert torch.equal(seam["front"][..., 2:], seam["back"][..., 2:])
    half = torch.tensor([0.3, 0.2])[:, None] / dataset.panel_scale
    torch.testing.assert_close(seam["front"][..., 0].abs(), half.expand(2, 50))
    triangles = samples.triangles("back", torch.tensor([1]), 20, torch.Generator().manual_seed(0))
    assert triangles.shape == (1, 20, 3, 5)
    assert (triangles[..., 4] < 1e-6).all()


def test_triangles_are_small_copies_of_those_of_the_mesh():
    """Inside one of the mesh's triangles each, with its normal; their middles spread over it."""
    dataset = tube_dataset((0.4,))
    garment = dataset.garments[0]
    samples = AtlasSamples(dataset, torch.device("cpu"))
    drawn = samples.triangles("front", torch.tensor([0]), 4000, torch.Generator().manual_seed(0))[0].numpy()
    panel = garment.panels["front"]
    mesh = np.concatenate([network_xy(dataset, garment, "front"), places(garment, "front")], axis=1)[
        panel.faces
    ]
    middle = drawn.mean(axis=1)
    system = np.concatenate([mesh[..., :2], np.ones((len(mesh), 3, 1))], axis=2).transpose(0, 2, 1)
    weights = np.linalg.inv(system) @ np.append(middle[:, :2], np.ones((len(middle), 1)), axis=1).T  # F 3 n
    face = weights.min(axis=1).argmax(axis=0)
    inside = weights[face, :, np.arange(len(middle))]
    assert inside.min() > -1e-5
    np.testing.assert_allclose(inside.mean(axis=0), 1 / 3, atol=0.02)
    # A tube of 8 x 8 cells has 128 triangles a panel, of which 56 touch the border.
    border = np.abs(mesh[..., :2]).max(axis=1) >= np.abs(mesh[..., :2]).max(axis=(0, 1)) - 1e-6
    assert border.any(axis=1)[face].mean() == pytest.approx(0.4 + 0.6 * 56 / 128, abs=0.03)
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", inside, mesh[face]), middle, atol=1e-5)
    sizes = np.linalg.norm(drawn[:, 1] - drawn[:, 0], axis=1) / np.linalg.norm(
        mesh[face, 1] - mesh[face, 0], axis=1
    )
    assert 0.19 < sizes.min() < 0.25
    assert 0.95 < sizes.max() < 1.001


def test_seam_indices_match():
    garment = tube_dataset().garments[1]
    index = seam_indices(garment)
    np.testing.assert_array_equal(*(places(garment, side)[index[side]] for side in ("front", "back")))
    assert len(index["front"]) == 18
