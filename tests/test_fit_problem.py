"""The mathematics of a fit: Jacobians and curvature against differences, known codes, bad input."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model
from scipy.optimize import minimize

from isp_assets.bundle import GarmentBundle
from isp_assets.collection import Collection
from isp_assets.decode import SLIVER, border_slopes, cut_panels, lift_points, weld_points
from isp_assets.errors import DecodeError, InputError
from isp_assets.fit_jacobian import vertex_jacobian
from isp_assets.fit_objective import Distance, FitWeights, Target
from isp_assets.fit_options import CodeSpace, FitOptions
from isp_assets.fit_problem import FitProblem
from isp_assets.fit_residuals import MeshPoints, curve_distances, normal_differences, surface_distances
from isp_assets.fit_search import Search
from isp_assets.geometry.sewing import sew_panels
from isp_assets.geometry.surface_distance import Surface

RESOLUTION = 32
OPTIONS = FitOptions(resolution=RESOLUTION, samples=800)


@pytest.fixture(scope="module", params=["top.safetensors", "skirt.safetensors"])
def bundle(request) -> GarmentBundle:
    return Collection.load("default").bundle(request.param)


def surface(bundle: GarmentBundle, code) -> Surface:
    garment = bundle.decode(np.asarray(code, np.float32), resolution=RESOLUTION)
    return Surface(garment.rest_vertices.astype(float), garment.faces)


def space_of(bundle: GarmentBundle) -> CodeSpace:
    return CodeSpace.of(np.stack(list(bundle.codes.values())))


def test_vertex_jacobian_agrees_with_finite_differences(bundle):
    """In float64, away from the code of the cut, for all vertices at once."""

    def doubled(networks):
        return {side: copy.deepcopy(network).double() for side, network in networks.items()}

    code = list(bundle.codes.values())[1]
    cut = cut_panels(bundle.model, code, resolution=RESOLUTION)
    sewn = sew_panels(cut.outlines, bundle.model.seam_pairs, spacing=2 / RESOLUTION, sliver=SLIVER)
    fields, atlases = doubled(bundle.model.panel_fields), doubled(bundle.model.atlases)
    model = replace(bundle.model, panel_fields=fields, atlases=atlases)
    at_cut = torch.from_numpy(code).double()
    border = border_slopes(model, sewn, at_cut)
    here, step = at_cut + 0.01, 1e-6
    found = vertex_jacobian(model, sewn, here, border)
    assert found.shape == (sewn.num_vertices, 3, len(code))

    def vertices(z):
        with torch.no_grad():
            return weld_points(sewn, lift_points(model, sewn, z, border=border))

    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        direction = torch.randn(len(code), generator=generator, dtype=torch.float64)
        ends = [vertices(here + sign * step * direction) for sign in (-1, 1)]
        expected = (ends[1] - ends[0]) / (2 * step)
        torch.testing.assert_close(found @ direction, expected, rtol=1e-5, atol=1e-7)


def test_residuals_have_the_slope_of_their_values():
    """Term by term in float64, where closest points do not change: planes, lines and normals."""
    rng = np.random.default_rng(0)
    vertices, corners = rng.normal(size=(12, 3)), rng.permutation(12).reshape(4, 3)
    points = MeshPoints(corners, rng.dirichlet(np.ones(3), 4), np.arange(4))
    unit = rng.normal(size=(4, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    origin = rng.normal(size=(4, 3))

    def plane(at):
        offsets = points.at(at) - origin
        return surface_distances(points, (offsets * unit).sum(axis=1)[:, None] * unit, unit, len(at))

    def line(at):
        offsets = points.at(at) - origin
        across = offsets - (offsets * unit).sum(axis=1)[:, None] * unit
        return curve_distances(points, across, unit, len(at), weight=0.7)

    for term in (plane, line, lambda at: normal_differences(corners, unit, at, 10.0)):
        direction = rng.normal(size=vertices.shape)
        ends = [term(vertices + sign * 1e-6 * direction).values for sign in (-1, 1)]
        expected = (ends[1] - ends[0]) / 2e-6
        found = term(vertices).slope @ direction.reshape(-1)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_squares_add_up_to_what_is_documented():
    """Unit squares 3 mm apart: 9 mm^2 each way, and as much for borders, weighted."""
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    target = Target(Surface(flat + np.array([0, 0, 0.003]), faces), samples=400)
    weights = FitWeights(border=0.5, normal=10.0)
    distance = Distance(target, faces, np.ones(2), samples=300, weights=weights)
    assert distance(flat).energy == pytest.approx(9 + 9 + 0.5 * (9 + 9), rel=1e-4)
    turned = distance(flat[:, [0, 2, 1]])  # at right angles, whichever way the normals look
    normals = turned.values[300 + 400 : 300 + 400 + 900]
    assert normals @ normals == pytest.approx(10.0)


def test_the_objective_has_the_gradient_of_its_value(bundle):
    """Closest points move too: against finite differences of the distance of every vertex, in float64."""
    codes = list(bundle.codes.values())
    target = Target(surface(bundle, codes[1]), samples=600)
    here = surface(bundle, 0.8 * codes[1] + 0.2 * codes[2])
    distance = Distance(
        target, here.faces, np.ones(len(here.faces)), samples=500, weights=FitWeights(normal=0.0)
    )
    rng = np.random.default_rng(0)
    found = distance(here.vertices)
    for _ in range(3):
        direction = 1e-2 * rng.normal(size=here.vertices.shape)
        ends = [distance(here.vertices + sign * 1e-5 * direction).energy for sign in (-1, 1)]
        slope = 2 * found.values @ (found.slope @ direction.reshape(-1))
        assert slope == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=2e-3)


def test_curvature_is_that_of_the_energy_where_nothing_is_left(bundle):
    """At the solution Gauss-Newton is exact: the prediction of the energy nearby is the energy."""
    space = space_of(bundle)
    white = 0.5 * space.position(list(bundle.codes.values())[3])
    options = replace(OPTIONS, weights=FitWeights(prior=0.0))
    target = Target(surface(bundle, space.code(white)), samples=800)
    problem = FitProblem(bundle.model, space, target, options, white)
    assert problem.energy(white) < 1e-3
    curvature = problem.curvature(white)
    np.testing.assert_allclose(curvature, curvature.T)
    assert np.linalg.eigvalsh(curvature).min() > -1e-6 * np.abs(curvature).max()
    direction = np.random.default_rng(0).normal(size=len(white))
    step = 2e-3 * direction / np.linalg.norm(direction)
    assert problem.energy(white + step) == pytest.approx(0.5 * step @ curvature @ step, rel=0.1)


def test_few_steps_do_what_many_gradients_do(bundle):
    """From half a spread away, on one cut: six steps leave less than thirty steps of L-BFGS."""
    space = space_of(bundle)
    white = 0.5 * space.position(list(bundle.codes.values())[3])
    start = white + 0.5 * np.random.default_rng(0).normal(size=len(white))
    target = Target(surface(bundle, space.code(white)), samples=800)
    problem = FitProblem(bundle.model, space, target, OPTIONS, start)
    ours = minimize(
        problem.energy, start, jac=problem.gradient, hess=problem.curvature, method="trust-exact",
        options={"maxiter": 6, "initial_trust_radius": 1.5},
    )  # fmt: skip
    theirs = minimize(problem.energy, start, jac=problem.gradient, method="L-BFGS-B", options={"maxiter": 30})
    assert ours.fun < theirs.fun
    assert ours.fun < 0.2 * problem.energy(start), "the cut itself is out of date by the rest"


def test_a_known_code_of_a_trained_bundle_comes_back(bundle):
    """By rounds of cutting and descending. Where codes hardly spread, the garment hardly tells them."""
    space = space_of(bundle)
    spread = np.linalg.norm(space.from_white, axis=0)
    white = 0.5 * space.position(list(bundle.codes.values())[3])
    target = Target(surface(bundle, space.code(white)), samples=800)
    weights = FitWeights(prior=1e-4)
    for seed in range(3):
        search = Search(bundle.model, space, target, replace(OPTIONS, weights=weights), movable=False)
        start = white + 0.3 * np.random.default_rng(seed).normal(size=len(white))
        end = search.settle(search.begin(space.code(start), "near"))
        assert (spread * np.abs(end.position - white)).max() < 0.05 * spread.max()
        assert end.energy < 0.15, "four tenths of a millimetre"
        assert end.start == "near"
        assert search.evaluations < 80


def test_a_shift_is_found_only_where_the_place_is_open():
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    bundle = GarmentBundle(model, {"a": np.zeros(2, np.float32)}, "0" * 64)
    here = surface(bundle, [0.0, 0.0])
    target = Target(Surface(here.vertices + np.array([0.0, 0.01, 0.0]), here.faces), samples=400)
    space = CodeSpace(np.zeros(2), 0.05 * np.eye(2))
    ends = {}
    for movable in (False, True):
        search = Search(model, space, target, OPTIONS, movable=movable)
        ends[movable] = search.settle(search.begin(np.zeros(2), "a"))
    np.testing.assert_array_equal(ends[False].shift, 0)
    np.testing.assert_allclose(ends[True].shift, [0, 0.01, 0], atol=1e-3)
    assert ends[True].energy < ends[False].energy


def test_a_code_that_cannot_be_cut_is_said_and_a_step_to_one_is_halved():
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    bundle = GarmentBundle(model, {"a": np.zeros(2, np.float32)}, "0" * 64)
    target = Target(surface(bundle, [0.02, 0.0]), samples=400)
    space = CodeSpace(np.zeros(2), np.eye(2))
    with pytest.raises(DecodeError):
        FitProblem(model, space, target, OPTIONS, np.array([-2.0, 0.0]))

    plain = Search(model, space, target, OPTIONS, movable=False)
    leads = plain.round(plain.begin(np.zeros(2), "a"), 4).position[0]  # the first step
    assert leads > 0.01

    class Leaping(Search):
        refused = 0

        def _cut(self, state):
            if abs(state.position[0] - leads) < 0.1 * leads:
                self.refused += 1
                raise DecodeError("no garment here")
            return super()._cut(state)

    search = Leaping(model, space, target, OPTIONS, movable=False)
    end = search.round(search.begin(np.zeros(2), "a"), 4)
    assert search.refused > 0
    assert end.position[0] == pytest.approx(leads / 2, rel=0.01), "half of the way"


@pytest.mark.parametrize("change", [{"resolution": 8}, {"samples": 9}, {"finalists": 0}, {"trial_rounds": 0}])
def test_options_that_cannot_be_are_refused(change):
    with pytest.raises(InputError, match="fit: expected"):
        FitOptions(**change)
