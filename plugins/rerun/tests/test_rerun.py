"""Recordings: what is read back is what was written, and the views are there."""

import importlib.util
import resource
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from isp_assets.errors import MissingExtraError, PluginError
from isp_assets.frames import StageTimes
from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import synthetic_shot
from isp_assets_plugins.rerun import RerunWriter
from isp_assets_plugins.rerun.block import Block

chunk_api = pytest.importorskip("rerun.chunk", reason="this rerun-sdk cannot read files back")


class Recording:
    """All columns of a file, by entity and component, in frame order."""

    def __init__(self, path: Path) -> None:
        reader = chunk_api.RrdReader(path)
        self.recordings, self.blueprints = reader.recordings(), reader.blueprints()
        self.static: dict[tuple[str, str], Any] = {}
        self.moving: dict[tuple[str, str], dict[int, Any]] = defaultdict(dict)
        self.seconds: dict[int, float] = {}
        self.block_sizes: dict[str, list[int]] = defaultdict(list)
        for chunk in reader.stream():
            batch = chunk.to_record_batch()
            if not chunk.is_static:
                self.block_sizes[chunk.entity_path].append(chunk.num_rows)
                frames = batch.column("frame").to_pylist()
                seconds = batch.column("time").cast("int64").to_pylist()
                self.seconds |= {f: s * 1e-9 for f, s in zip(frames, seconds, strict=True)}
            for name in batch.schema.names:
                key = (chunk.entity_path, name)
                if name in ("frame", "time") or name.endswith("RowId"):
                    continue
                if chunk.is_static:
                    self.static[key] = batch.column(name)[0].as_py()
                else:
                    values = batch.column(name)
                    self.moving[key] |= {f: values[k].as_py() for k, f in enumerate(frames)}


def _written(folder: Path, shot, *, chunk: int = 2) -> Recording:
    path = folder / "shot.rrd"
    write_shot(RerunWriter, path, shot, chunk=chunk)
    return Recording(path)


def test_conforms(tmp_path):
    check_writer(RerunWriter, tmp_path, byte_stable=False)


def test_positions_are_exact(tmp_path):
    shot = synthetic_shot(frames="1001-1023")
    recording = _written(tmp_path, shot)
    for k, frame in enumerate(shot.scene.frames):
        body = recording.moving["/world/Body", "Mesh3D:vertex_positions"][frame]
        assert (np.array(body, np.float32) == shot.body[k]).all()
        for layer, vertices in zip(shot.scene.layers, shot.layers, strict=True):
            index = np.concatenate([p.vertex_index for p in layer.garment.panels.values()])
            found = recording.moving[f"/world/Garments/{layer.name}", "Mesh3D:vertex_positions"][frame]
            assert (np.array(found, np.float32) == vertices[k][index]).all()


def test_topology_and_texture_come_once(tmp_path):
    shot = synthetic_shot(frames="1-25")
    recording = _written(tmp_path, shot)
    for layer in shot.scene.layers:
        entity = f"/world/Garments/{layer.name}"
        faces = np.array(recording.static[entity, "Mesh3D:triangle_indices"])
        assert (faces == layer.garment.corner_st_index).all()
        st = np.array(recording.static[entity, "Mesh3D:vertex_texcoords"])
        np.testing.assert_allclose(st, layer.garment.st * [1, -1] + [0, 1], atol=1e-6)
        pixels = np.array(recording.static[entity, "Mesh3D:albedo_texture_buffer"], np.uint8)
        assert (pixels.reshape(layer.texture.shape) == layer.texture).all()
        moving = {name for path, name in recording.moving if path == entity}
        assert moving == {"Mesh3D:vertex_positions", "Mesh3D:vertex_normals"}


@pytest.mark.parametrize("chunk", [1, 7, 25])
def test_frames_come_in_blocks_of_ten(chunk, tmp_path):
    recording = _written(tmp_path, synthetic_shot(frames="1-25"), chunk=chunk)
    assert recording.block_sizes["/world/Body"] == [10, 10, 5]


def test_time_counts_from_the_first_frame(tmp_path):
    shot = synthetic_shot(frames="10-30x10", fps=25.0)
    recording = _written(tmp_path, shot)
    assert recording.seconds == pytest.approx({10: 0.0, 20: 0.4, 30: 0.8})


def test_figures_keep_their_frames(tmp_path):
    """A figure may be measured on some frames only."""
    shot = synthetic_shot(frames="1-12")
    writer = RerunWriter()
    writer.begin(tmp_path / "shot.rrd", shot.scene)
    for part in shot.chunks(4):
        metrics = tuple(
            {"body/L00 vest/area_percent": 0.1 * f, **({"pairs": float(f)} if f % 5 == 0 else {})}
            for f in part.frames.tolist()
        )
        writer.add(replace(part, metrics=metrics, times=StageTimes({"skin": 0.2})))
    writer.finish()
    recording = Recording(tmp_path / "shot.rrd")
    (area,) = (v for (path, _), v in recording.moving.items() if "area_percent" in path)
    assert {f: v[0] for f, v in area.items()} == pytest.approx({f: 0.1 * f for f in range(1, 13)})
    (pairs,) = (v for (path, _), v in recording.moving.items() if path == "/metrics/pairs")
    assert {f: v[0] for f, v in pairs.items()} == {5: 5.0, 10: 10.0}
    skin = recording.moving["/metrics/ms_per_frame/skin", "Scalars:scalars"]
    assert [v[0] for v in skin.values()] == pytest.approx([50.0] * 12)


