"""Bundles come back exactly, byte for byte on a second save, and say what is wrong with a bad file."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.conventions import PANELS
from isp_assets.errors import BundleError
from isp_assets.garment_model import GarmentModel
from isp_assets.networks.atlas import Atlas, AtlasConfig
from isp_assets.networks.drape_field import DrapeField, DrapeFieldConfig
from isp_assets.networks.layering_net import LayeringConfig, LayeringNet
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.storage import load_tensors, save_tensors


def small_bundle(**changes) -> GarmentBundle:
    model = GarmentModel(
        category="tube",
        panel_fields={side: PanelField(PanelFieldConfig(4, code_size=6, width=8)) for side in PANELS},
        atlases={side: Atlas(AtlasConfig(code_size=6, width=8, offset=(0.1, 1.0, 0.0))) for side in PANELS},
        edge_names={1: "right", 2: "waist", 3: "left", 4: "hem"},
        seam_pairs=((1, 1), (3, 3)), anchor_labels=(2,),
        rest_pose=np.full((24, 3), 0.1), panel_center=np.array([0.0, -0.111]), panel_scale=0.8,
    )  # fmt: skip
    codes = {name: np.random.default_rng(i).normal(size=6).astype(np.float32) for i, name in enumerate("abc")}
    return GarmentBundle(model, codes, "ab" * 32, **changes)


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("with_drape", [False, True])
def test_a_garment_bundle_comes_back(tmp_path, dtype, with_drape):
    drape = DrapeField(DrapeFieldConfig(code_size=6, width=8, basis=3, map_size=16)) if with_drape else None
    bundle = small_bundle(drape_field=drape, provenance={"seed": 3}, metrics={"atlas": {"vertex_mm": 0.25}})
    bundle.save(tmp_path / "1", dtype=dtype)
    back = GarmentBundle.load(tmp_path / "1")
    back.save(tmp_path / "2", dtype=dtype)
    assert (tmp_path / "1").read_bytes() == (tmp_path / "2").read_bytes()
    assert (back.category, back.body_sha256, back.body_name) == ("tube", "ab" * 32, "default")
    assert (back.provenance, back.metrics) == (bundle.provenance, bundle.metrics)
    for name in ("edge_names", "seam_pairs", "anchor_labels", "panel_scale", "code_size", "num_labels"):
        assert getattr(back.model, name) == getattr(bundle.model, name)
    np.testing.assert_array_equal(back.model.rest_pose, bundle.model.rest_pose)
    np.testing.assert_array_equal(back.model.panel_center, bundle.model.panel_center)
    assert list(back.codes) == ["a", "b", "c"]
    for name, code in bundle.codes.items():
        np.testing.assert_array_equal(back.code(name), code)
    stored = getattr(torch, dtype)
    for side in PANELS:
        for kind in ("panel_fields", "atlases"):
            ours, theirs = getattr(bundle.model, kind)[side], getattr(back.model, kind)[side]
            assert theirs.config == ours.config
            for name, value in ours.state_dict().items():
                assert torch.equal(theirs.state_dict()[name], value.to(stored).float())
    assert (back.drape_field is None) == (drape is None)


def test_loaded_networks_keep_gradients_of_the_code_but_not_of_weights(tmp_path):
    small_bundle().save(tmp_path / "x")
    atlas = GarmentBundle.load(tmp_path / "x").model.atlases["back"]
    code = torch.zeros(6, requires_grad=True)
    atlas(torch.rand(4, 2), code).sum().backward()
    assert code.grad.abs().sum() > 0
    assert all(p.grad is None for p in atlas.parameters())


def test_panel_coordinates_invert():
    model = small_bundle().model
    xy = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_allclose(model.to_panel(model.to_network(xy)), xy)
    points = torch.from_numpy(xy)
    torch.testing.assert_close(model.to_panel(model.to_network(points)), points)
    np.testing.assert_allclose(model.to_network(model.panel_center), 0)
    assert np.abs(model.to_network(model.panel_center + np.array([0.8, -0.8])) - [1, -1]).max() < 1e-12


def test_an_unknown_garment_gets_a_hint():
    with pytest.raises(BundleError, match=r"no garment 'd'; it has 3, as a, b, c"):
        small_bundle().decode("d")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"edge_names": {1: "right"}}, "no edge name"),
        ({"edge_names": {1: "a", 2: "b", 3: "c", 9: "d"}}, r"know labels 1\.\.4"),
        ({"panel_scale": 0.0}, "panel_scale"),
        ({"atlases": {}}, "keyed"),
        ({"atlases": {s: Atlas(AtlasConfig(code_size=5, width=4)) for s in PANELS}}, "code size"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(BundleError, match=words):
        replace(small_bundle().model, **changes)


def test_codes_that_do_not_fit_are_refused():
    bundle = small_bundle()
    for code in (np.zeros(5, np.float32), np.full(6, np.nan, np.float32)):
        with pytest.raises(BundleError, match="6 finite numbers"):
            replace(bundle, codes={"bad": code})
    with pytest.raises(BundleError, match="drape field expects"):
        replace(bundle, drape_field=DrapeField(DrapeFieldConfig(code_size=5, width=4, basis=2, map_size=16)))


def test_weights_too_large_for_16_bits_are_refused(tmp_path):
    bundle = small_bundle()
    with torch.no_grad():
        bundle.model.atlases["front"].mlp.layers[0].bias[0] = 1e6
    with pytest.raises(BundleError, match="store it as float32"):
        bundle.save(tmp_path / "x")
    bundle.save(tmp_path / "x", dtype="float32")


def test_a_file_whose_parts_do_not_fit_is_named(tmp_path):
    small_bundle().save(tmp_path / "x")
    kind = {"schema": "isp-assets/garments", "version": 1}
    tensors, manifest = load_tensors(tmp_path / "x", **kind)
    for name in ("atlas.back.mlp.layers.0.weight", "codes", "rest_pose"):
        save_tensors(tmp_path / "y", {k: v for k, v in tensors.items() if k != name}, manifest, **kind)
        with pytest.raises(BundleError, match=r"y: .*damaged"):
            GarmentBundle.load(tmp_path / "y")
    with pytest.raises(BundleError, match="expected a file of kind 'isp-assets/skin'"):
        SkinBundle.load(tmp_path / "x")


def test_a_skin_bundle_comes_back_with_full_precision_buffers(tmp_path):
    field = SkinField(SkinFieldConfig(num_vertices=10, width=8, depth=2))
    field.place_on(torch.randn(1, 10, 3), torch.rand(10))
    SkinBundle(field, "cd" * 32, metrics={"x": 1.0}).save(tmp_path / "1")
    back = SkinBundle.load(tmp_path / "1")
    back.save(tmp_path / "2")
    assert (tmp_path / "1").read_bytes() == (tmp_path / "2").read_bytes()
    assert (back.body_sha256, back.metrics) == ("cd" * 32, {"x": 1.0})
    for name, value in field.named_buffers():
        assert torch.equal(back.skin_field.get_buffer(name), value)


def test_a_layering_bundle_comes_back(tmp_path):
    net = LayeringNet(LayeringConfig(features=2, map_size=16, levels=1))
    LayeringBundle(net, provenance={"seed": 1}).save(tmp_path / "1", dtype="float32")
    back = LayeringBundle.load(tmp_path / "1")
    assert back.provenance == {"seed": 1}
    maps = torch.randn(1, 18, 16, 16)
    torch.testing.assert_close(back.layering_net(maps), net.eval()(maps))
