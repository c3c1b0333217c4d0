"""Contact with the body that knows which part a vertex of a garment belongs to.

Where an arm presses on a shirt, the nearest skin to the shirt's side may be the arm's outer one. A push
towards it would drag the cloth through the arm, and a network that learns from such pushes hangs the
shirt outside the arm. So what another part touches is pulled towards the skin of its own part.

Positions are in metres, in one shared space.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from isp_assets.body import Body
from isp_assets.geometry.contact import Surface, clearance
from isp_assets.geometry.obstacle import ARMS, BODY_PARTS, body_parts

_SAME = 1e-6  # two clearances closer than this [m] are from one sample


@dataclass(frozen=True, eq=False)
class PartedBody:
    """A body in some poses, whole and part by part."""

    whole: Surface
    parts: tuple[Surface | None, ...]
    """The samples of each part; None where it has none."""

    @classmethod
    def of(cls, whole: Surface, members: Bool[Tensor, "P K"]) -> "PartedBody":
        """Cut a body into parts.

        Args:
            whole: Samples of the whole body.
            members: Which parts each sample belongs to; they may overlap.
        """
        rows = [column.nonzero()[:, 0] for column in members.T]
        parts = [_cut(whole, index) if len(index) else None for index in rows]
        return cls(whole, tuple(parts))

    def clearance(
        self, vertices: Float[Tensor, "T V 3"], own: Bool[Tensor, "V K"], *, margin: float
    ) -> Float[Tensor, "T V"]:
        """Height [m] of vertices over the skin, with gradients that point the right way.

        Args:
            vertices: Garment positions [m].
            own: Parts that each vertex belongs to.
            margin: Clearance that is asked for [m]: nearer to its own part than this, a vertex
                has no room to be pulled, and only its own part counts.

        Returns:
            The height over the nearest sample. If that belongs to none of the own parts, the gradient
            is against that of the height over the own ones: rising means going home.
        """
        home = self._own_clearance(vertices, own)
        height = clearance(vertices, self.whole)
        foreign = ((height - home).abs() > _SAME) & (height < margin) & home.isfinite()
        pulled = height.detach() - (home - home.detach())
        return torch.where(foreign, torch.where(home > margin, pulled, home), height)

    def _own_clearance(self, vertices: Tensor, own: Tensor) -> Tensor:
        best = torch.full_like(vertices[..., 0], torch.inf)
        for number, part in enumerate(self.parts):
            rows = own[:, number].nonzero()[:, 0]
            if part is None or len(rows) == 0:
                continue
            height, known = clearance(vertices[:, rows], part), best[:, rows]
            best = best.index_copy(1, rows, torch.where(height.abs() < known.abs(), height, known))
        return best


def body_limbs(body: Body) -> Bool[Tensor, "P 3"]:
    """Which arms, or the rest, each vertex of a body counts to; they overlap at their seams."""
    members = body_parts(body.weights.cpu().numpy())[1]
    return arms_and_rest(torch.from_numpy(members)).to(body.weights.device)


def arms_and_rest(parts: Bool[Tensor, "P 6"]) -> Bool[Tensor, "P 3"]:
    """`BODY_PARTS` as arms and the rest: cloth in the crease of a hip may leave it either way."""
    rest = [index for index in range(len(BODY_PARTS)) if index not in ARMS]
    return torch.cat([parts[:, rest].any(1, keepdim=True), parts[:, list(ARMS)]], dim=1)


def _cut(whole: Surface, index: Int[Tensor, " n"]) -> Surface:
    return Surface(whole.points[..., index, :], whole.normals[..., index, :], whole.reach)
