"""Projection: what it clears, what it leaves alone, and that it does neither too much nor too far."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from collision_shapes import LEFT_ARM, TORSO, ball, collision, obstacle, sheet, tube

from isp_assets.errors import GeometryError
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.energy import Fabric, cloth_rest
from isp_assets.geometry.grading import face_strain
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.projection import ProjectionOptions, project
from isp_assets.geometry.stretch import StretchLimit


def _sunk_tube(depth: float = 0.006) -> tuple[np.ndarray, np.ndarray]:
    """A tube about a ball of 10 cm, cutting it by ``depth`` at the equator."""
    return tube(0.1 - depth, low=-0.12, high=0.12)


def _heights(vertices: np.ndarray, beneath: Obstacle) -> np.ndarray:
    return beneath.whole(vertices).height


def _normals_x(vertices: np.ndarray, faces: np.ndarray) -> float:
    corner = vertices[faces]
    return float(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 0].sum())


def test_a_sunk_garment_comes_out_to_the_margin_and_crosses_nothing() -> None:
    cloth, body = _sunk_tube(), obstacle(ball())
    assert len(crossing_pairs(*cloth, *ball())) > 50
    done = project(cloth[0], collision(cloth), [body])
    assert done.ran
    assert done.crossings == 0
    assert len(crossing_pairs(done.vertices, cloth[1], *ball())) == 0
    assert _heights(done.vertices, body).min() > 0.003 - 2e-4
    assert done.largest_move < 0.012


def test_a_garment_that_is_clear_is_returned_as_it_is() -> None:
    cloth = tube(0.12)
    done = project(cloth[0], collision(cloth), [obstacle(ball())])
    assert not done.ran
    assert done.rounds == 0
    assert np.array_equal(done.vertices, cloth[0])


def test_a_second_projection_finds_nothing_left_to_do() -> None:
    cloth, body = _sunk_tube(), obstacle(ball())
    once = project(cloth[0], collision(cloth), [body]).vertices
    again = project(once, collision(cloth), [body])
    assert again.largest_move < 5e-4


def test_a_ridge_that_pokes_through_a_triangle_lifts_its_corners() -> None:
    """No vertex of the coarse sheet is beneath the surface, yet a ridge cuts through its faces."""
    coarse = sheet(6, height=0.006)
    fine, faces = sheet(41)
    fine[:, 1] = 0.015 * np.exp(-((fine[:, 0] / 0.004) ** 2))
    assert len(crossing_pairs(*coarse, fine, faces)) > 10
    # The ridge runs between two rows of the coarse sheet's vertices.
    below = obstacle((fine, faces), margin=0.0025)
    assert (_heights(coarse[0], below)[np.abs(coarse[0][:, 0]) < 0.03] > 0).all()
    done = project(coarse[0], collision(coarse), [below])
    assert len(crossing_pairs(done.vertices, coarse[1], fine, faces)) == 0


def test_layers_keep_their_order_where_there_is_no_room() -> None:
    """Where the body presses cloth together margins are given up, the order of the layers is not."""
    outer, (fine, faces) = sheet(6, height=0.006), sheet(41)
    fine[:, 1] = 0.008 * np.exp(-((fine[:, 0] / 0.004) ** 2))
    mesh = collision((fine, faces))
    inner = Obstacle(mesh, fine, margin=0.0025, tight=np.ones(len(fine), bool))
    body = obstacle(sheet(41, height=-0.05))
    assert len(crossing_pairs(*outer, fine, faces)) > 10
    done = project(outer[0], collision(outer), [body, inner])
    assert len(crossing_pairs(done.vertices, outer[1], fine, faces)) == 0
    assert np.abs(done.vertices - outer[0])[:, 1].max() < 0.006


def test_swapped_layers_are_untangled() -> None:
    outer, inner = tube(0.100), tube(0.112)
    below = obstacle(inner, margin=0.0025)
    done = project(outer[0], collision(outer), [obstacle(ball(0.09)), below])
    assert len(crossing_pairs(done.vertices, outer[1], *inner)) == 0
    found = below.whole(done.vertices)
    assert found.height[~found.on_border].min() > 0.002


def test_a_long_garment_is_not_lifted_beyond_the_border_of_a_short_one() -> None:
    outer, inner = tube(0.100, low=-0.4), tube(0.108, low=-0.05)
    done = project(outer[0], collision(outer), [obstacle(inner)])
    moved = np.linalg.norm(done.vertices - outer[0], axis=1)
    assert moved[outer[0][:, 1] > 0].min() > 0.008
    assert moved[outer[0][:, 1] < -0.32].max() < 1e-3


def test_cloth_that_hangs_above_the_rim_of_an_inner_garment_is_not_pulled_into_it() -> None:
    """A funnel that opens upwards: what hangs above its mouth lies on the inner side of its slope."""
    funnel, faces = tube(0.1, low=-0.3, high=0.0)
    funnel[:, [0, 2]] *= 1 + 2.5 * (funnel[:, 1:2] + 0.3)  # wider towards the top
    hanging = tube(0.13, low=-0.03, high=0.25)
    below = obstacle((funnel, faces), margin=0.0025)
    done = project(hanging[0], collision(hanging), [obstacle(ball(0.05)), below])
    assert done.largest_move < 0.03


def test_a_sleeve_is_not_dragged_to_the_strap_of_an_inner_garment() -> None:
    """All that a vest has of an arm is a patch on its shoulder: what lies beside that is not beneath it."""
    vest, faces = sheet(41, size=0.4)
    joints = np.where(np.abs(vest[:, [0, 2]]).max(1) < 0.05, LEFT_ARM, TORSO)
    below = Obstacle(CollisionMesh.build(faces, np.eye(24)[joints]), vest, margin=0.0025)
    sleeve = sheet(5, size=0.03, height=-0.03)
    sleeve[0][:, 0] += 0.09
    found = below.contacts(sleeve[0], collision(sleeve, LEFT_ARM).parts, within=0.06)
    assert found.on_cut.all()
    assert found.height.max() < -0.03
    done = project(sleeve[0], collision(sleeve, LEFT_ARM), [obstacle(ball(centre=(0, -0.4, 0))), below])
    assert done.largest_move < 0.001


def test_contact_deep_inside_another_body_part_is_left_alone() -> None:
    """A sleeve within the torso is not the torso's: pushing it through would tear it off its arm."""
    cloth = tube(0.02, low=-0.02, high=0.02)
    done = project(cloth[0], collision(cloth, LEFT_ARM), [obstacle(ball())])
    assert not done.ran


