"""Training of D_s: its poses, its graded rest state, its energies, and that it learns."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_panels import SKIRT, SKIRT_SEAMS, polygon_model

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle, SkinBundle
from isp_assets.errors import TrainError
from isp_assets.garment import Garment
from isp_assets.geometry.contact import Surface, clearance
from isp_assets.geometry.energy import ClothRest, Fabric, cloth_rest, membrane_energy
from isp_assets.geometry.grading import face_strain, graded_rest
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.networks.drape_field import DrapeFieldConfig
from isp_assets.networks.skin_field import SkinField, SkinFieldConfig
from isp_assets.synthetic import synthetic_garment
from isp_assets.train import displacement, wardrobe
from isp_assets.train.displacement import DisplacementOptions, DisplacementTask
from isp_assets.train.drape_energy import Contact, drape_energies
from isp_assets.train.drape_metrics import DrapeCase, minimise
from isp_assets.train.loop import RunOptions, train
from isp_assets.train.poses import PoseSource, draw_poses, load_clips
from isp_assets.train.wardrobe import WardrobeOptions

GARMENT = synthetic_garment("tube", radius=0.25)


def _rest(garment: Garment = GARMENT) -> ClothRest:
    corners = garment.corner_xy.astype(np.float64)
    return cloth_rest(garment.faces, corners, garment.num_vertices, Fabric())


def _positions() -> torch.Tensor:
    return torch.tensor(GARMENT.rest_vertices, dtype=torch.float64)


def test_grading_by_nothing_or_by_a_rigid_motion_keeps_the_pattern() -> None:
    x, rest = _positions(), _rest()
    turned = x @ axis_angle_to_matrix(torch.tensor([0.4, 2.0, -1.0], dtype=torch.float64)).T + 3
    for shaped in (x, turned):
        graded = graded_rest(rest, x, shaped)
        assert torch.allclose(graded.inverse_rest, rest.inverse_rest, atol=1e-6)
        assert torch.allclose(graded.area, rest.area)


def test_uniform_growth_grows_every_panel_edge() -> None:
    x, rest = _positions(), _rest()
    graded = graded_rest(rest, x, 1.3 * x)
    assert torch.allclose(graded.inverse_rest, rest.inverse_rest / 1.3)
    assert torch.allclose(graded.area, 1.69 * rest.area)


def test_graded_energy_is_the_ungraded_one_carried_over() -> None:
    """A garment as far from its pattern as the mean one was has the mean one's strain."""
    x, rest = _positions(), _rest()
    stretched = x * torch.tensor([1.2, 1.2, 1.2], dtype=torch.float64)
    worn = 1.05 * x  # 5 % strain, in the same directions everywhere
    graded = graded_rest(rest, x, stretched)
    assert torch.allclose(face_strain((1.2 * worn)[None], graded), face_strain(worn[None], rest), atol=1e-9)


def test_strain_of_a_known_stretch() -> None:
    flat = np.concatenate(
        [GARMENT.panels["front"].panel_xy, np.zeros((len(GARMENT.panels["front"].panel_xy), 1))], 1
    )
    faces = GARMENT.panels["front"].faces
    rest = cloth_rest(faces, GARMENT.panels["front"].panel_xy[faces].astype(np.float64), len(flat), Fabric())
    moved = torch.tensor(flat)[None] * torch.tensor([1.1, 0.7, 1.0])
    assert torch.allclose(face_strain(moved, rest), torch.tensor(0.3, dtype=torch.float64), atol=1e-6)


def test_collision_counts_only_what_is_too_near() -> None:
    rest = _rest()
    far = Surface(torch.full((1, 1, 3), -9.0).double(), torch.tensor([[[1.0, 0, 0]]]).double())
    x, contact = _positions()[None], Contact()
    terms = drape_energies(x, clearance(x, far), rest, Fabric(), contact, stiffness=1e4)
    assert float(terms["collision"]) == 0
    assert torch.equal(terms["strain"], membrane_energy(x, rest, Fabric()))
    plane = Surface(x.mean(1, keepdim=True), torch.tensor([[[1.0, 0, 0]]]).double())
    near = drape_energies(x, clearance(x, plane), rest, Fabric(), contact, stiffness=1e4)
    assert float(near["collision"]) > 0


def test_collision_penalty_is_smooth_where_it_turns_linear() -> None:
    rest, contact = _rest(), Contact()
    x = torch.zeros(1, GARMENT.num_vertices, 3, dtype=torch.float64)
    plane = Surface(torch.zeros(1, 1, 3).double(), torch.tensor([[[0.0, 1, 0]]]).double())

    def penalty(depth: float) -> float:
        moved = x - torch.tensor([0.0, depth - contact.margin, 0], dtype=torch.float64)
        height = clearance(moved, plane)
        return float(drape_energies(moved, height, rest, Fabric(), contact, stiffness=1e4)["collision"])

    turn, h = contact.depth, 1e-5
    below, above = penalty(turn) - penalty(turn - h), penalty(turn + h) - penalty(turn)
    assert above == pytest.approx(below, rel=1e-2)
    assert penalty(turn + 0.02) - penalty(turn + 0.01) == pytest.approx(1000 * above, rel=1e-6)


