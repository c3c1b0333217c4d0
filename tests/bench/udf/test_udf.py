"""The baseline: exact on surfaces whose distances are known, and trainable."""

import igl
import numpy as np
import pytest
import torch
from bench.udf.cleanup import boundary_loops
from bench.udf.extract import ExtractOptions, extract_surface
from bench.udf.fit import FitOptions
from bench.udf.reconstructor import UdfReconstructor
from bench.udf.samples import UdfSamplingOptions
from bench.udf.train import UdfOptions, train_udf
from torch import Tensor
from training_sets import tube_dataset

from isp_assets.evaluate.reconstruction import garment_surface
from isp_assets.train.loop import RunOptions


def open_sphere(points: Tensor) -> Tensor:
    """Distance to a sphere of radius 0.6 whose part above y = 0.2 is cut away."""
    radius, top = 0.6, 0.2
    rim = (radius**2 - top**2) ** 0.5
    on_sphere = radius * torch.nn.functional.normalize(points, dim=-1)
    flat = torch.nn.functional.normalize(points[:, [0, 2]], dim=-1) * rim
    on_rim = torch.stack([flat[:, 0], torch.full_like(flat[:, 0], top), flat[:, 1]], dim=-1)
    closest = torch.where((on_sphere[:, 1] <= top)[:, None], on_sphere, on_rim).detach()
    return (points - closest).norm(dim=-1)


def patch(points: Tensor) -> Tensor:
    """Distance to a slanted rectangle, 1.0 by 0.6."""
    normal = torch.nn.functional.normalize(torch.tensor([0.2, 0.3, 1.0], dtype=points.dtype), dim=0)
    first = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, -0.2], dtype=points.dtype), dim=0)
    second = torch.linalg.cross(normal, first)
    x, y, z = (points @ axis for axis in (first, second, normal))
    return torch.stack([(x.abs() - 0.5).relu(), (y.abs() - 0.3).relu(), z], dim=-1).norm(dim=-1)


@pytest.mark.parametrize("distance", [open_sphere, patch])
def test_open_surfaces_are_found_whole_and_more_exactly_with_finer_cells(distance):
    worst = []
    for resolution in (32, 64, 128):
        vertices, faces, report = extract_surface(distance, resolution, ExtractOptions(snap=False))
        assert len(boundary_loops(faces)) == 1, "one border, no holes"
        assert len(vertices) - len(igl.edges(faces)) + len(faces) == 1, "a disc"
        assert report.values + report.gradients < 40 * resolution**2 + 48**3, "cost follows the surface"
        worst.append(float(distance(torch.from_numpy(vertices)).max()))
    assert worst[0] < 2 / 32
    assert worst[2] < 0.5 * worst[0]


def test_snapping_puts_vertices_on_the_surface():
    vertices, _, _ = extract_surface(open_sphere, 64)
    off = open_sphere(torch.from_numpy(vertices)).numpy()
    assert np.quantile(off, 0.9) < 1e-6, "all but some at the border, that may be moved half a cell at most"
    assert off.max() < 1 / 64


def test_a_tube_faces_outwards():
    def tube(points: Tensor) -> Tensor:
        across = points[:, [0, 2]].norm(dim=-1) - 0.4
        return torch.stack([across, (points[:, 1].abs() - 0.5).relu()], dim=-1).norm(dim=-1)

    vertices, faces, _ = extract_surface(tube, 32, ExtractOptions(snap=False))
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(boundary_loops(faces)) == 2
    assert ((normals * corners.mean(1) * [1, 0, 1]).sum(1) > 0).all()


def test_nothing_gives_an_empty_mesh():
    vertices, faces, _ = extract_surface(lambda points: 1 + points.square().sum(-1), 32)
    assert vertices.shape == (0, 3)
    assert faces.shape == (0, 3)


@pytest.mark.slow
def test_a_trained_field_decodes_and_fits_after_loading(tmp_path):
    dataset = tube_dataset()
    options = UdfOptions(code_size=4, width=64, sampling=UdfSamplingOptions(points=6000))
    report = train_udf(dataset, tmp_path, run=RunOptions(steps=600, measurements=1), options=options)
    assert report.metrics["near_mm"] < 6
    udf = UdfReconstructor.load(tmp_path)
    assert list(udf.codes) == [garment.name for garment in dataset.garments]
    truth = garment_surface(dataset.garments[0])
    found = udf.decode(udf.codes["tube_0"], 32).surface
    assert igl.hausdorff(found.vertices, found.faces, truth.vertices, truth.faces) < 0.03
    code = udf.fit(truth, FitOptions(steps=60, trial_steps=20, points_per_step=512))
    distances = [np.linalg.norm(code - known) for known in udf.codes.values()]
    assert np.argmin(distances) == 0
