"""Plugins are found by entry point and by folder; a broken one is reported and harms no other."""

from pathlib import Path

import pytest

from isp_assets.errors import PluginError
from isp_assets.plugin import PATH_VARIABLE, ShotWriter, find_writers, make_writer

GOOD = """
class WRITER:
    name = "counter"
    suffix = ".txt"
    version = "1"
    def begin(self, path, scene): ...
    def add(self, chunk): ...
    def finish(self): ...
    def abort(self): ...
"""


def test_built_in_writers_are_found_with_versions() -> None:
    found = find_writers()
    assert {"glb", "rerun", "sheet", "usd"} <= set(found)
    for name in ("glb", "rerun", "sheet", "usd"):
        assert found[name].error is None, found[name].error
        assert found[name].version
        assert isinstance(make_writer(name), ShotWriter)


def test_folder_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "counter.py").write_text(GOOD)
    (tmp_path / "broken.py").write_text("raise RuntimeError('no licence')")
    (tmp_path / "partial.py").write_text(
        "class WRITER:\n    name = 'partial'\n    suffix = '.p'\n    version = '1'\n"
    )
    monkeypatch.setenv(PATH_VARIABLE, str(tmp_path))
    found = find_writers()
    assert make_writer("counter").suffix == ".txt"
    assert "no licence" in (found["broken"].error or "")
    assert "lacks begin, add, finish, abort" in (found["partial"].error or "")
    with pytest.raises(PluginError, match=r"'broken' .* is broken: RuntimeError: no licence"):
        make_writer("broken")


def test_unknown_writer_names_those_found() -> None:
    with pytest.raises(PluginError, match=r"no writer plugin named 'fbx'; found: .*usd"):
        make_writer("fbx")
