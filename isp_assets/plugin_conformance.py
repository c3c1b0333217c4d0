"""A conformance suite for authors of writer plugins.

A test needs two lines::

    def test_conformance(tmp_path):
        check_writer(MyWriter, tmp_path)

Every rule is a function of its own, so that a failure names the rule that broke.
"""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from isp_assets.errors import PluginError
from isp_assets.plugin import ShotWriter
from isp_assets.synthetic import SyntheticShot, synthetic_shot

MakeWriter = Callable[[], ShotWriter]


def check_writer(
    make: MakeWriter, folder: Path, *, shot: SyntheticShot | None = None, byte_stable: bool = True
) -> None:
    """Run every rule against a writer.

    Args:
        make: Gives a fresh writer; a class will do.
        folder: An empty folder to write into, such as pytest's ``tmp_path``.
        shot: The shot to write; `synthetic_shot` by default.
        byte_stable: Whether a second run must give the same bytes. Only a file
            format that carries random identifiers may switch this off.

    Raises:
        AssertionError: If a rule is broken; the message names it.
    """
    shot = synthetic_shot() if shot is None else shot
    rules: list[Callable[[MakeWriter, Path, SyntheticShot], None]] = [
        check_attributes, check_publishes_once, check_abort, check_inputs_unchanged, check_misuse,
    ]  # fmt: skip
    if byte_stable:
        rules += [check_same_bytes_again, check_same_bytes_for_any_chunks]
    for rule in rules:
        place = folder / rule.__name__
        place.mkdir(parents=True)
        rule(make, place, shot)


def write_shot(make: MakeWriter, path: Path, shot: SyntheticShot, *, chunk: int = 2) -> None:
    """Write the whole shot to ``path``."""
    writer = make()
    writer.begin(path, shot.scene)
    for part in shot.chunks(chunk):
        writer.add(part)
    writer.finish()


def check_attributes(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """The writer says what it is, and making one touches no files."""
    writer = make()
    assert isinstance(writer, ShotWriter), f"{writer!r} lacks attributes of ShotWriter"
    assert writer.name.isidentifier(), f"name {writer.name!r} must be one plain word"
    assert re.fullmatch(r"\.\w+", writer.suffix), f"suffix {writer.suffix!r} must look like '.abc'"
    assert writer.version, "version must say which file library is behind the writer"
    assert not list(folder.iterdir()), "making a writer must write nothing"


def check_publishes_once(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """The file appears whole at ``finish``, with no strangers beside it; it may replace an old one."""
    writer = make()
    path = folder / f"shot{writer.suffix}"
    writer.begin(path, shot.scene)
    for part in shot.chunks(2):
        writer.add(part)
        assert not path.exists(), "the file must not exist before finish()"
    writer.finish()
    assert path.exists(), "finish() must publish the file"
    strangers = [p.name for p in folder.iterdir() if not p.name.startswith(path.stem)]
    assert not strangers, f"finish() left files that do not start with {path.stem!r}: {strangers}"
    first = set(_digests(folder))
    write_shot(make, path, shot)
    assert set(_digests(folder)) == first, "writing over an old output must leave the same files"


def check_abort(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """``abort`` leaves no trace, whenever it comes, and spares what was published before."""
    for frames_added in (None, 0, 2):
        writer = make()
        path = folder / f"shot{writer.suffix}"
        if frames_added is not None:
            writer.begin(path, shot.scene)
        if frames_added:
            writer.add(next(iter(shot.chunks(frames_added))))
        writer.abort()
        writer.abort()
        left = [p.name for p in folder.rglob("*")]
        assert not left, f"abort() after {frames_added} frames left {left}"
    write_shot(make, path, shot)
    before = _digests(folder)
    writer = make()
    writer.begin(path, shot.scene)
    writer.add(next(iter(shot.chunks(1))))
    writer.abort()
    assert _digests(folder) == before, "abort() changed the files of an earlier run"


def check_inputs_unchanged(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """Arrays given to the writer are read, never written: they may be shared, or read-only."""
    writer = make()
    writer.begin(folder / f"shot{writer.suffix}", shot.scene)
    layers = shot.scene.layers
    static = [
        shot.scene.body_faces, *(x.texture for x in layers), *(x.garment.rest_vertices for x in layers),
    ]  # fmt: skip
    before = [a.copy() for a in static]
    for part in shot.chunks(2):
        arrays = [part.frames, part.body, *part.layers]
        for a in arrays:
            a.flags.writeable = False
        writer.add(part)
    writer.finish()
    same = all(np.array_equal(a, b) for a, b in zip(static, before, strict=True))
    assert same, "the writer changed an array of the scene"


def check_misuse(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """Calls out of order raise `PluginError`."""
    part = next(iter(shot.chunks(1)))
    for what, call in (("add", lambda w: w.add(part)), ("finish", lambda w: w.finish())):
        try:
            call(make())
        except PluginError:
            continue
        raise AssertionError(f"{what}() before begin() must raise PluginError")
    assert not list(folder.iterdir()), "a refused call must write nothing"


def check_same_bytes_again(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """A second run gives the same bytes: no dates, no random numbers, no paths of this machine."""
    digests = []
    for place in (folder / "a", folder / "b"):
        place.mkdir()
        write_shot(make, place / f"shot{make().suffix}", shot)
        digests.append(_digests(place))
    assert digests[0] == digests[1], f"a second run gave other bytes: {_different(*digests)}"


def check_same_bytes_for_any_chunks(make: MakeWriter, folder: Path, shot: SyntheticShot) -> None:
    """The file does not show how the frames were cut into chunks."""
    digests = []
    for size in (1, len(shot.scene.frames)):
        place = folder / f"chunk{size}"
        place.mkdir()
        write_shot(make, place / f"shot{make().suffix}", shot, chunk=size)
        digests.append(_digests(place))
    assert digests[0] == digests[1], f"the size of the chunks changes the bytes: {_different(*digests)}"


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def _different(a: dict[str, str], b: dict[str, str]) -> list[str]:
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
