"""Outfits: parts must belong together."""

from dataclasses import replace

import pytest

from isp_assets.collection import Collection
from isp_assets.errors import OutfitError
from isp_assets.outfit import Outfit


def test_parts_of_two_bodies_are_refused() -> None:
    collection = Collection.load("default")
    item = collection.item("tank_top")
    other = replace(collection.skin, body_sha256="f" * 64)
    with pytest.raises(OutfitError, match=r"garment 'tank_top' .* but the skin field on body ffffffffffff"):
        Outfit((item,), other)


def test_one_garment_may_be_worn_twice() -> None:
    outfit = Collection.load("default").outfit(["tee", "tee"])
    assert [outfit.layer_name(i) for i in range(2)] == ["L00_tee", "L01_tee"]
    assert outfit.body_sha256 == outfit.skin.body_sha256
