"""Heights over a vertex's own body parts, and the ceiling that other parts leave."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import SurfaceTopology
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.geometry.part_contact import FLAT, OwnSkin, PartSamples, PosedParts
from isp_assets.geometry.rotations import axis_angle_to_matrix

FLOOR, CEILING, ASIDE = 0, 1, 2


def _plate(height: float, *, up: bool, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square of 20 cm, samples every centimetre, facing up or down."""
    count = 21
    ticks = np.linspace(-0.1, 0.1, count)
    grid = np.stack(np.meshgrid(ticks + x, [height], ticks, indexing="ij"), -1).reshape(-1, 3)
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = (i.reshape(-1) for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    return grid, faces if up else faces[:, ::-1]


def _plates(gap: float) -> PosedParts:
    """A floor; a ceiling above it, the underside of a block; and a third plate far aside. One part each."""
    plates = [
        (FLOOR, _plate(0.0, up=True)),
        (CEILING, _plate(gap, up=False)),
        (CEILING, _plate(gap + 0.3, up=True)),
        (ASIDE, _plate(0.0, up=True, x=1.0)),
    ]
    size = len(plates[0][1][0])
    vertices = np.concatenate([points for _, (points, _) in plates])
    faces = np.concatenate([part + k * size for k, (_, (_, part)) in enumerate(plates)])
    parts = np.repeat(np.eye(6, dtype=bool)[[part for part, _ in plates]], size, axis=0)
    mesh = CollisionMesh(SurfaceTopology.build(faces, len(vertices)), parts, ())
    points = torch.tensor(vertices, dtype=torch.float64)[None]
    return PosedParts(points, torch.tensor(faces), PartSamples.of_mesh(mesh))


def _of(part: int, count: int) -> torch.Tensor:
    own = torch.zeros(count, 6, dtype=torch.bool)
    own[:, part] = True
    return own


def _over_floor(body: PosedParts, *heights: float) -> tuple[torch.Tensor, OwnSkin]:
    points = torch.tensor([[[0.0, y, 0.0] for y in heights]], dtype=torch.float64)
    return points, body.beneath(_of(FLOOR, len(heights)))


def test_height_counts_from_the_own_part_though_another_is_nearer():
    points, skin = _over_floor(_plates(0.02), 0.017, -0.004)
    torch.testing.assert_close(skin.gap(points).height[0], points[0, :, 1])


def test_the_ceiling_is_where_the_other_part_begins_however_deep_the_vertex():
    points, skin = _over_floor(_plates(0.02), 0.007, 0.019, 0.03, 0.09)
    ceiling = skin.gap(points).ceiling[0]
    assert ceiling[0] == torch.inf
    for height, found in zip(points[0, 1:, 1], ceiling[1:], strict=True):
        assert 0.018 - float(height) / 32 <= float(found) <= 0.018  # five halvings of the way


def test_a_narrow_gap_presses_cloth_flat_but_not_into_its_own_skin():
    points, skin = _over_floor(_plates(0.001), 0.01)
    assert float(skin.gap(points).ceiling) == pytest.approx(FLAT)


def test_beneath_its_own_skin_nothing_is_above():
    points, skin = _over_floor(_plates(0.02), -0.01)
    assert torch.isinf(skin.gap(points).ceiling).all()


def test_what_exceeds_the_ceiling_is_drawn_towards_its_own_skin():
    points, skin = _over_floor(_plates(0.02), 0.05)
    points.requires_grad_()
    skin.gap(points).exceeding().sum().backward()
    torch.testing.assert_close(points.grad[0, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_far_from_every_own_sample_the_nearest_is_still_found():
    body = _plates(0.02)
    points = torch.tensor([[[0.0, 0.5, 0.0]]], dtype=torch.float64)
    assert float(body.beneath(_of(ASIDE, 1)).gap(points).height) == pytest.approx(0.5)


def test_skin_next_to_another_part_is_no_ceiling():
    grid, faces = _plate(0.0, up=True)
    parts = np.zeros((len(grid), 6), bool)
    parts[np.arange(len(grid)), (grid[:, 0] > 0).astype(int)] = True
    samples = PartSamples.of_mesh(CollisionMesh(SurfaceTopology.build(faces, len(grid)), parts, ()))
    assert not (samples.rim & ~samples.parts).any()
    assert samples.rim.any(0).tolist() == [True, True, False, False, False, False]
    body = PosedParts(torch.tensor(grid)[None], torch.tensor(faces), samples)
    points = torch.tensor([[[0.009, 0.0005, 0.0]]], dtype=torch.float64)  # over the other half, touching it
    gap = body.beneath(_of(0, 1)).gap(points)
    assert torch.isinf(gap.ceiling).all()


@given(st.tuples(*[st.integers(-300, 300)] * 3), st.tuples(*[st.integers(-1000, 1000)] * 3))
def test_turning_and_moving_all_changes_nothing(turn: tuple[int, ...], shift: tuple[int, ...]):
    points, skin = _over_floor(_plates(0.02), 0.004, 0.03, -0.002)
    rotation = axis_angle_to_matrix(torch.tensor(turn, dtype=torch.float64) / 100)
    move = torch.tensor(shift, dtype=torch.float64) / 1000
    moved = PosedParts(skin.body.points @ rotation.T + move, skin.body.faces, skin.body.samples)
    gap, other = skin.gap(points), moved.beneath(skin.own).gap(points @ rotation.T + move)
    torch.testing.assert_close(gap.height, other.height)
    torch.testing.assert_close(gap.ceiling, other.ceiling)


def test_distances_find_what_trees_find():
    body = _plates(0.02)
    generator = torch.Generator().manual_seed(0)
    points = 0.08 * (torch.rand(200, 3, generator=generator, dtype=torch.float64) - 0.5)
    own = torch.cat([_of(FLOOR, 100), _of(CEILING, 100)])
    by_tree = body.nearest(0, points, own, within=0.1)
    by_distance = body.by_distance(0, points, own)
    torch.testing.assert_close(
        body.points[0][by_tree].sub(points).norm(dim=1), body.points[0][by_distance].sub(points).norm(dim=1)
    )
    assert (body.by_distance(0, points, torch.zeros_like(own)) == -1).all()


def test_parts_of_another_mesh_are_refused():
    body = _plates(0.02)
    with pytest.raises(GeometryError, match="1764"):
        PosedParts(body.points[:, :7], body.faces, body.samples)