def test_stiffness_grows_from_first_to_last() -> None:
    contact = Contact(stiffness=100.0, first_stiffness=1.0)
    values = [contact.at(p) for p in (0.0, 0.4, 0.8, 1.0)]
    assert values == pytest.approx([1.0, 10.0, 100.0, 100.0])


def test_minimise_lowers_energy_and_holds_vertices() -> None:
    x = _positions()
    far = Surface(torch.full((1, 1, 3), -9.0).double(), torch.tensor([[[1.0, 0, 0]]]).double())
    case = DrapeCase(_rest(), Fabric(), far, Contact())
    free = np.ones(len(x), bool)
    free[:5] = False
    before, after, found = minimise(case, 1.05 * x, free, iterations=30)
    assert after < before
    assert np.array_equal(found[:5], 1.05 * x[:5].numpy())
    assert np.isclose(float(sum(case.energies(torch.tensor(found)[None]).values())), after)


def test_held_out_motions_are_not_drawn() -> None:
    clips = load_clips(PoseSource(held_out=("squat",)))
    assert "squat" not in clips.train
    assert {"squat", "walk"} == set(clips.test)
    whole = load_clips(PoseSource(held_tails={}))
    assert len(clips.train["walk"]) + len(clips.test["walk"]) == len(whole.train["walk"])
    with pytest.raises(TrainError, match="moonwalk"):
        load_clips(PoseSource(held_out=("moonwalk",)))


def test_poses_are_reproducible_varied_and_keep_hands_still() -> None:
    clips = list(load_clips(PoseSource()).train.values())
    poses = draw_poses(clips, 200, torch.Generator().manual_seed(3))
    assert torch.equal(poses, draw_poses(clips, 200, torch.Generator().manual_seed(3)))
    assert not poses[:, 22:].any()
    assert poses.isfinite().all()
    assert (poses[:, 1:22].std(0).norm(dim=-1) > 0.05).all()


def test_motions_of_a_folder_are_read(tmp_path: Path) -> None:
    poses = np.zeros((4, 72), np.float32)
    np.savez(
        tmp_path / "still.npz", poses=poses, trans=np.zeros((4, 3), np.float32), mocap_framerate=30.0, up="y"
    )
    assert len(load_clips(PoseSource(tmp_path)).train["still"]) == 4


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load()


@pytest.fixture(scope="module")
def skin(body: Body) -> SkinBundle:
    field = SkinField(SkinFieldConfig(num_vertices=len(body.template)))
    field.place_on(body.template[None], torch.ones(len(body.template)))
    return SkinBundle(field, body.sha256)


@pytest.fixture(scope="module")
def bundle(body: Body) -> GarmentBundle:
    """Pillow-like skirts; the second code does not decode."""
    model = polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))
    codes = {
        "a": np.zeros(2, np.float32),
        "b": np.array([-0.9, 0], np.float32),
        "c": np.array([0.02, 0], np.float32),
    }
    return GarmentBundle(model, codes, body.sha256)


@pytest.fixture(scope="module")
def options() -> DisplacementOptions:
    return DisplacementOptions(
        network=DrapeFieldConfig(width=32, basis=4, map_size=16, coarse_size=4),
        wardrobe=WardrobeOptions(garments=2, edge_length=0.07), frames=3, garments=1, learning_rate=5e-3,
    )  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _tolerate_pillows_and_be_quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wardrobe, "_MAX_STRAIN", 99.0)
        patch.setattr(displacement, "_TEST_FRAMES", 2)
        yield


@pytest.fixture(scope="module")
def task(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, options: DisplacementOptions
) -> DisplacementTask:
    return DisplacementTask(bundle, skin, body, options)


def test_network_takes_its_code_size_and_scale_from_the_bundle(
    task: DisplacementTask, bundle: GarmentBundle
) -> None:
    codes = np.stack(list(bundle.codes.values()))
    assert task.module.config.code_size == 2
    assert task.module.config.code_scale * codes.std() == pytest.approx(1.0)


def test_wardrobe_passes_over_codes_that_do_not_decode(task: DisplacementTask) -> None:
    assert len(task.wardrobe) == 2
    assert all(sample.code[0] > -0.5 for sample in task.wardrobe)


