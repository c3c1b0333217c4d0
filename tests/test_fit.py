"""Fits: known codes come back, from many starts and in many spaces; what cannot be fitted is said."""

import numpy as np
import pytest
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model

from isp_assets.alignment import UNITS, Alignment
from isp_assets.bundle import GarmentBundle
from isp_assets.code_file import GarmentCode
from isp_assets.collection import Collection
from isp_assets.errors import DecodeError, GeometryError, MeshError
from isp_assets.fit import Fitter, choose_bundle
from isp_assets.fit_objective import Target
from isp_assets.fit_options import CodeSpace, FitOptions
from isp_assets.geometry.surface_distance import Surface, surface_distance

OPTIONS = FitOptions(neighbours=1, resolution=32, samples=800, rounds=4)
CODES = {
    "a": np.array([-0.05, -0.04], np.float32),
    "b": np.array([0.06, 0.0], np.float32),
    "c": np.array([0.0, 0.05], np.float32),
    "d": np.array([0.02, -0.03], np.float32),
}


@pytest.fixture(scope="module")
def bundle() -> GarmentBundle:
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    return GarmentBundle(model, CODES, "0" * 64)


def surface(bundle: GarmentBundle, code, resolution: int = 64) -> Surface:
    garment = bundle.decode(np.asarray(code, np.float32), resolution=resolution)
    return Surface(garment.rest_vertices.astype(float), garment.faces)


def test_a_known_code_comes_back(bundle):
    """Growth moves the border alone, so only the border term of Eq. 5 can find it."""
    target = surface(bundle, [0.035, 0.02])
    found = Fitter(bundle, OPTIONS).fit(target, alignment=Alignment())
    np.testing.assert_allclose(found.code, [0.035, 0.02], atol=1.5e-3)
    assert found.distance.mean < 1e-3
    assert found.seconds > 0
    assert found.evaluations > 5
    again = Fitter(bundle, OPTIONS).fit(target, alignment=Alignment())
    np.testing.assert_array_equal(found.code, again.code)


def test_a_fit_is_no_worse_than_its_best_start(bundle):
    target = surface(bundle, [-0.02, 0.03])
    found = Fitter(bundle, OPTIONS).fit(target, alignment=Alignment())
    starts = [surface_distance(surface(bundle, code), target, samples=2000).mean for code in CODES.values()]
    assert found.distance.mean < 0.5 * min(starts)


@pytest.mark.parametrize("how", ["cm,y", "mm,z", "inch,y"])
def test_units_and_axes_are_found(bundle, how):
    given = Alignment.parse(how)
    here = surface(bundle, [0.035, 0.02])
    inverse = Surface(here.vertices @ given.rotation / UNITS[given.unit], here.faces)
    found = Fitter(bundle, OPTIONS).fit(inverse)
    assert found.alignment == given
    np.testing.assert_allclose(found.code, [0.035, 0.02], atol=1.5e-3)


def test_a_garment_elsewhere_in_space_is_brought_back(bundle):
    here = surface(bundle, [0.035, 0.0])
    found = Fitter(bundle, OPTIONS).fit(Surface(here.vertices + np.array([3.0, 1.0, -2.0]), here.faces))
    x, y, z = found.alignment.translation
    assert (y, z) == pytest.approx((-1.0, 2.0), abs=2e-3)
    assert 3.0 + x == pytest.approx(found.code[1], abs=2e-3), "sideways the code and the place say the same"
    assert found.code[0] == pytest.approx(0.035, abs=4e-3)
    assert found.distance.mean < 3e-3


def test_whitened_codes_have_unit_spread_and_come_back():
    codes = np.random.default_rng(0).normal(size=(50, 6)) * np.array([3, 1, 0.5, 0.2, 0.1, 1e-9]) + 1
    space = CodeSpace.of(codes)
    white = np.stack([space.position(code) for code in codes])
    np.testing.assert_allclose(np.stack([space.code(w) for w in white]), codes, atol=1e-9)
    np.testing.assert_allclose(white.mean(axis=0), 0, atol=1e-9)
    assert white.std(axis=0, ddof=1)[:5].min() > 0.8
    assert white.std(axis=0, ddof=1).max() < 1 + 1e-6


def test_few_codes_leave_other_directions_open():
    space = CodeSpace.of(np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]]))
    assert np.linalg.matrix_rank(space.from_white) == 4
    np.testing.assert_allclose(space.code(space.position(np.array([0.3, 0.1, 0, 0.2]))), [0.3, 0.1, 0, 0.2])


def test_a_mesh_of_no_garments_size_is_refused(bundle):
    here = surface(bundle, [0.0, 0.0])
    with pytest.raises(MeshError, match="give its unit"):
        Fitter(bundle, OPTIONS).fit(Surface(here.vertices * 0.04, here.faces))


def test_an_empty_bundle_is_refused(bundle):
    with pytest.raises(GeometryError, match="holds no garment"):
        Fitter(GarmentBundle(bundle.model, {}, "0" * 64))


def test_starts_that_do_not_decode_are_named(bundle):
    broken = GarmentBundle(bundle.model, {"rag": np.array([-2.0, 0.0], np.float32)}, "0" * 64)
    fitter = Fitter(broken, OPTIONS)
    with pytest.raises(DecodeError, match="no start of the fit decodes"):
        fitter.fit(surface(bundle, [0.0, 0.0]), alignment=Alignment())


def test_a_closed_target_has_no_border_term(bundle):
    front = surface(bundle, [0.02, 0.0])
    solid = np.concatenate([front.faces, front.faces[:, ::-1]])
    target = Target(Surface(front.vertices, solid), samples=100)
    assert not target.has_border


def test_a_fit_is_stored_with_what_is_known_of_it(bundle, tmp_path):
    found = Fitter(bundle, OPTIONS).fit(surface(bundle, [0.0, 0.02]), alignment=Alignment())
    found.as_code(bundle, "mine").save(tmp_path / "code.safetensors")
    stored = GarmentCode.load(tmp_path / "code.safetensors")
    np.testing.assert_array_equal(stored.code, found.code)
    assert stored.model_sha256 == bundle.model_sha256
    assert stored.notes["distance_m"]["mean"] == found.distance.mean
    assert len(found.summary("pillow")) == 3


def test_the_category_is_found_by_likeness():
    collection = Collection.load("default")
    for file in collection.bundle_files():
        bundle = collection.bundle(file)
        name = list(bundle.codes)[1]
        garment = bundle.decode(name, resolution=48)
        target = Surface(100 * garment.rest_vertices.astype(float), garment.faces)
        assert choose_bundle(collection, target) is bundle
    assert choose_bundle(collection, target, category="skirt").category == "skirt"
    with pytest.raises(MeshError, match="no category 'hat'"):
        choose_bundle(collection, target, category="hat")


@pytest.mark.slow
@pytest.mark.parametrize("category", ["top", "skirt", "trousers"])
def test_built_in_garments_are_found_again(category):
    collection = Collection.load("default")
    bundle = next(b for b in map(collection.bundle, collection.bundle_files()) if b.category == category)
    codes = np.stack(list(bundle.codes.values()))
    code = 0.5 * (codes[7] + codes[11])
    found = Fitter(bundle).fit(surface(bundle, code, 128), alignment=Alignment())
    assert found.distance.mean < 1e-3