def _body(own: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray], part: int) -> Obstacle:
    """Two shapes as one body: a part by its number in the order of the parts, and the torso."""
    vertices = np.concatenate([own[0], other[0]])
    mesh = collision((vertices, np.concatenate([own[1], other[1] + len(own[0])])))
    is_own = np.arange(len(vertices)) < len(own[0])
    parts = np.zeros_like(mesh.parts)
    parts[is_own, part] = parts[~is_own, 0] = True
    faces_of = [np.flatnonzero(parts[mesh.topology.faces][:, :, k].any(1)) for k in range(6)]
    return Obstacle(replace(mesh, parts=parts, part_faces=tuple(faces_of)), vertices, margin=0.003)


@pytest.mark.parametrize(("radius", "centre"), [(0.04, 0.137), (0.065, 0.137)])
def test_room_above_the_own_part_is_used_to_clear_another_part(radius: float, centre: float) -> None:
    """A sleeve around its arm cuts the torso by 3 mm and by 28 mm: there is room nearer to the arm."""
    sleeve = tube(radius, low=-0.03, high=0.03)
    torso = ball(centre=(centre, 0, 0))
    body = _body(tube(0.03), torso, 2)
    assert len(crossing_pairs(*sleeve, *torso)) > 0
    done = project(sleeve[0], collision(sleeve, LEFT_ARM), [body])
    assert len(crossing_pairs(done.vertices, sleeve[1], *torso)) == 0
    assert np.linalg.norm(done.vertices[:, [0, 2]], axis=1).min() > 0.0325


def test_triangles_that_reach_into_another_part_are_drawn_in_with_it() -> None:
    """A fist pushes a coarse shirt, 3 cm off the torso, down to it: the sides of the dent clear the fist."""
    shirt, torso, centre = sheet(9, height=0.03), sheet(41), (0.004, 0.06, 0.003)
    fist = ball(0.05, centre=centre)
    body = _body(fist, torso, 2)
    assert len(crossing_pairs(*shirt, *fist)) > 50
    done = project(shirt[0], collision(shirt), [body])
    assert _heights(done.vertices, obstacle(torso)).min() > 0.0028
    assert len(crossing_pairs(done.vertices, shirt[1], *fist)) == 0
    assert np.linalg.norm(done.vertices[shirt[1]].mean(axis=1) - centre, axis=1).min() > 0.0505


def test_places_without_room_are_named_and_no_vertex_is_thrown_about() -> None:
    """A collar between two balls that press together."""
    left, right = ball(centre=(-0.09, 0, 0)), ball(centre=(0.09, 0, 0))
    body_shape = (np.concatenate([left[0], right[0]]), np.concatenate([left[1], right[1] + len(left[0])]))
    collar = tube(0.05, low=-0.01, high=0.01)
    turned = collar[0][:, [1, 0, 2]] * [1, -1, 1]
    body = obstacle(body_shape)
    done = project(turned, collision((turned, collar[1])), [body])
    assert body.tight.any()
    assert done.tight.any()
    assert np.isfinite(done.vertices).all()
    assert done.largest_move < ProjectionOptions().longest_move + 1e-9


