"""Measure draped frames: intersections, stretch, folded faces. Figures for the report, frame by frame.

Keys of a frame's figures are ``stage/layer/figure``, as in
``final/L01_trousers/body_area_percent``. Stages are ``final`` and, where a chunk keeps
them, the positions after each rung of the ladder ("skin", "displace", "layering"), so
that the networks' own share can be told from the projection's.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from isp_assets.errors import GeometryError
from isp_assets.frames import FrameChunk, Layer, Scene
from isp_assets.geometry.closest import SurfaceTopology
from isp_assets.geometry.folds import folded_faces
from isp_assets.geometry.grading import edge_strain
from isp_assets.geometry.intersection import Beneath, Intersection, measure_intersection
from isp_assets.geometry.topology import hinges

FINAL = "final"

FIGURES: dict[str, str] = {
    "body_area_percent": "share of the garment's area inside the body, where room was left for it [%]",
    "body_unavoidable_percent": "share inside the body where it leaves no room for so many layers [%]",
    "inner_area_percent": "share beneath an inner layer, at most 2 cm deep; the worst inner layer [%]",
    "inner_unavoidable_percent": "the same where the body leaves no room for so many layers [%]",
    "body_crossing_pairs": "pairs of triangles that cross, with the body",
    "inner_crossing_pairs": "pairs of triangles that cross, with all inner layers",
    "crossing_pairs": "pairs of triangles that cross, with anything beneath",
    "deepest_mm": "largest avoidable depth on the wrong side of anything beneath [mm]",
    "strain_p99": "99th percentile of the relative change of edge lengths against the panels as graded",
    "flipped_faces": "faces that point against the mean of their neighbours",
}
"""What each figure means."""


class FrameMeter:
    """Measures the frames of one scene; what no frame changes is prepared once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        num_body_vertices = int(scene.body_faces.max()) + 1
        self._body = SurfaceTopology.build(scene.body_faces, num_body_vertices)
        self._layers = [_LayerMeter(layer) for layer in scene.layers]

    def measure(self, chunk: FrameChunk, index: int, *, stages: bool = False) -> dict[str, float]:
        """Figures of one frame of a chunk.

        Args:
            chunk: Some draped frames.
            index: Row of the frame in the chunk.
            stages: Measure the earlier rungs too, if the chunk keeps them.

        Raises:
            GeometryError: If a position is not finite.
        """
        body = Beneath(chunk.body[index], self._body, closed=True)
        states = {FINAL: chunk.layers, **(chunk.stages if stages else {})}
        figures: dict[str, float] = {}
        measured: list[tuple[list[np.ndarray], dict[str, dict[str, float]]]] = []
        for stage, layers in states.items():
            stack = [layer[index] for layer in layers]
            # A rung that moved nothing in this frame leaves what another one left.
            known = (found for other, found in measured if all(map(np.array_equal, other, stack)))
            of_stack = next(known, None) or self._measure_stack(body, stack)
            measured.append((stack, of_stack))
            for name, values in of_stack.items():
                figures |= {f"{stage}/{name}/{figure}": value for figure, value in values.items()}
        return figures

    def _measure_stack(
        self, body: Beneath, layers: list[Float[np.ndarray, "_ 3"]]
    ) -> dict[str, dict[str, float]]:
        inner: list[Beneath] = []
        figures = {}
        for meter, vertices in zip(self._layers, layers, strict=True):
            if not np.isfinite(vertices).all():
                raise GeometryError(
                    f"layer {meter.name}: positions hold NaN or infinity; nothing can be measured"
                )
            on_body, *on_inner = (
                measure_intersection(vertices, meter.topology.faces, beneath, layers=len(inner))
                for beneath in (body, *inner)
            )
            figures[meter.name] = _contact_figures(on_body, on_inner) | meter.shape_figures(vertices)
            inner.append(Beneath(vertices, meter.topology, closed=False, body=body))
        return figures


def summarise(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Mean and maximum of every figure: ``summary[stage][layer][figure] -> {"mean", "max", "frames"}``.

    Args:
        rows: Figures per frame; keys that are not ``stage/layer/figure`` are passed over.
    """
    values: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        for key, value in row.items():
            parts = tuple(key.split("/"))
            if len(parts) == 3:
                values.setdefault(parts, []).append(float(value))
    summary: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for (stage, layer, figure), series in values.items():
        cell = {"mean": float(np.mean(series)), "max": float(np.max(series)), "frames": len(series)}
        summary.setdefault(stage, {}).setdefault(layer, {})[figure] = cell
    return summary


class _LayerMeter:
    """Static data of one layer."""

    def __init__(self, layer: Layer) -> None:
        garment = layer.garment
        self.name = layer.name
        self.topology = SurfaceTopology.build(garment.faces, garment.num_vertices)
        self.lengths = layer.flat_lengths
        self.pairs = hinges(garment.faces).faces

    def shape_figures(self, vertices: Float[np.ndarray, "V 3"]) -> dict[str, float]:
        faces = self.topology.faces
        strain = np.abs(edge_strain(vertices, faces, self.lengths))
        return {
            "strain_p99": float(np.percentile(strain, 99)),
            "flipped_faces": float(folded_faces(vertices, faces, self.pairs).sum()),
        }


def _contact_figures(body: Intersection, inner: list[Intersection]) -> dict[str, float]:
    inner_pairs = sum(found.crossing_pairs for found in inner)
    return {
        "body_area_percent": body.area_percent,
        "body_unavoidable_percent": body.unavoidable_percent,
        "inner_area_percent": max((found.area_percent for found in inner), default=0.0),
        "inner_unavoidable_percent": max((found.unavoidable_percent for found in inner), default=0.0),
        "body_crossing_pairs": float(body.crossing_pairs),
        "inner_crossing_pairs": float(inner_pairs),
        "crossing_pairs": float(body.crossing_pairs + inner_pairs),
        "deepest_mm": 1000 * max(found.deepest for found in (body, *inner)),
    }
