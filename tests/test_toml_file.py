"""TOML tables: wrong input is named with its file, key and remedy."""

from pathlib import Path

import pytest

from isp_assets.errors import ShotError
from isp_assets.toml_file import check_keys, read_toml

EXPECTED = {"motion": str, "fps": (int, float), "loop": bool}


def check(table: dict[str, object]) -> None:
    check_keys(table, EXPECTED, {"motion"}, "job.toml", ShotError)


def test_good_table_passes() -> None:
    check({"motion": "walk", "fps": 30})
    check({"motion": "walk", "fps": 29.97, "loop": True})


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"motoin": "walk"}, "unknown key 'motoin'; did you mean 'motion'"),
        ({}, "missing key motion"),
        ({"motion": 3}, "motion must be str, got int 3"),
        ({"motion": "walk", "fps": True}, "fps must be int or float, got bool True"),
    ],
)
def test_wrong_table_is_named(table: dict[str, object], message: str) -> None:
    with pytest.raises(ShotError, match=rf"job\.toml: {message}"):
        check(table)


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(ShotError, match="no such file"):
        read_toml(tmp_path / "none.toml", ShotError)
    (tmp_path / "bad.toml").write_text("a = ")
    with pytest.raises(ShotError, match=r"bad\.toml: not readable as TOML"):
        read_toml(tmp_path / "bad.toml", ShotError)
    (tmp_path / "latin.toml").write_bytes(b'a = "\xff"')
    with pytest.raises(ShotError, match=r"latin\.toml: not readable"):
        read_toml(tmp_path / "latin.toml", ShotError)
