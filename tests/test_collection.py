"""Collections: the built-in one is complete and lossless; wrong ones are named."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.code_file import GarmentCode
from isp_assets.collection import DEFAULT_FOLDER, FILE_NAME, Collection
from isp_assets.errors import BundleError, CollectionError, InputError, OutfitError

EXPECTED = {"tank_top", "long_sleeved_shirt", "open_jacket", "trousers", "shorts", "a_line_skirt"}


@pytest.fixture(scope="module")
def collection() -> Collection:
    return Collection.load("default")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    shutil.copytree(DEFAULT_FOLDER, folder)
    return folder


def edit(folder: Path, old: str, new: str) -> None:
    path = folder / FILE_NAME
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_built_in_garments(collection: Collection) -> None:
    assert len(collection.names()) >= 12
    assert set(collection.names()) >= EXPECTED
    assert collection.body_sha256 == Body.load("default").sha256


def test_every_built_in_garment_decodes(collection: Collection) -> None:
    for name in collection.names():
        item = collection.item(name)
        garment = item.bundle.decode(item.code, resolution=48)
        assert garment.num_vertices > 100, name
        assert garment.seams, name


def test_networks_are_trained(collection: Collection) -> None:
    for file in sorted({e.bundle for e in collection.entries.values()}):
        bundle = collection.bundle(file)
        assert bundle.drape_field is not None, file
        assert bundle.provenance, file
        assert bundle.metrics, file
    assert collection.layering is not None
    assert collection.layering.metrics
    assert collection.skin.metrics


@pytest.mark.parametrize("file", ["top", "skirt", "trousers", "skin", "layering"])
def test_shipped_bundles_save_to_the_same_bytes(file: str, tmp_path: Path) -> None:
    kinds = {"skin": SkinBundle, "layering": LayeringBundle}
    source = DEFAULT_FOLDER / f"{file}.safetensors"
    kinds.get(file, GarmentBundle).load(source).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == source.read_bytes()


def test_data_folder_stays_small() -> None:
    size = sum(p.stat().st_size for p in DEFAULT_FOLDER.parent.rglob("*") if p.is_file())
    assert size < 40e6


def test_unknown_garment_names_the_nearest(collection: Collection) -> None:
    with pytest.raises(CollectionError, match="no garment 'tanktop'; did you mean 'tank_top'"):
        collection.outfit(["tanktop"])


def test_empty_outfit_is_refused(collection: Collection) -> None:
    with pytest.raises(OutfitError, match="at least one garment"):
        collection.outfit([])


def test_layers_keep_the_order_given(collection: Collection) -> None:
    outfit = collection.outfit(["open_jacket", "tank_top"])
    assert [outfit.layer_name(i) for i in range(len(outfit))] == ["L00_open_jacket", "L01_tank_top"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version = 1", "version = 9", "version 9 is not known"),
        ('schema = "isp-assets/collection"', 'schema = "x"', "schema must be"),
        ('skin = "skin.safetensors"', 'skin = "gone.safetensors"', "gone.safetensors"),
        ('fabric = "knit"', 'fabrik = "knit"', "unknown key 'fabrik'; did you mean 'fabric'"),
        ('fabric = "knit"', 'fabric = "lace"', "garment 'tank_top': fabric kind must be one of"),
        ('color = "#e9e4d8"', 'color = "white"', "garment 'tank_top': a colour must look like"),
    ],
)
def test_wrong_collection_file_is_named(copy: Path, old: str, new: str, message: str) -> None:
    edit(copy, old, new)
    with pytest.raises(CollectionError, match=message) as caught:
        Collection.load(copy)
    assert str(copy) in str(caught.value)


def test_missing_folder() -> None:
    with pytest.raises(CollectionError, match="no such file"):
        Collection.load("nowhere")


def test_bundle_of_another_body_is_refused(copy: Path) -> None:
    sha256 = Body.load("default").sha256
    edit(copy, sha256, "0" * 64)
    with pytest.raises(CollectionError, match=f"trained on body {sha256[:12]}.*000000000000"):
        Collection.load(copy).item("tank_top")


def test_wrong_code_name(copy: Path) -> None:
    edit(copy, 'code = "tank_top"', 'code = "tank_topp"')
    with pytest.raises(CollectionError, match="names the code 'tank_topp'"):
        Collection.load(copy).item("tank_top")


def garment_code(collection: Collection, name: str) -> GarmentCode:
    bundle = collection.bundle("skirt.safetensors")
    codes = list(bundle.codes.values())
    return GarmentCode(name, "skirt", 0.5 * (codes[0] + codes[1]), bundle.model_sha256)


def test_a_garment_is_added(copy: Path) -> None:
    before = Collection.load(copy)
    now = before.add(garment_code(before, "half_skirt"), color="#102030", fabric="denim")
    assert now.names() == (*before.names(), "half_skirt")
    assert now.entry("half_skirt").style.kind == "denim"
    np.testing.assert_array_equal(now.item("half_skirt").code, garment_code(before, "x").code)
    old, new = before.bundle("skirt.safetensors"), now.bundle("skirt.safetensors")
    assert list(new.codes) == [*old.codes, "half_skirt"]
    assert new.model_sha256 == old.model_sha256
    assert new.drape_field is not None
    assert now.item("half_skirt").bundle.decode(now.item("half_skirt").code, resolution=48).num_vertices > 100


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"name": "trousers"}, CollectionError, "has a garment 'trousers' already"),
        ({"name": "a b"}, CollectionError, "letters, digits"),
        ({"category": "hat"}, CollectionError, "no bundle of category 'hat'"),
        ({"model_sha256": "0" * 64}, BundleError, "found with other networks"),
    ],
)
def test_what_cannot_be_added_changes_nothing(copy: Path, change, error, message) -> None:
    collection = Collection.load(copy)
    files = {p.name: p.read_bytes() for p in copy.iterdir()}
    with pytest.raises(error, match=message):
        collection.add(replace(garment_code(collection, "half_skirt"), **change))
    with pytest.raises(InputError, match="colour"):
        collection.add(garment_code(collection, "half_skirt"), color="red")
    assert {p.name: p.read_bytes() for p in copy.iterdir()} == files


def test_adding_again_completes_what_was_cut_off(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collection = Collection.load(copy)
    with monkeypatch.context() as patch:
        patch.setattr(
            "isp_assets.collection.write_text", lambda *_: (_ for _ in ()).throw(OSError("disk full"))
        )
        with pytest.raises(OSError, match="disk full"):
            collection.add(garment_code(collection, "half_skirt"))
    half = Collection.load(copy)
    assert "half_skirt" not in half.names()
    assert "half_skirt" in half.add(garment_code(half, "half_skirt")).names()


def test_adding_keeps_the_precision_of_the_bundle(copy: Path) -> None:
    bundle = GarmentBundle.load(copy / "skirt.safetensors")
    bundle.save(copy / "skirt.safetensors", dtype="float32")
    collection = Collection.load(copy)
    now = collection.add(garment_code(collection, "half_skirt"))
    assert now.bundle("skirt.safetensors").precision == "float32"
    assert bundle.precision == "float16"


def test_of_several_bundles_of_a_category_the_codes_own_is_chosen(copy: Path) -> None:
    """A second bundle of skirts, with other networks, listed before the first."""
    other = GarmentBundle.load(copy / "skirt.safetensors")
    for parameter in other.model.atlases["front"].parameters():
        parameter.data.add_(0.01)
    replace(other).save(copy / "more.safetensors")
    edit(copy, "[garments.tank_top]", '[garments.other]\nbundle = "more.safetensors"\ncode = "pencil_skirt"\n'
         'color = "#000000"\n\n[garments.tank_top]')  # fmt: skip
    collection = Collection.load(copy)
    now = collection.add(garment_code(collection, "half_skirt"))
    assert now.entry("half_skirt").bundle == "skirt.safetensors"


def test_files_outside_the_folder_are_refused(copy: Path) -> None:
    shutil.copyfile(copy / "skin.safetensors", copy.parent / "skin.safetensors")
    edit(copy, 'skin = "skin.safetensors"', 'skin = "../skin.safetensors"')
    with pytest.raises(CollectionError, match="expected one in the folder itself"):
        Collection.load(copy)


def test_the_built_in_collection_is_not_changed(collection: Collection) -> None:
    with pytest.raises(CollectionError, match="built-in collection is not changed"):
        collection.add(garment_code(collection, "half_skirt"))


def test_a_copy_holds_the_same(collection: Collection, tmp_path: Path) -> None:
    made = collection.copy_to(tmp_path / "mine")
    assert made.names() == collection.names()
    assert {p.name: p.read_bytes() for p in (tmp_path / "mine").iterdir()} == {
        p.name: p.read_bytes() for p in DEFAULT_FOLDER.iterdir()
    }
    with pytest.raises(CollectionError, match="exists"):
        collection.copy_to(tmp_path / "mine")
