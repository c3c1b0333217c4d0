"""The conformance suite is most of a writer's tests; the rest says what is in the file."""

import csv
from pathlib import Path

import pytest
from bounds_writer import BoundsWriter

from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import synthetic_shot


def test_conforms(tmp_path: Path) -> None:
    check_writer(BoundsWriter, tmp_path)


def test_measures_every_layer_in_every_frame(tmp_path: Path) -> None:
    shot = synthetic_shot(frames="1-3")
    write_shot(BoundsWriter, tmp_path / "a.csv", shot)
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [(r["frame"], r["layer"]) for r in rows[:3]] == [
        ("1", "L00_vest"),
        ("1", "L01_coat"),
        ("2", "L00_vest"),
    ]
    assert float(rows[0]["y"]) == pytest.approx(0.5)  # the synthetic garments are tubes 0.5 m high
