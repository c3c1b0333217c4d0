"""What a correction by D_m did: intersections and strain of one garment, before and after."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import Body
from isp_assets.geometry.closest import SurfaceTopology
from isp_assets.geometry.grading import face_strain
from isp_assets.geometry.intersection import Beneath, measure_intersection

if TYPE_CHECKING:
    from isp_assets.train.layering import Stack


def measure_layering(stack: "Stack", lifted: Float[Tensor, "T V 3"], body: Body) -> dict[str, float]:
    """Figures of the outermost garment of a stack, averaged over its frames.

    Returns:
        For ``before.`` and ``after.``: area inside the body and beneath the inner layers
        (the worst of them) [%], crossing pairs, 99th percentile of the strain.
    """
    rows = [_frame(stack, lifted, body, frame) for frame in range(len(lifted))]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _frame(stack: "Stack", lifted: Tensor, body: Body, frame: int) -> dict[str, float]:
    skin = stack.posed.vertices[frame].double().cpu().numpy()
    surfaces = [Beneath(skin, SurfaceTopology.build(body.faces.cpu().numpy(), len(skin)), closed=True)]
    for wearer, vertices in stack.inner:
        positions = vertices[frame].double().cpu().numpy()
        topology = SurfaceTopology.build(wearer.rest.faces.cpu().numpy(), len(positions))
        surfaces.append(Beneath(positions, topology, closed=False))
    figures: dict[str, float] = {}
    faces = stack.wearer.rest.faces.cpu().numpy()
    for when, vertices in (("before", stack.draped), ("after", lifted)):
        positions = vertices[frame].double().cpu().numpy()
        on_body, *on_layers = (measure_intersection(positions, faces, surface) for surface in surfaces)
        strain = face_strain(vertices[frame : frame + 1], stack.wearer.rest)
        figures |= {
            f"{when}.body_area_percent": on_body.area_percent,
            f"{when}.layer_area_percent": max(found.area_percent for found in on_layers),
            f"{when}.crossing_pairs": float(sum(found.crossing_pairs for found in (on_body, *on_layers))),
            f"{when}.strain_p99": float(strain.quantile(0.99)),
        }
    return figures
