"""Draping in several processes: the same frames in the same order, and what happens when one fails."""

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions
from isp_assets.drape_workers import drape_shot
from isp_assets.errors import DrapeError
from isp_assets.frames import FrameChunk, Scene
from isp_assets.motion import Motion
from isp_assets.outfit import Outfit
from isp_assets.shot import Shot

OPTIONS = DrapeOptions(resolution=32, chunk=2)


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Collection.load("default").outfit(["trousers", "tee"])


@pytest.fixture(scope="module")
def shot() -> Shot:
    return Shot("test", Body.load("default"), Motion.load("walk").select(FrameRange(10, 18)))


def first_rows(scene: Scene) -> Callable[[FrameChunk, int], FrameChunk]:
    """Notes where each chunk began, how many layers there were, and the process."""

    def complete(chunk: FrameChunk, first: int) -> FrameChunk:
        note = {"first": float(first), "layers": float(len(scene.layers)), "process": float(os.getpid())}
        return replace(chunk, metrics=(note,) * len(chunk.frames))

    return complete


def die(scene: Scene) -> Callable[[FrameChunk, int], FrameChunk]:
    os._exit(1)


def test_more_processes_give_the_same_frames_in_order(outfit: Outfit, shot: Shot) -> None:
    alone = list(drape_shot(outfit, shot, OPTIONS))
    draped = drape_shot(outfit, shot, OPTIONS, workers=2, finish=first_rows)
    assert [layer.name for layer in draped.scene.layers] == ["L00_trousers", "L01_tee"]
    together = list(draped)
    assert [c.frames.tolist() for c in together] == [[10, 11], [12, 13], [14, 15], [16, 17], [18]]
    for one, other in zip(alone, together, strict=True):
        assert one.steps == other.steps
        for a, b in zip(one.layers, other.layers, strict=True):
            assert np.array_equal(a, b)
    assert [c.metrics[0]["first"] for c in together] == [0, 2, 4, 6, 8]
    assert {c.metrics[0]["layers"] for c in together} == {2.0}
    assert os.getpid() not in {c.metrics[0]["process"] for c in together}


def test_one_process_completes_chunks_here(outfit: Outfit, shot: Shot) -> None:
    quick = replace(OPTIONS, steps=("skin",))
    chunks = list(drape_shot(outfit, shot, quick, finish=first_rows))
    assert [c.metrics[0]["first"] for c in chunks] == [0, 2, 4, 6, 8]
    assert {c.metrics[0]["process"] for c in chunks} == {float(os.getpid())}


def test_an_error_in_a_process_is_raised_here(outfit: Outfit, shot: Shot) -> None:
    other = replace(shot, body=replace(shot.body, sha256="0" * 64))
    with pytest.raises(DrapeError, match="is not the body that the outfit was trained on"):
        drape_shot(outfit, other, OPTIONS, workers=2)


def test_a_process_that_dies_is_an_error_that_says_what_to_do(outfit: Outfit, shot: Shot) -> None:
    with pytest.raises(DrapeError, match=r"died, most likely for want of memory.*use fewer workers"):
        list(drape_shot(outfit, shot, OPTIONS, workers=2, finish=die))


def test_smoothing_over_time_takes_one_process(outfit: Outfit, shot: Shot) -> None:
    with pytest.raises(DrapeError, match=r"workers=2, smoothing=0\.5: expected .* only 1 with smoothing"):
        drape_shot(outfit, shot, replace(OPTIONS, smoothing=0.5), workers=2)
    with pytest.raises(DrapeError, match="expected at least 1 process"):
        drape_shot(outfit, shot, OPTIONS, workers=0)
