"""What goes into the recording, and the views it opens with. The only module that imports rerun, and late."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from isp_assets.errors import PluginError
from isp_assets.frames import Layer, Scene
from isp_assets_plugins.normals import VertexNormals

from .block import Block

APPLICATION = "isp-assets"
BODY_COLOR = (158, 153, 148)
TIMELINE = "frame"
_END_MARK = b"FOOT"  # rerun closes a whole file with this; without it the file was cut short
_FINAL = "final"  # figures of the finished frame; those of earlier steps are recorded, but not plotted
_ABOVE = ("body_area_percent", "inner_area_percent")  # plots that are always in sight; the others share tabs
_LAST = "ms_per_frame"


class Review:
    """An open recording.

    Entities: ``/world/Body``, ``/world/Garments/L00_...``, ``/metrics/<figure>/<what>``.
    Timelines: ``frame`` (frame numbers) and ``time`` (seconds from the first frame).
    """

    def __init__(self, path: Path, scene: Scene, *, recording_id: str) -> None:
        import rerun as rr

        self._rr = rr
        self._path = path
        self._scene = scene
        # Without the automatic properties: they hold the date.
        self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
        self._stream.save(str(path))
        self._stream.send_recording_name(scene.name)
        self._stream.send_property("shot", rr.AnyValues(fps=scene.fps, frames=str(scene.frames)))
        self._stream.log("/world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        self._figures: set[str] = set()
        self._bounds: list[Float[np.ndarray, "2 3"]] = []
        self._meshes: list[tuple[str, Int[np.ndarray, " P"], VertexNormals]] = []

    def send(self, block: Block) -> None:
        """Append frames."""
        if not self._meshes:
            self._log_meshes(block.meshes[0].shape[1])
        seconds = (block.frames - self._scene.frames.start) / self._scene.fps
        times = self._times(block.frames, seconds)
        for (entity, index, normals), vertices in zip(self._meshes, block.meshes, strict=True):
            points = vertices[:, index]
            shading = np.stack([normals(frame)[index] for frame in vertices])
            columns = self._rr.Mesh3D.columns(
                vertex_positions=points.reshape(-1, 3), vertex_normals=shading.reshape(-1, 3)
            )
            lengths = [len(index)] * len(points)
            self._stream.send_columns(entity, indexes=times, columns=columns.partition(lengths=lengths))
        self._bounds += [np.stack([m.min((0, 1)), m.max((0, 1))]) for m in block.meshes]
        for figure in sorted({name for figures in block.figures for name in figures}):
            self._send_figure(figure, block, seconds)

    def close(self) -> None:
        """Add the views and complete the file.

        Raises:
            PluginError: If it could not be written whole, as when the disk is full.
        """
        self._stream.send_blueprint(self._views())
        try:
            self._stream.flush()
        except Exception as error:  # rerun raises RuntimeError when its writing thread has died
            raise PluginError(f"rerun: {self._path}: the recording could not be written: {error}") from error
        self._stream.disconnect()
        with self._path.open("rb") as file:
            file.seek(max(0, self._path.stat().st_size - 64))
            if _END_MARK not in file.read():
                raise PluginError(f"rerun: {self._path}: the recording was cut short; is the disk full?")

    def drop(self) -> None:
        """Let go of the file."""
        self._stream.disconnect()

    def _times(self, frames: Int[np.ndarray, " T"], seconds: Float[np.ndarray, " T"]) -> list[Any]:
        column = self._rr.TimeColumn
        return [column(TIMELINE, sequence=frames), column("time", duration=seconds)]

    def _log_meshes(self, body_vertices: int) -> None:
        """Everything about the meshes but where they are."""
        rr, scene = self._rr, self._scene
        body = rr.Mesh3D.from_fields(triangle_indices=scene.body_faces, albedo_factor=BODY_COLOR)
        self._stream.log("/world/Body", body, static=True)
        normals = VertexNormals(scene.body_faces, body_vertices)
        self._meshes = [("/world/Body", np.arange(body_vertices), normals)]
        for layer in scene.layers:
            entity = f"/world/Garments/{rr.escape_entity_path_part(layer.name)}"
            self._stream.log(entity, self._layer_mesh(layer), static=True)
            index = np.concatenate([panel.vertex_index for panel in layer.garment.panels.values()])
            normals = VertexNormals(layer.garment.faces, layer.garment.num_vertices)
            self._meshes.append((entity, index, normals))

    def _layer_mesh(self, layer: Layer) -> Any:
        rr = self._rr
        height, width = layer.texture.shape[:2]
        form = rr.components.ImageFormat(
            width, height, color_model=rr.ColorModel.RGB, channel_datatype=rr.ChannelDatatype.U8
        )
        return rr.Mesh3D.from_fields(
            triangle_indices=layer.garment.corner_st_index,
            vertex_texcoords=layer.garment.st * [1, -1] + [0, 1],  # rerun counts from the top of the image
            albedo_texture_buffer=layer.texture.tobytes(),
            albedo_texture_format=form,
        )

    def _send_figure(self, figure: str, block: Block, seconds: Float[np.ndarray, " T"]) -> None:
        """One scalar series, at the frames that have it."""
        rr = self._rr
        *what, kind = figure.split("/")
        path = [rr.escape_entity_path_part(part) for part in (kind, *what)]
        entity = "/metrics/" + "/".join(path)
        if figure not in self._figures:
            self._figures.add(figure)
            self._stream.log(
                entity,
                rr.SeriesLines(names=" / ".join(part for part in what if part != _FINAL) or kind),
                static=True,
            )
        rows = np.array([k for k, figures in enumerate(block.figures) if figure in figures])
        values = np.array([block.figures[k][figure] for k in rows], np.float64)
        times = self._times(block.frames[rows], seconds[rows])
        self._stream.send_columns(entity, indexes=times, columns=rr.Scalars.columns(scalars=values))

    def _views(self) -> Any:
        """3D view beside plots, one plot a figure; the layers can be switched in the tree on the left."""
        import rerun.blueprint as rrb

        low, high = np.min(self._bounds, axis=0)[0], np.max(self._bounds, axis=0)[1]
        middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
        eye = rrb.EyeControls3D(
            position=middle + size * np.array([0.28, 0.10, 0.75]), look_target=middle, eye_up=[0, 1, 0]
        )
        view = rrb.Spatial3DView(
            origin="/world", name=self._scene.name, eye_controls=eye, background=[236, 238, 241]
        )
        kinds = sorted({f.rsplit("/", 1)[-1] for f in self._figures}, key=lambda kind: (kind == _LAST, kind))
        above = [self._plot(kind) for kind in kinds if kind in _ABOVE]
        tabs = [self._plot(kind) for kind in kinds if kind not in _ABOVE]
        column = [*above, rrb.Tabs(*tabs, active_tab=0)] if tabs else above
        main = rrb.Horizontal(view, rrb.Vertical(*column), column_shares=[3, 1]) if column else view
        return rrb.Blueprint(
            main,
            rrb.BlueprintPanel(state="expanded"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIMELINE, fps=self._scene.fps),
        )

    def _plot(self, kind: str) -> Any:
        import rerun.blueprint as rrb

        origin = f"/metrics/{self._rr.escape_entity_path_part(kind)}"
        stepwise = any(f.startswith(f"{_FINAL}/") and f.endswith(f"/{kind}") for f in self._figures)
        contents = f"$origin/{_FINAL}/**" if stepwise else "$origin/**"
        return rrb.TimeSeriesView(origin=origin, contents=contents, name=kind.replace("_", " "))