def test_a_vertex_that_would_have_to_go_further_than_it_may_stops_there_and_has_no_room() -> None:
    cloth, body, longest = _sunk_tube(0.02), obstacle(ball()), 0.004
    done = project(cloth[0], collision(cloth), [body], ProjectionOptions(longest_move=longest))
    moved = np.linalg.norm(done.vertices - cloth[0], axis=1)
    most = np.maximum(longest, 1.1 * (0.003 - _heights(cloth[0], body)))
    stopped = moved > most - 1e-6
    assert (moved < most + 1e-6).all()
    assert stopped.any()
    assert np.array_equal(done.tight, stopped)


def test_easing_takes_the_strain_out_of_a_lift() -> None:
    """A loose sheet is lifted over a ball that pokes through it: little remains strained."""
    cloth, faces = sheet(31)
    rest = cloth_rest(faces, cloth[faces][:, :, [0, 2]], len(cloth), Fabric())
    stretch = StretchLimit.build(rest, held=np.zeros(len(cloth), bool))
    body = obstacle(ball(0.05, centre=(0, -0.035, 0)))

    def worst(limit: StretchLimit | None) -> float:
        done = project(cloth, collision((cloth, faces)), [body], stretch=limit)
        assert body.whole(done.vertices).height.min() > 0.002
        return float(face_strain(torch.from_numpy(done.vertices)[None], rest).quantile(0.99))

    assert worst(stretch) < 0.6 * worst(None)


def test_projection_moves_with_the_scene() -> None:
    cloth, body = _sunk_tube(), ball(centre=(0.0013, 0.0007, 0.0021))  # no ties between equally near places
    here = project(cloth[0], collision(cloth), [obstacle(body)]).vertices
    motion = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.7, 0.2]))
    turn, shift = motion[:3, :3], np.array([1.0, 2.0, -3.0])

    def there(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + shift

    moved = project(there(cloth[0]), collision(cloth), [obstacle((there(body[0]), body[1]))]).vertices
    np.testing.assert_allclose(moved, there(here), atol=1e-6)


def test_cloth_beside_a_fold_of_a_layer_that_faces_away_stays() -> None:
    """Three to five centimetres "beneath" a fold 6 cm high: only skin to which there is no way lies there."""
    body = obstacle(sheet(41, size=0.4))
    upright, faces = sheet(21)
    upright = upright[:, [1, 0, 2]] * [1, 0.3, 1] + [0.06, 0.02, 0]
    cloth = sheet(9, size=0.02, height=0.004)
    away = faces if _normals_x(upright, faces) > 0 else faces[:, ::-1]
    fold = obstacle((upright, np.ascontiguousarray(away)), margin=0.0025)
    for shift in (0.0, 0.02):
        beside = cloth[0] + [shift, 0, 0]
        assert fold.whole(beside).height.max() < -0.025
        done = project(beside, collision(cloth), [body, fold])
        np.testing.assert_array_equal(done.vertices, beside)


def test_cloth_deep_beneath_a_layer_that_stands_off_the_skin_is_lifted_over_it() -> None:
    body, cloth = obstacle(sheet(41, size=0.4)), sheet(9, size=0.02, height=0.004)
    layer = obstacle(sheet(41, size=0.4, height=0.04), margin=0.0025)
    done = project(cloth[0], collision(cloth), [body, layer])
    assert _heights(done.vertices, layer).min() > 0.0025 - 2e-4


def test_spreading_keeps_a_single_push_from_standing_out() -> None:
    cloth, faces = sheet(21)
    cloth[:, 1] = 0.02
    spike, spike_faces = ball(0.012, centre=(0, 0.012, 0))
    body = (spike, spike_faces)

    def slope(options: ProjectionOptions) -> float:
        done = project(cloth, collision((cloth, faces)), [obstacle(body)], options)
        edges = done.vertices[faces] - done.vertices[np.roll(faces, 1, axis=1)]
        return float(np.abs(edges[..., 1]).max())

    assert slope(ProjectionOptions()) < 0.85 * slope(ProjectionOptions(spread=0))


def test_bad_input_is_refused() -> None:
    cloth = tube(0.12)
    broken = cloth[0].copy()
    broken[3] = np.nan
    with pytest.raises(GeometryError, match="NaN"):
        project(broken, collision(cloth), [obstacle(ball())])
    with pytest.raises(GeometryError, match="rounds"):
        ProjectionOptions(rounds=0)
    with pytest.raises(GeometryError, match="margin"):
        obstacle(ball(), margin=-0.1)