def test_garments_with_a_name_of_their_own_come_into_the_wardrobe_first(
    bundle: GarmentBundle, skin: SkinBundle, body: Body
) -> None:
    code = next(iter(bundle.codes.values()))
    codes = {f"{bundle.category}_{number:04d}": code + 0.01 * number for number in range(20)}
    named = replace(bundle, codes={**codes, "tight": code + 0.005, "loose_2": code + 0.015})
    options = WardrobeOptions(garments=2, edge_length=0.07)
    for seed in range(2):
        worn = wardrobe.build_wardrobe(named, body, skin.skin_field, options, seed=seed)
        found = sorted(float(sample.code[0] - code[0]) for sample in worn)
        assert found == pytest.approx([0.005, 0.015], abs=1e-6)


def test_wardrobe_without_sound_garments_is_refused(
    bundle: GarmentBundle,
    skin: SkinBundle,
    body: Body,
    options: DisplacementOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(wardrobe, "_MAX_STRAIN", 0.0)
    with pytest.raises(TrainError, match="only 0 of 1"):
        wardrobe.build_wardrobe(bundle, body, skin.skin_field, WardrobeOptions(garments=1, edge_length=0.07))


def test_losses_reach_every_parameter_and_depend_on_the_generator_alone(task: DisplacementTask) -> None:
    def total(seed: int) -> torch.Tensor:
        return sum(task.losses(torch.Generator().manual_seed(seed), 0.5).values())

    assert torch.equal(total(1), total(1))
    assert not torch.equal(total(1), total(2))
    gradient = torch.autograd.grad(total(1), task.module.mlp.layers[-1].weight)[0]
    assert gradient.norm() > 0


def test_training_lowers_the_energy_of_held_out_poses_and_anchors_stay(
    task: DisplacementTask, tmp_path: Path
) -> None:
    state = {k: v.clone() for k, v in task.module.state_dict().items()}
    before = task.measure()
    train(task, tmp_path, RunOptions(steps=12, measurements=1))
    after = task.measure()
    names = ("strain_mj", "bending_mj", "gravity_mj", "collision_mj")
    skin = sum(before[f"skin.{name}"] for name in names)
    assert sum(before[name] for name in names) == pytest.approx(skin, rel=1e-4)
    assert sum(after[name] for name in names) < skin
    batch, sample = task.pose(torch.zeros(1, 24, 3), torch.zeros(10)), task.wardrobe[0]
    with torch.no_grad():
        skinned, moved = task.drape(sample, batch, maps=task.module.maps())
    assert len(sample.garment.anchors) > 5
    assert torch.equal(skinned[0, sample.garment.anchors], moved[0, sample.garment.anchors])
    assert (skinned - moved).abs().max() > 1e-4
    task.module.load_state_dict(state)


def test_trained_bundle_is_written_with_its_displacements_and_figures(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, options: DisplacementOptions, tmp_path: Path
) -> None:
    result = displacement.train_displacement(
        bundle,
        skin,
        tmp_path,
        RunOptions(steps=2, measurements=1),
        body=body,
        options=options,
        gap_iterations=2,
    )
    assert (tmp_path / "pillow.safetensors").is_file()
    assert bundle.drape_field is None
    assert result.drape_field is not None
    assert result.provenance["drape"]["step"] == 2
    assert {"strain_mj", "skin.strain_mj", "gap_closed_percent"} <= set(result.metrics["drape"])
    early = displacement.with_displacement(bundle, tmp_path)
    assert all(
        torch.equal(a, b)
        for a, b in zip(result.drape_field.parameters(), early.drape_field.parameters(), strict=True)
    )
    assert "earlier" not in result.provenance["drape"]
    further = displacement.with_displacement(result, tmp_path)
    assert further.provenance["drape"]["earlier"] == result.provenance["drape"]


def test_training_further_begins_with_contact_at_its_full_stiffness(
    task: DisplacementTask, bundle: GarmentBundle, skin: SkinBundle, body: Body, options: DisplacementOptions
) -> None:
    def collision(of: DisplacementTask, progress: float) -> torch.Tensor:
        return of.losses(torch.Generator().manual_seed(3), progress)["collision"].detach()

    further = DisplacementTask(replace(bundle, drape_field=task.module), skin, body, options)
    assert collision(further, 0.0) == collision(further, 1.0) == collision(task, 1.0)
    assert collision(task, 0.0) < collision(task, 1.0)


def test_unequal_bodies_are_refused(
    bundle: GarmentBundle, skin: SkinBundle, body: Body, tmp_path: Path
) -> None:
    other = replace(bundle, body_sha256="0" * 64)
    with pytest.raises(TrainError, match="garment bundle was made for body 000000000000"):
        displacement.train_displacement(other, skin, tmp_path, RunOptions(steps=1), body=body)
