"""Files of tensors and a manifest: exact, deterministic, atomic, and never trusted."""

import json

import pytest
import torch
from safetensors.torch import save_file

from isp_assets.errors import BundleError
from isp_assets.storage import load_tensors, save_tensors

KIND = {"schema": "isp-assets/test", "version": 1}


def test_what_goes_in_comes_out(tmp_path):
    tensors = {"half": torch.randn(3, 4).half(), "full": torch.randn(5), "flag": torch.tensor([True, False])}
    save_tensors(tmp_path / "a" / "x.safetensors", tensors, {"name": "Größe", "rows": [1, 2.5]}, **KIND)
    loaded, manifest = load_tensors(tmp_path / "a" / "x.safetensors", **KIND)
    assert loaded.keys() == tensors.keys()
    for name, value in tensors.items():
        assert loaded[name].dtype == value.dtype
        assert torch.equal(loaded[name], value)
    assert manifest == {"name": "Größe", "rows": [1, 2.5], **KIND}


def test_the_order_of_content_does_not_change_a_byte(tmp_path):
    a, b = torch.randn(4), torch.randn(2, 2)
    save_tensors(tmp_path / "1", {"a": a, "b": b}, {"x": 1, "y": 2}, **KIND)
    save_tensors(tmp_path / "2", {"b": b, "a": a}, {"y": 2, "x": 1}, **KIND)
    assert (tmp_path / "1").read_bytes() == (tmp_path / "2").read_bytes()


def test_a_view_is_stored_as_what_it_shows(tmp_path):
    base = torch.arange(12.0).reshape(3, 4)
    save_tensors(tmp_path / "x", {"t": base.T, "same": base}, {}, **KIND)
    assert torch.equal(load_tensors(tmp_path / "x", **KIND)[0]["t"], base.T)


@pytest.mark.parametrize("value", [float("nan"), object(), {1, 2}])
def test_what_json_cannot_keep_is_refused_and_the_old_file_stays(tmp_path, value):
    save_tensors(tmp_path / "x", {"a": torch.ones(1)}, {}, **KIND)
    before = (tmp_path / "x").read_bytes()
    with pytest.raises(BundleError, match="JSON"):
        save_tensors(tmp_path / "x", {"a": torch.zeros(1)}, {"bad": value}, **KIND)
    assert (tmp_path / "x").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_an_old_file_goes_through_every_upgrade(tmp_path):
    save_tensors(tmp_path / "x", {"old": torch.ones(2)}, {"trail": []}, **KIND)

    def first(manifest, tensors):
        return {**manifest, "trail": [*manifest["trail"], 1]}, {"new": tensors["old"]}

    def second(manifest, tensors):
        return {**manifest, "trail": [*manifest["trail"], 2]}, tensors

    upgrades = {1: first, 2: second}
    tensors, manifest = load_tensors(tmp_path / "x", schema=KIND["schema"], version=3, upgrades=upgrades)
    assert manifest["trail"] == [1, 2]
    assert manifest["version"] == 3
    assert set(tensors) == {"new"}
    with pytest.raises(BundleError, match="cannot be upgraded"):
        load_tensors(tmp_path / "x", schema=KIND["schema"], version=3, upgrades={1: first})


def test_foreign_and_damaged_files_are_named(tmp_path):
    good = tmp_path / "good"
    save_tensors(good, {"a": torch.ones(100)}, {}, **KIND)
    save_file({"a": torch.ones(1)}, tmp_path / "plain")
    (tmp_path / "cut").write_bytes(good.read_bytes()[:-40])
    (tmp_path / "text").write_text("hello")
    save_file({"a": torch.ones(1)}, tmp_path / "nojson", metadata={"isp-assets": "{"})
    save_file({"a": torch.ones(1)}, tmp_path / "nokind", metadata={"isp-assets": json.dumps({"a": 1})})
    for name, words in {
        "missing": "no such file", "plain": "without our manifest", "cut": "not a readable",
        "text": "not a readable",
        "nojson": "not JSON", "nokind": "no schema",
    }.items():  # fmt: skip
        with pytest.raises(BundleError, match=words) as caught:
            load_tensors(tmp_path / name, **KIND)
        assert name in str(caught.value)
    with pytest.raises(BundleError, match="expected a file of kind 'other'"):
        load_tensors(good, schema="other", version=1)
    save_tensors(good, {}, {}, schema=KIND["schema"], version=9)
    with pytest.raises(BundleError, match=r"version 9 .* reads 1\.\.1"):
        load_tensors(good, **KIND)
