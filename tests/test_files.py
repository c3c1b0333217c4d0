"""Files appear whole or not at all."""

from pathlib import Path

import pytest

from isp_assets.files import published, write_text


def test_replaces_the_old_file_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with published(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failure_leaves_the_old_file_and_no_other(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), published(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_makes_missing_folders_and_keeps_the_suffix(tmp_path: Path) -> None:
    path = tmp_path / "b" / "c.json"
    with published(path) as temporary:
        assert temporary.suffix == ".json"
        assert temporary.parent == path.parent
        temporary.write_text("{}")
    assert path.read_text() == "{}"


def test_obeys_the_umask(tmp_path: Path) -> None:
    write_text(tmp_path / "d.txt", "x")
    (tmp_path / "e.txt").write_text("x")
    assert (tmp_path / "d.txt").stat().st_mode == (tmp_path / "e.txt").stat().st_mode
