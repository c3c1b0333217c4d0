"""The built-in bundles decode: their own codes, random codes around them, and all that lies in between."""

from pathlib import Path

import numpy as np
import pytest
import torch

import isp_assets
from isp_assets.bundle import GarmentBundle
from isp_assets.decode import SLIVER, cut_panels, decode_with_report, lift_points
from isp_assets.errors import DecodeError
from isp_assets.fit_options import CodeSpace
from isp_assets.garment import Garment
from isp_assets.geometry.sewing import sew_panels
from isp_assets.geometry.topology import boundary_loops, edges

FOLDER = Path(isp_assets.__file__).parent / "data" / "collection"
CATEGORIES = ("top", "skirt", "trousers")
OPENINGS = {"top": {3, 4}, "skirt": {2}, "trousers": {3}}
"""Hem, neck and cuffs, of which an open front joins the first two; waist and hem; waist and legs."""


@pytest.fixture(scope="module", params=CATEGORIES)
def bundle(request) -> GarmentBundle:
    return GarmentBundle.load(FOLDER / f"{request.param}.safetensors")


def _random_codes(bundle: GarmentBundle, count: int, *, spread: float = 1.0) -> np.ndarray:
    space = CodeSpace.of(np.stack(list(bundle.codes.values())))
    draws = np.random.default_rng(0).normal(size=(count, len(space.mean)))
    return np.stack([space.code(spread * draw) for draw in draws]).astype(np.float32)


def _between_codes(bundle: GarmentBundle, count: int) -> list[np.ndarray]:
    codes, rng = list(bundle.codes.values()), np.random.default_rng(1)
    pairs = [rng.choice(len(codes), 2, replace=False) for _ in range(count)]
    return [
        codes[a] + np.float32(t) * (codes[b] - codes[a])
        for (a, b), t in zip(pairs, rng.uniform(size=count), strict=True)
    ]


def _check(garment: Garment) -> None:
    faces = garment.faces
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(directed[:, 0] * len(faces) + directed[:, 1])) == len(directed)
    assert edges(faces).num_faces.max() == 2
    assert len(boundary_loops(faces)) in OPENINGS[garment.category]
    for side, sign in (("front", 1), ("back", -1)):
        panel = garment.panels[side]
        a, b, c = (panel.panel_xy[panel.faces[:, k]].astype(float) for k in range(3))
        area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (sign * area > 0).all()


def _decode_all(bundle: GarmentBundle, codes, resolution: int) -> list[str]:
    failures = []
    for number, code in enumerate(codes):
        try:
            _check(decode_with_report(bundle.model, code, resolution=resolution, name=f"code {number}")[0])
        except DecodeError as error:
            failures.append(str(error))
    return failures


def test_named_garments(bundle):
    for name in list(bundle.codes)[:3]:
        garment, report = decode_with_report(bundle.model, bundle.codes[name], resolution=64, name=name)
        _check(garment)
        assert report.seam_gap_mean < 0.004, "the two sides of the seams lift to nearly one curve"
        assert report.num_specks == 0


def test_random_codes(bundle):
    assert _decode_all(bundle, _random_codes(bundle, 8), 64) == []


def test_far_codes_decode_or_say_why(bundle):
    failures = []
    for code in _random_codes(bundle, 4, spread=4.0):
        try:
            garment = decode_with_report(bundle.model, code, resolution=32)[0]
            assert edges(garment.faces).num_faces.max() <= 2
        except DecodeError as error:
            failures.append(str(error))
    assert all("Use a code nearer" in message for message in failures)


@pytest.mark.slow
@pytest.mark.parametrize("resolution", [64, 128])
def test_every_code_and_many_more(bundle, resolution):
    codes = [*bundle.codes.values(), *_random_codes(bundle, 200), *_between_codes(bundle, 100)]
    assert _decode_all(bundle, codes, resolution) == []


def test_fine_meshes_lie_where_the_atlas_says(bundle: GarmentBundle):
    code = list(bundle.codes.values())[7]
    outlines = cut_panels(bundle.model, code, resolution=256).outlines
    sewn = sew_panels(outlines, bundle.model.seam_pairs, spacing=2 / 256, sliver=SLIVER)
    latent = torch.from_numpy(code)
    with torch.no_grad():
        lifted = lift_points(bundle.model, sewn, latent)
        for side, panel in sewn.panels.items():
            exact = bundle.model.atlases[side](torch.from_numpy(panel.points).float(), latent)
            error = (lifted[side] - exact).norm(dim=1)
            assert 0 < float(error.mean()) < 6e-5  # interpolated, and closely
            assert float(error.max()) < 1e-3
            assert float(error[torch.from_numpy(panel.border_label > 0)].max()) < 1e-6