def test_opens_with_its_views_and_name(tmp_path):
    recording = _written(tmp_path, synthetic_shot())
    assert len(recording.blueprints) == 1
    assert [entry.application_id for entry in recording.recordings] == ["isp-assets"]
    text = str({key: value for key, value in recording.static.items() if "__properties" in key[0]})
    assert "'synthetic'" in text
    assert "1001-1005" in text
    assert recording.static["/world", "ViewCoordinates:xyz"] == [[3, 1, 6]]  # right, up, back


def test_two_recordings_of_one_shot_stay_apart(tmp_path):
    """The viewer merges recordings of one identifier."""
    first, second = (_written(tmp_path, synthetic_shot()).recordings[0].recording_id for _ in range(2))
    assert first != second


def test_block_parts_join_again():
    shot = synthetic_shot()
    blocks = [Block.of_chunk(chunk) for chunk in shot.chunks(2)]
    joined = Block.joined(blocks)
    again = Block.joined([joined.part(0, 1), joined.part(1, 5)])
    assert joined.frames.tolist() == again.frames.tolist() == list(shot.scene.frames)
    assert all((a == b).all() for a, b in zip(joined.meshes, again.meshes, strict=True))
    assert joined.figures == again.figures


@pytest.mark.parametrize("change", ["order", "layers", "nan"])
def test_wrong_chunks_are_refused(change, tmp_path):
    shot = synthetic_shot()
    chunk = next(iter(shot.chunks(2)))
    if change == "order":
        chunk = replace(chunk, frames=chunk.frames[::-1])
    elif change == "layers":
        chunk = replace(chunk, layers=chunk.layers[:1])
    else:
        chunk.body[1, 3, 0] = np.nan
    writer = RerunWriter()
    writer.begin(tmp_path / "shot.rrd", shot.scene)
    with pytest.raises(PluginError, match={"order": "order", "layers": "2 layers", "nan": "NaN"}[change]):
        writer.add(chunk)
    writer.abort()
    assert not list(tmp_path.iterdir())


def test_missing_frames_are_refused(tmp_path):
    shot = synthetic_shot()
    writer = RerunWriter()
    writer.begin(tmp_path / "shot.rrd", shot.scene)
    writer.add(next(iter(shot.chunks(2))))
    with pytest.raises(PluginError, match="only 2 of 5"):
        writer.finish()
    assert not list(tmp_path.iterdir())


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "rerun" else find_spec(name)
    )
    with pytest.raises(MissingExtraError, match="rerun-sdk"):
        RerunWriter().begin(tmp_path / "shot.rrd", synthetic_shot().scene)
    assert not list(tmp_path.iterdir())


_FULL_DISK = """
import sys, resource, signal
from pathlib import Path
from typing import Any
from isp_assets.errors import PluginError
from isp_assets.plugin_conformance import write_shot
from isp_assets.synthetic import synthetic_shot
from isp_assets_plugins.rerun import RerunWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    write_shot(RerunWriter, Path(sys.argv[1]) / "shot.rrd", synthetic_shot(frames="1-60"))
except PluginError as error:
    print("refused:", error)
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a limit on file sizes")
def test_full_disk_leaves_no_file(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", _FULL_DISK, str(tmp_path)], capture_output=True, text=True, timeout=120
    )
    assert "refused: rerun:" in run.stdout, run.stderr
    assert not list(tmp_path.iterdir())


def test_file_cut_short_is_noticed(tmp_path, monkeypatch):
    shot = synthetic_shot()
    writer = RerunWriter()
    writer.begin(tmp_path / "shot.rrd", shot.scene)
    for chunk in shot.chunks(5):
        writer.add(chunk)
    review = writer._review
    assert review is not None
    disconnect = review._stream.disconnect

    def cut() -> None:
        disconnect()
        if review._path.exists():
            review._path.write_bytes(review._path.read_bytes()[:-100])

    monkeypatch.setattr(review._stream, "disconnect", cut)
    with pytest.raises(PluginError, match="cut short"):
        writer.finish()
    assert not list(tmp_path.iterdir())


def test_plots_show_the_finished_frame_only(tmp_path):
    shot = synthetic_shot()
    writer = RerunWriter()
    writer.begin(tmp_path / "shot.rrd", shot.scene)
    figures = {"final/L00_vest/body_area_percent": 0.0, "skin/L00_vest/body_area_percent": 4.0}
    for part in shot.chunks(5):
        writer.add(replace(part, metrics=(figures,) * 5))
    writer.finish()
    reader = chunk_api.RrdReader(tmp_path / "shot.rrd")
    (blueprint,) = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
    columns = [column for batch in batches for column in batch.columns if "timestamp" not in str(column.type)]
    text = " ".join(str(column.to_pylist()) for column in columns)
    assert "$origin/final/**" in text
    assert "/metrics/body_area_percent" in text
    recorded = {path for path, _ in Recording(tmp_path / "shot.rrd").moving}
    assert "/metrics/body_area_percent/skin/L00_vest" in recorded
