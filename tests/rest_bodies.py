"""The default body in its rest poses, measured once for all tests of the training data."""

from functools import lru_cache

from isp_assets.train.garment_maker import GarmentMaker, Recipe
from isp_assets.train.landmarks import RestBody


@lru_cache(maxsize=1)
def maker() -> GarmentMaker:
    return GarmentMaker(Recipe(out="unused", seed=0, body="default", edge_length=0.018))


def rest_body(category: str) -> RestBody:
    return maker().rest_body(category)
