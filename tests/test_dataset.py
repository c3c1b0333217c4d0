"""Data sets: what is stored, resuming, independence of the number of workers, bad files."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rest_bodies import maker

from isp_assets.conventions import PANELS
from isp_assets.errors import DatasetError
from isp_assets.train import garment_maker
from isp_assets.train.dataset import load_dataset, make_dataset
from isp_assets.train.dataset_sheet import draw_sheet
from isp_assets.train.garment_maker import CATEGORIES, Draft, GarmentMaker

pytest.importorskip("numba")
pytest.importorskip("ipctk")

EDGE = 0.05  # coarse, for speed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data")
    make_dataset(out, counts={"skirt": 3}, seed=3, workers=1, edge_length=EDGE)
    return out


def contents(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def test_a_category_comes_back_whole(folder):
    data = load_dataset(folder, "skirt")
    assert [g.name for g in data.garments] == ["mini_skirt", "pencil_skirt", "a_line_skirt"]
    assert data.edge_names == CATEGORIES["skirt"].edge_names
    assert data.seam_pairs == ((1, 1), (3, 3))
    assert data.anchor_labels == (2,)
    assert data.body_sha256 == maker().body_sha256
    assert data.rest_pose.shape == (24, 3)
    for garment in data.garments:
        used = np.concatenate([garment.panels[side].vertex_index for side in PANELS])
        assert np.array_equal(np.unique(used), np.arange(len(garment.rest_vertices)))
        assert len(garment.anchors) > 10
        assert garment.metrics["self_intersects"] == 0
        for side, winding in zip(PANELS, (1, -1), strict=True):
            panel = garment.panels[side]
            a, b, c = (panel.xy[panel.faces[:, k]] for k in range(3))
            u, v = b - a, c - a
            assert (winding * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) > 0).all()
            network = (panel.xy - data.panel_center) / data.panel_scale
            assert np.abs(network).max() <= 0.95
            assert set(panel.outline_label.tolist()) == {1, 2, 3, 4}
            gaps = np.linalg.norm(panel.outline_xy - np.roll(panel.outline_xy, -1, axis=0), axis=1)
            assert gaps.max() < 0.0065


def test_the_index_counts_and_summarises(folder):
    index = json.loads((folder / "dataset.json").read_text())
    assert index["schema"] == "isp-assets/dataset"
    assert index["seed"] == 3
    skirts = index["categories"]["skirt"]
    assert skirts["files"] == ["0000_mini_skirt.npz", "0001_pencil_skirt.npz", "0002_a_line_skirt.npz"]
    assert isinstance(skirts["rejections"], list)
    strain = skirts["statistics"]["strain_mean"]
    assert strain["min"] <= strain["median"] <= strain["max"]


def test_a_cut_off_run_is_completed_with_the_same_bytes(folder):
    before = contents(folder)
    (folder / "dataset.json").unlink()
    (folder / "skirt/0000_mini_skirt.npz").unlink()
    damaged = folder / "skirt/0001_pencil_skirt.npz"
    damaged.write_bytes(damaged.read_bytes()[:5000])
    seen = []
    make_dataset(
        folder, counts={"skirt": 3}, seed=3, workers=1, edge_length=EDGE,
        progress=lambda done, total, message: seen.append((done, total, message)),
    )  # fmt: skip
    assert [(done, total) for done, total, _ in seen] == [(2, 3), (3, 3)]  # the third was kept
    assert contents(folder) == before


def test_garments_of_another_recipe_are_not_touched(folder):
    before = contents(folder)
    with pytest.raises(DatasetError, match="choose another folder"):
        make_dataset(folder, counts={"skirt": 1}, seed=4, workers=1, edge_length=EDGE)
    assert contents(folder) == before


def test_random_garments_depend_on_seed_index_and_attempt_alone():
    first = Draft("top", 12).parameters(seed=0, attempt=0)
    assert first == Draft("top", 12).parameters(0, 0)
    assert first != Draft("top", 13).parameters(0, 0)
    assert first != Draft("top", 12).parameters(0, 1)
    assert first != Draft("top", 12).parameters(1, 0)
    assert first != Draft("top", 12, test=True).parameters(0, 0)
    preset = CATEGORIES["top"].presets["tank_top"]
    assert Draft("top", 0).parameters(0, 0) == Draft("top", 0).parameters(0, 1) == preset
    assert Draft("top", 0, test=True).parameters(0, 0) != preset
    assert Draft("trousers", 9).file == "0009_trousers_0009.npz"
    assert Draft("trousers", 9, test=True).file == "trousers_test_0009.npz"


def test_test_garments_are_random_and_kept_apart(folder, tmp_path):
    with pytest.raises(DatasetError, match="no test garments of 'skirt'"):
        load_dataset(folder, "skirt", test=True)
    shutil.copytree(folder, tmp_path / "data")
    make_dataset(tmp_path / "data", counts={"skirt": 2}, test=1, seed=3, workers=1, edge_length=EDGE)
    train, test = (load_dataset(tmp_path / "data", "skirt", test=t) for t in (False, True))
    assert [g.name for g in train.garments] == ["mini_skirt", "pencil_skirt"]
    assert [g.name for g in test.garments] == ["skirt_test_0000"]
    assert test.garments[0].parameters != train.garments[0].parameters
    assert (test.panel_scale, test.seam_pairs) == (train.panel_scale, train.seam_pairs)


def test_collars_rise_along_the_neck():
    """A higher collar makes the panel higher by just as much."""
    body, preset = maker().rest_body("top"), CATEGORIES["top"].presets["turtleneck"]
    tops = []
    for height in (0.025, 0.045):
        drawn = CATEGORIES["top"].draw(body, body.landmarks, replace(preset, collar=height))
        tops.append(max(edge.points[:, 1].max() for edge in drawn.panels["back"][0]))
    assert tops[1] - tops[0] == pytest.approx(0.020, abs=1e-9)


def test_a_sheet_shows_a_random_sample(folder, tmp_path):
    pytest.importorskip("matplotlib")
    data = load_dataset(folder, "skirt")
    names = draw_sheet(data, tmp_path / "a.png", count=2)
    assert len(names) == 2
    assert set(names) <= {g.name for g in data.garments}
    assert draw_sheet(data, tmp_path / "b.png", count=2) == names
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert len(draw_sheet(data, tmp_path / "a.png", count=9)) == 3


def test_bad_drafts_are_drawn_again_and_counted(tmp_path, monkeypatch):
    faults = iter(["self_intersects 1 > 0.5", "residual 9 > 2", None])
    monkeypatch.setattr(GarmentMaker, "_fault", lambda *_: next(faults))
    counts = {"skirt": 1}
    make_dataset(tmp_path, counts=counts, seed=0, workers=1, edge_length=0.06)
    index = json.loads((tmp_path / "dataset.json").read_text())
    assert [r["reason"] for r in index["categories"]["skirt"]["rejections"]] == [
        "self_intersects 1 > 0.5",
        "residual 9 > 2",
    ]


def test_no_good_draft_is_an_error_that_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(garment_maker, "_ATTEMPTS", 1)
    monkeypatch.setattr(garment_maker, "_LIMITS", {"strain_max": -1.0})
    with pytest.raises(DatasetError, match=r"'mini_skirt': no good draft in 1.*strain_max"):
        make_dataset(tmp_path, counts={"skirt": 1}, workers=1, edge_length=0.06)


@pytest.mark.parametrize("counts", [{}, {"hat": 3}, {"top": 0}])
def test_bad_counts_are_named(tmp_path, counts):
    with pytest.raises(DatasetError, match="expected counts"):
        make_dataset(tmp_path, counts=counts)


def test_bad_files_are_named(tmp_path, folder):
    with pytest.raises(DatasetError, match="holds no complete data set"):
        load_dataset(tmp_path, "skirt")
    with pytest.raises(DatasetError, match="no category 'trousers'"):
        load_dataset(folder, "trousers")
    (tmp_path / "dataset.json").write_text("{")
    with pytest.raises(DatasetError, match="damaged"):
        load_dataset(tmp_path, "skirt")
    (tmp_path / "dataset.json").write_text('{"schema": "isp-assets/dataset", "version": 99}')
    with pytest.raises(DatasetError, match="expected schema isp-assets/dataset version 2, got"):
        load_dataset(tmp_path, "skirt")
    index = json.loads((folder / "dataset.json").read_text())
    (tmp_path / "dataset.json").write_text(json.dumps(index))
    with pytest.raises(DatasetError, match=r"0000_mini_skirt\.npz is missing or damaged"):
        load_dataset(tmp_path, "skirt")


def test_pickled_arrays_are_never_read(tmp_path, folder):
    index = json.loads((folder / "dataset.json").read_text())
    (tmp_path / "dataset.json").write_text(json.dumps(index))
    (tmp_path / "skirt").mkdir()
    np.savez(tmp_path / "skirt/0000_mini_skirt.npz", meta=np.array({"a": 1}, dtype=object))
    with pytest.raises(DatasetError, match="allow_pickle"):
        load_dataset(tmp_path, "skirt")


@pytest.mark.slow
def test_two_processes_make_the_same_garments(tmp_path, folder):
    make_dataset(tmp_path, counts={"skirt": 3}, seed=3, workers=2, edge_length=EDGE)
    assert contents(tmp_path) == contents(folder)
