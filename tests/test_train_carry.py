"""Displacements carried to other codes, and to fewer maps: exact where they can be, and refused elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.bundle import GarmentBundle
from isp_assets.errors import TrainError
from isp_assets.networks.drape_field import POSE_FEATURES, DrapeField, DrapeFieldConfig
from isp_assets.train.carry import CodeMap, carry_displacement, fit_code_map, recoded, shared_garments
from isp_assets.train.fewer_maps import keep_fewer_maps, truncated

SMALL = DrapeFieldConfig(code_size=2, width=16, depth=3, basis=6, map_size=8, coarse_size=4, code_scale=2.0)


def random_field(config: DrapeFieldConfig = SMALL, seed: int = 0) -> DrapeField:
    generator = torch.Generator().manual_seed(seed)
    field = DrapeField(config)
    for parameter in field.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)
    return field.requires_grad_(False)


def features(code: torch.Tensor, count: int = 20) -> torch.Tensor:
    pose = torch.randn(count, POSE_FEATURES + 10, generator=torch.Generator().manual_seed(1))
    return torch.cat([pose, code.expand(count, -1)], 1)


def bundle(codes: np.ndarray, **options) -> GarmentBundle:
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    named = {f"g{k}": code.astype(np.float32) for k, code in enumerate(codes)}
    return GarmentBundle(model, named, "0" * 64, **options)


@given(st.integers(0, 2**31), st.sampled_from([None, 1, 2]), st.sampled_from([2, 3]))
@settings(max_examples=15, deadline=None)
def test_a_recoded_network_is_the_old_one_at_the_mapped_code(seed, skip, new_size):
    field = random_field(replace(SMALL, skip=skip), seed)
    rng = np.random.default_rng(seed)
    code_map = CodeMap(rng.normal(size=(2, new_size)), rng.normal(size=2), 0.0)
    code = rng.normal(size=new_size)
    new = recoded(field, code_map, code_scale=0.7)
    old_code = torch.from_numpy(code_map.matrix @ code + code_map.offset).float()
    torch.testing.assert_close(
        new(features(torch.from_numpy(code).float())), field(features(old_code)), rtol=1e-4, atol=1e-5
    )


def test_a_linear_relation_of_codes_is_found_exactly():
    rng = np.random.default_rng(0)
    new, matrix, offset = rng.normal(size=(40, 5)), rng.normal(size=(3, 5)), rng.normal(size=3)
    found = fit_code_map(new @ matrix.T + offset, new)
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-3)
    np.testing.assert_allclose(found.offset, offset, atol=1e-3)
    assert found.unexplained < 1e-6


def test_codes_without_relation_are_not_explained():
    rng = np.random.default_rng(0)
    found = fit_code_map(rng.normal(size=(30, 4)), rng.normal(size=(30, 20)))
    assert 0.8 < found.unexplained < 1.5
    assert np.linalg.norm(found.matrix) < 0.5, "the ridge keeps a map of noise small"


def test_with_the_same_codes_the_network_is_taken_as_it_is():
    codes = np.random.default_rng(0).uniform(-0.05, 0.05, (3, 2))
    notes = {"provenance": {"drape": {"step": 7}}, "metrics": {"drape": {"gap": 1.0}}}
    old = bundle(codes, drape_field=random_field(), **notes)
    carried = carry_displacement(old, bundle(codes, provenance={"atlas": {"step": 9}}))
    assert carried.drape_field is old.drape_field
    assert carried.provenance == {"atlas": {"step": 9}, "drape": {"step": 7}}
    assert carried.metrics == notes["metrics"]


def test_a_bundle_takes_over_the_displacements_of_another():
    rng = np.random.default_rng(0)
    codes = rng.uniform(-0.05, 0.05, (12, 2))
    old = bundle(codes, drape_field=random_field(), provenance={"drape": {"step": 7}})
    more = bundle(np.concatenate([codes, [[0.0, 0.01]]]))
    carried = carry_displacement(old, more)
    assert carried.provenance["carried"]["garments"] == 12
    assert carried.provenance["carried"]["earlier"] == {"step": 7}
    code = torch.from_numpy(codes[3]).float()
    torch.testing.assert_close(
        carried.drape_field(features(code)), old.drape_field(features(code)), rtol=1e-2, atol=1e-3
    )


def test_garments_that_changed_are_not_shared():
    codes = np.random.default_rng(0).uniform(-0.05, 0.05, (12, 2))
    moved = codes.copy()
    moved[:4, 1] += 0.1
    assert shared_garments(bundle(codes), bundle(moved)) == [f"g{k}" for k in range(4, 12)]


def test_bundles_that_share_too_little_are_refused():
    codes = np.zeros((4, 2))
    with pytest.raises(TrainError, match="no displacement network"):
        carry_displacement(bundle(codes), bundle(codes))
    with pytest.raises(TrainError, match="share 4 garments"):
        carry_displacement(bundle(codes, drape_field=random_field()), bundle(np.zeros((5, 2))))


def test_maps_that_are_combinations_of_others_cost_nothing():
    field = random_field()
    mix = torch.randn(6, 2, generator=torch.Generator().manual_seed(3))
    for name in ("coarse", "fine"):
        maps = getattr(field, name).data
        maps[:-1] = torch.einsum("nk,kcyx->ncyx", mix, maps[:2].clone())
    coefficients = torch.randn(200, 6, generator=torch.Generator().manual_seed(4))
    fewer, lost = truncated(field, coefficients, 2)
    assert lost == pytest.approx(0, abs=1e-9)
    inputs = features(torch.tensor([0.1, -0.2]))
    torch.testing.assert_close(fewer(inputs), field(inputs), rtol=1e-4, atol=1e-6)
    assert fewer.config.basis == 2


def test_truncation_loses_the_least_and_says_how_much():
    """The loss is that of Eckart and Young: the squares of the singular values left out."""
    field = random_field()
    inputs = torch.cat([features(torch.randn(2), 1) for _ in range(60)])
    coefficients = field.coefficients(inputs)
    whole = coefficients @ field.maps()[0].flatten(1)
    spread = torch.linalg.svdvals(whole.double())
    for count in (1, 3, 5, 6):
        fewer, lost = truncated(field, coefficients, count)
        part = fewer.coefficients(inputs) @ fewer.maps()[0].flatten(1)
        measured = float(((part - whole) ** 2).sum() / (whole**2).sum())
        assert measured == pytest.approx(lost, abs=1e-5)
        assert lost == pytest.approx(float((spread[count:] ** 2).sum() / (spread**2).sum()), abs=1e-5)
        torch.testing.assert_close(fewer.maps()[1], field.maps()[1])


def test_no_more_maps_than_there_are():
    codes = np.zeros((4, 2))
    for wrong, count in ((bundle(codes), 2), (bundle(codes, drape_field=random_field()), 7)):
        with pytest.raises(TrainError, match="displacement maps; cannot keep"):
            keep_fewer_maps(wrong, count)


def test_usual_poses_decide_what_is_kept():
    codes = np.random.default_rng(0).uniform(-0.05, 0.05, (4, 2))
    fewer, lost = keep_fewer_maps(bundle(codes, drape_field=random_field()), 5)
    assert fewer.drape_field.config.basis == 5
    assert 0 <= lost < 0.2
    assert fewer.provenance["fewer_maps"] == {"kept": 5, "lost": lost}
