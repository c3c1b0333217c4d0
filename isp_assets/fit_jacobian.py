"""How the vertices of a decoded garment follow its code: positions and Jacobian, for one topology.

A point of a panel depends on its own place and on the code alone. So with one copy of
the code a point, three backward passes through an atlas and one through a panel field
give every row of the Jacobian, however long the code is.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 3 and 5.
"""

from collections.abc import Mapping
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.decode import BorderSlope, weld_points
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.sewing import SewnPanels


def vertex_jacobian(
    model: GarmentModel, sewn: SewnPanels, code: Float[Tensor, " Z"], border: Mapping[str, BorderSlope]
) -> Float[Tensor, "V 3 Z"]:
    """Derivatives of the vertices that `lift_points` and `weld_points` give [m].

    Args:
        model: The category's networks, at the precision of ``code``.
        sewn: Flat panels [network units].
        code: Where to differentiate.
        border: What `border_slopes` gives for the code that the panels were cut at; border
            points follow the zero level (Eq. 5).
    """
    lifted = {side: _panel_jacobian(model, sewn, side, code, border[side]) for side in sewn.panels}
    return torch.func.vmap(partial(weld_points, sewn), in_dims=-1, out_dims=-1)(lifted)


def _panel_jacobian(
    model: GarmentModel, sewn: SewnPanels, side: str, code: Float[Tensor, " Z"], slope: BorderSlope
) -> Float[Tensor, "n 3 Z"]:
    xy = torch.from_numpy(sewn.panels[side].points).to(code)
    with torch.enable_grad():
        codes = code.detach().expand(len(slope.points), -1).contiguous().requires_grad_()
        distance = model.panel_fields[side].signed_distance(xy[slope.points], codes)
        (rise,) = _gradients(distance, codes)
        moved = xy.index_add(0, slope.points, -slope.step * (distance.detach() - slope.distance)[:, None])
        codes = code.detach().expand(len(xy), -1).contiguous().requires_grad_()
        lifted = model.atlases[side](moved.requires_grad_(), codes)
        rows = [_gradients(axis, moved, codes) for axis in lifted.unbind(-1)]
    by_place, by_code = (torch.stack(each, dim=1) for each in zip(*rows, strict=True))
    follow = by_place[slope.points] @ -slope.step[..., None] * rise[:, None]
    return by_code.index_add(0, slope.points, follow)


def _gradients(values: Float[Tensor, " n"], *inputs: Tensor) -> tuple[Tensor, ...]:
    """Of each value with respect to its own rows of the inputs; networks see points one by one."""
    return torch.autograd.grad(
        values.sum(), inputs, retain_graph=True, allow_unused=True, materialize_grads=True
    )
