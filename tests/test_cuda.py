"""On CUDA: what is draped and what is learnt is what a CPU gives. Skipped without a CUDA device."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from training_sets import tube_dataset

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions, drape
from isp_assets.evaluate.frames import FrameMeter
from isp_assets.geometry.contact import Surface, clearance, force
from isp_assets.motion import Motion
from isp_assets.networks.skin_field import SkinFieldConfig
from isp_assets.outfit import Outfit
from isp_assets.shot import Shot
from isp_assets.train.atlas import AtlasOptions, AtlasTask, train_atlas
from isp_assets.train.displacement import DisplacementOptions, DisplacementTask, train_displacement
from isp_assets.train.layering import LayeringOptions, LayeringTask, train_layering
from isp_assets.train.loop import CHECKPOINT, RunOptions, Task, read_checkpoint, train
from isp_assets.train.patterns import PatternOptions, PatternTask, train_patterns
from isp_assets.train.sampling import SamplingOptions
from isp_assets.train.skin import Diffusion, SkinTask, rest_poses_of_categories, train_skin
from isp_assets.train.wardrobe import WardrobeOptions

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

DEVICES = ("cpu", "cuda")
NETWORKS = ("skin", "displace", "layering")
PATTERNS = PatternOptions(code_size=4, width=32, depths=(2, 3, 2), sampling=SamplingOptions(points=2000))
ATLAS = AtlasOptions(width=32, depth=3, skip=None)


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load("default")


@pytest.fixture(scope="module")
def collection() -> Collection:
    return Collection.load("default")


@pytest.fixture(scope="module")
def outfit(collection: Collection) -> Outfit:
    return collection.outfit(["trousers", "tee", "open_jacket"])


@pytest.fixture(scope="module")
def shot(body: Body) -> Shot:
    return Shot("test", body, Motion.load("walk").select(FrameRange(10, 13)))


def _layers(outfit: Outfit, shot: Shot, **options) -> list[np.ndarray]:
    chunks = list(drape(outfit, shot, DrapeOptions(resolution=48, **options)))
    return [np.concatenate([chunk.layers[k] for chunk in chunks]) for k in range(len(outfit))]


def test_networks_drape_alike(outfit: Outfit, shot: Shot) -> None:
    cpu, cuda = (_layers(outfit, shot, steps=NETWORKS, device=device) for device in DEVICES)
    for one, other in zip(cpu, cuda, strict=True):
        # A vertex whose nearest sample of the skin is a close call may be pushed along another normal.
        assert np.quantile(np.linalg.norm(one - other, axis=-1), 0.999) < 1e-4


def test_whole_ladder_leaves_as_little_contact(outfit: Outfit, shot: Shot) -> None:
    shares = []
    for device in DEVICES:
        draped = drape(outfit, shot, DrapeOptions(resolution=48, device=device))
        meter, figures = FrameMeter(draped.scene), []
        for chunk in draped:
            for index in range(len(chunk.body)):
                row = meter.measure(chunk, index)
                figures.append([value for name, value in row.items() if "area_percent" in name])
        shares.append(np.mean(figures))
    assert shares[1] < shares[0] + 0.02


def test_nearest_samples_and_pushes_agree() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 500, 3, generator=generator)
    normals = torch.nn.functional.normalize(points, dim=-1)
    vertices = torch.randn(2, 300, 3, generator=generator)
    cpu = Surface(points, normals, reach=0.5)
    cuda = Surface(points.cuda(), normals.cuda(), reach=0.5)
    torch.testing.assert_close(clearance(vertices.cuda(), cuda).cpu(), clearance(vertices, cpu))
    torch.testing.assert_close(force(vertices.cuda(), [cuda]).cpu(), force(vertices, [cpu]))


@pytest.fixture(scope="module")
def make_task(
    body: Body, collection: Collection, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, str], Task]:
    """A small task of a kind, on a device; equal on both but for where it lives."""
    dataset, folder = tube_dataset(), tmp_path_factory.mktemp("patterns")
    train_patterns(dataset, folder, run=RunOptions(steps=5), options=PATTERNS)
    skirt, skin = collection.bundle("skirt.safetensors"), collection.skin
    field = SkinFieldConfig(num_vertices=len(body.template), width=32)

    def make(kind: str, device: str) -> Task:
        torch.manual_seed(0)
        run = RunOptions(steps=5, device=device)
        if kind == "patterns":
            return PatternTask(dataset, PATTERNS, run)
        if kind == "atlas":
            return AtlasTask(dataset, folder / CHECKPOINT, ATLAS, run)
        if kind == "skin":
            return SkinTask(body, field, Diffusion(samples=4000), device=device)
        if kind == "drape":
            small = DisplacementOptions(wardrobe=WardrobeOptions(garments=2, edge_length=0.05), frames=2)
            return DisplacementTask(skirt, skin, body, small, device=device)
        small = LayeringOptions(garments=2, held_out=0, edge_length=0.05)
        return LayeringTask([skirt], skin, body, small, device=device)

    return make


@pytest.mark.parametrize("kind", ["patterns", "atlas", "skin", "drape", "layering"])
def test_losses_and_gradients_agree(kind: str, make_task: Callable[[str, str], Task]) -> None:
    found = {}
    for device in DEVICES:
        task = make_task(kind, device)
        terms = task.losses(torch.Generator().manual_seed(3), 0.5)
        torch.stack(list(terms.values())).sum().backward()
        squares = [p.grad.square().sum() for p in task.module.parameters() if p.grad is not None]
        found[device] = {name: float(value.detach()) for name, value in terms.items()}
        found[device]["gradient"] = float(torch.stack(squares).sum().sqrt())
        assert all(np.isfinite(value) for value in task.measure().values())
    assert found["cuda"] == pytest.approx(found["cpu"], rel=2e-3, abs=1e-5)


def test_training_on_cuda_goes_on_on_a_cpu_and_makes_a_bundle(tmp_path: Path) -> None:
    dataset = tube_dataset()
    patterns = tmp_path / "patterns"
    report = train_patterns(dataset, patterns, run=RunOptions(steps=20, device="cuda"), options=PATTERNS)
    assert report.device == "cuda"
    weights, manifest = read_checkpoint(patterns / CHECKPOINT)
    assert manifest["device"] == "cuda"
    assert all(tensor.device.type == "cpu" for tensor in weights.values())
    further = RunOptions(steps=25, resume=True)
    assert train(PatternTask(dataset, PATTERNS, further), patterns, further).steps == 25
    train_atlas(
        dataset, patterns / CHECKPOINT, tmp_path, run=RunOptions(steps=20, device="cuda"), options=ATLAS
    )
    assert (tmp_path / "tube.safetensors").is_file()


def test_networks_trained_on_cuda_are_written_as_bundles(
    tmp_path: Path, body: Body, collection: Collection
) -> None:
    run, skirt = RunOptions(steps=2, device="cuda"), collection.bundle("skirt.safetensors")
    train_skin(
        tmp_path / "skin", run, body=body, rest_poses=rest_poses_of_categories(),
        diffusion=Diffusion(samples=4000), config=SkinFieldConfig(num_vertices=len(body.template), width=32),
    )  # fmt: skip
    skin = SkinBundle.load(tmp_path / "skin" / "skin.safetensors")
    drape_options = DisplacementOptions(wardrobe=WardrobeOptions(garments=2, edge_length=0.05), frames=2)
    train_displacement(skirt, skin, tmp_path, run, body=body, options=drape_options, gap_iterations=2)
    draped = GarmentBundle.load(tmp_path / "skirt.safetensors")
    layering = LayeringOptions(garments=2, held_out=0, edge_length=0.05)
    train_layering([draped], skin, tmp_path, run, body=body, options=layering, stacks=1)
    assert LayeringBundle.load(tmp_path / "layering.safetensors").metrics["after.strain_p99"] > 0
