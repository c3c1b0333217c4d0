"""Codes on their own: lossless, and refused where they do not belong."""

import numpy as np
import pytest
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model

from isp_assets.bundle import GarmentBundle
from isp_assets.code_file import GarmentCode
from isp_assets.errors import BundleError

NOTES = {"distance_m": {"mean": 0.001}}
CODE = GarmentCode("cape", "top", np.array([0.25, -1.5], np.float32), "ab" * 32, NOTES)


def test_a_code_comes_back(tmp_path):
    CODE.save(tmp_path / "cape.safetensors")
    back = GarmentCode.load(tmp_path / "cape.safetensors")
    np.testing.assert_array_equal(back.code, CODE.code)
    assert (back.name, back.category, back.model_sha256, back.notes) == (
        CODE.name, CODE.category, CODE.model_sha256, CODE.notes,
    )  # fmt: skip
    back.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "cape.safetensors").read_bytes()


def test_bad_files_are_named(tmp_path):
    with pytest.raises(BundleError, match="no such file"):
        GarmentCode.load(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"garbage")
    with pytest.raises(BundleError, match="not a readable safetensors"):
        GarmentCode.load(tmp_path / "bad.safetensors")
    bundle = GarmentBundle(polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS), {}, "0" * 64)
    bundle.save(tmp_path / "bundle.safetensors")
    with pytest.raises(BundleError, match="expected a file of kind 'isp-assets/code'"):
        GarmentCode.load(tmp_path / "bundle.safetensors")
    with pytest.raises(BundleError, match="JSON cannot keep"):
        GarmentCode("cape", "top", CODE.code, "", {"mean": float("nan")}).save(tmp_path / "x.safetensors")
