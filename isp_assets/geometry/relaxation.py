"""Relax a garment that is strained: a state of lower energy near by, clear of what lies beneath.

Projection looks at one vertex at a time and eases what it strained close by. Where a pose strains
a whole garment, as a deep squat does its seat, the cloth has to move as a whole. That is a
minimum of its energy (membrane, bending, gravity) over planes through the nearest skin, and the
nearest cloth of every layer beneath, which are looked up anew after every few steps. Each step is
one of L-BFGS, whose first guess of the inverse Hessian is the constant matrix of projective
dynamics, factored once a garment.

Positions are in metres, Y up, in one shared space. NumPy, one frame at a time.

Reference: Liu, Bouaziz and Kavan, "Quasi-Newton Methods for Real-Time Simulation of
Hyperelastic Materials", ACM Transactions on Graphics 36(3), 2017.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU

from isp_assets.conventions import GRAVITY
from isp_assets.errors import GeometryError
from isp_assets.geometry.energy import ClothRest, Fabric
from isp_assets.geometry.grading import edge_lengths, edge_strain
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, apart_from_arms
from isp_assets.geometry.stretch import deformation_gradient, factored

_CONTACT = 2e6  # stiffness of contact per mass [1/s²]
_ABOVE = 0.001  # asked for on top of the margin [m]: a penalty gives way a little
_NEAR = 0.02  # cloth further than this above its margin [m] meets nothing in a few steps
_DEEP = 0.06  # cloth deeper than this [m] does not know its way out
_DEPTH = 0.025  # lacking clearance beyond which the penalty grows linearly [m]
_CAUGHT = 0.002  # cloth this near to the margin of another limb [m] stays where projection put it
_HOLD = 5.0  # how firmly, relative to contact
_HELD = 1e6  # weight of a held vertex, relative to a free one
_DAMPING = 0.05  # share of its diagonal that the matrix gains, since the membrane resists no bending
_MEMORY = 10  # steps that L-BFGS remembers
_SHORTENINGS = 12  # halvings of a step that does not lower the energy
_DESCENT = 1e-4  # share of the promised decrease that a step must bring
_SETTLED = 1e-7  # decrease [J] below which nothing more happens

Energy = Callable[[Float[np.ndarray, "V 3"]], tuple[float, Float[np.ndarray, "V 3"]]]
"""Energy [J] of positions, and its gradient [N]."""


@dataclass(frozen=True, eq=False)
class ElasticCloth:
    """The energy of one garment of V vertices; its matrices are made when first needed, and kept."""

    rest: ClothRest
    """Its flat state, graded to the body."""
    fabric: Fabric
    free: Bool[np.ndarray, " V"]
    """Vertices that the body does not hold."""

    @cached_property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        return self.rest.faces.cpu().numpy()

    @cached_property
    def flat_lengths(self) -> Float[np.ndarray, "F 3"]:
        """Flat lengths of every face's edges, from each corner to the next [m]."""
        return edge_lengths(self.rest)

    @cached_property
    def area(self) -> Float[np.ndarray, " F"]:
        return self.rest.area.cpu().double().numpy()

    @cached_property
    def mass(self) -> Float[np.ndarray, " V"]:
        return self.rest.mass.cpu().double().numpy()

    @cached_property
    def gradient(self) -> csr_array:
        """[2 F, V]: positions to the two columns of every face's deformation gradient."""
        return deformation_gradient(self.faces, self.rest.inverse_rest.cpu().double().numpy(), len(self.free))

    @cached_property
    def weighted(self) -> csr_array:
        """[V, 2 F]: its transpose, faces weighted by their flat areas."""
        return (self.gradient.T @ diags_array(np.repeat(self.area, 2))).tocsr()

    @cached_property
    def bending(self) -> csr_array:
        """[V, V]: the constant Hessian of the bending energy [N/m]."""
        hinge, weights, area = (
            part.cpu().numpy() for part in (self.rest.hinges, self.rest.hinge_weights, self.rest.hinge_area)
        )
        row = np.broadcast_to(np.arange(len(hinge))[:, None], hinge.shape)
        entries = weights.astype(np.float64).ravel(), (row.ravel(), hinge.ravel())
        across = coo_array(entries, shape=(len(hinge), len(self.free))).tocsr()
        return (across.T @ diags_array(3 * self.fabric.bending / area.astype(np.float64)) @ across).tocsr()

    @cached_property
    def solver(self) -> SuperLU:
        """The factored matrix of projective dynamics: that of cloth without strain, damped."""
        stiffness = (2 * self.fabric.mu + self.fabric.lam) * (self.weighted @ self.gradient) + self.bending
        diagonal = stiffness.diagonal()
        damping = np.where(self.free, _DAMPING * diagonal, _HELD * diagonal.max())
        return factored(stiffness + diags_array(damping))

    def strain_p99(self, vertices: Float[np.ndarray, "V 3"]) -> float:
        """99th percentile of the relative change of edge lengths."""
        return float(np.percentile(np.abs(edge_strain(vertices, self.faces, self.flat_lengths)), 99))

    def energy(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """Membrane, bending and gravity together [J], and the gradient [N]; see `geometry.energy`."""
        mu, lam = self.fabric.mu, self.fabric.lam
        deformation = self.gradient @ vertices
        x, y = deformation[0::2], deformation[1::2]
        xx, yy, xy = (np.einsum("fc,fc->f", *pair) for pair in ((x, x), (y, y), (x, y)))
        strain_x, strain_y, shear = 0.5 * (xx - 1), 0.5 * (yy - 1), 0.5 * xy
        trace = strain_x + strain_y
        density = mu * (strain_x**2 + strain_y**2 + 2 * shear**2) + 0.5 * lam * trace**2
        along, across = 2 * mu * strain_x + lam * trace, 2 * mu * strain_y + lam * trace
        stress = np.empty_like(deformation)
        stress[0::2] = x * along[:, None] + y * (2 * mu * shear)[:, None]
        stress[1::2] = y * across[:, None] + x * (2 * mu * shear)[:, None]
        bent = self.bending @ vertices
        gradient = self.weighted @ stress + bent
        gradient[:, 1] += GRAVITY * self.mass
        total = (self.area * density).sum() + 0.5 * (vertices * bent).sum()
        return float(total + GRAVITY * (self.mass * vertices[:, 1]).sum()), gradient


def relax(
    vertices: Float[np.ndarray, "V 3"],
    cloth: ElasticCloth,
    mesh: CollisionMesh,
    beneath: Sequence[Obstacle],
    *,
    still: Bool[np.ndarray, " V"] | None = None,
    rounds: int = 6,
    steps: int = 5,
) -> Float[np.ndarray, "V 3"]:
    """Lower the energy of a garment over the skin and the layers beneath.

    Args:
        vertices: The garment in this frame, clear of what lies beneath [m].
        cloth: Its energy.
        mesh: Its collision data, with the parts that its vertices belong to in this frame.
        beneath: The body, then every inner garment.
        still: Further vertices that stay, such as those of a hem that was pressed flat.
        rounds: Times that the nearest surfaces are looked up.
        steps: Steps after each.

    Returns:
        New positions [m]. They may cut what lies beneath by some tenths of a millimetre.

    Raises:
        GeometryError: If ``rounds`` or ``steps`` is below 1.
    """
    if min(rounds, steps) < 1:
        raise GeometryError(f"relaxing needs at least 1 round and 1 step, got {rounds} and {steps}")
    start = position = np.ascontiguousarray(vertices, np.float64)
    own, skin = apart_from_arms(mesh.parts), beneath[0]
    touch = skin.contacts(start, ~own, within=_NEAR)
    caught = (touch.height < skin.margin + _CAUGHT) & ~touch.on_border & ~touch.on_cut
    stiffness = _CONTACT * cloth.mass
    if still is not None:
        caught |= still
    hold = (_HOLD * stiffness * caught)[:, None]
    parts = [own] + [mesh.parts] * (len(beneath) - 1)
    for _ in range(rounds):
        planes = _Planes.joined(
            [
                _Planes.nearest(position, on, surface, stiffness, concerned=~caught)
                for on, surface in zip(parts, beneath, strict=True)
            ]
        )

        def energy(place: Float[np.ndarray, "V 3"], planes: _Planes = planes) -> tuple[float, np.ndarray]:
            total, gradient = cloth.energy(place)
            pushed, push = planes.energy(place)
            moved = place - start
            total += pushed + 0.5 * float((hold * moved * moved).sum())
            return total, (gradient + push + hold * moved) * cloth.free[:, None]

        position = _descend(position, energy, cloth, steps=steps)
    return position


@dataclass(frozen=True, eq=False)
class _Planes:
    """Planes through the nearest skin or layer of some vertices, which they stay above."""

    index: Int[np.ndarray, " n"]
    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    level: Float[np.ndarray, " n"]
    stiffness: Float[np.ndarray, " n"]

    @classmethod
    def nearest(
        cls,
        position: Float[np.ndarray, "V 3"],
        own: Bool[np.ndarray, "V 6"],
        surface: Obstacle,
        stiffness: Float[np.ndarray, " V"],
        *,
        concerned: Bool[np.ndarray, " V"],
    ) -> "_Planes":
        found = surface.contacts(position, own, within=_DEEP)
        level = surface.margin_at(found) + _ABOVE
        near = concerned & (found.height < level + _NEAR) & (found.height > -_DEEP) & ~found.on_border
        index = np.flatnonzero(near)
        # Above its level, a vertex is kept off by the way to it; beneath, by the surface's own normal.
        way = (position - found.point)[index] / np.maximum(np.abs(found.height[index]), 1e-9)[:, None]
        above = (found.height > level)[index]
        normal = np.where(above[:, None], way, found.normal[index])
        return cls(index, found.point[index], normal, level[index], stiffness[index])

    @classmethod
    def joined(cls, planes: Sequence["_Planes"]) -> "_Planes":
        """All planes of several surfaces."""
        names = ("index", "point", "normal", "level", "stiffness")
        return cls(*(np.concatenate([getattr(each, name) for each in planes]) for name in names))

    def energy(self, position: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """Penalty for what lacks to the levels: quadratic, then linear."""
        height = np.einsum("nc,nc->n", position[self.index] - self.point, self.normal)
        lacking = (self.level - height).clip(0)
        near = lacking.clip(max=_DEPTH)
        gradient = np.zeros_like(position)
        np.add.at(gradient, self.index, -(self.stiffness * near)[:, None] * self.normal)
        return float((self.stiffness * (0.5 * near**2 + _DEPTH * (lacking - near))).sum()), gradient


def _descend(
    position: Float[np.ndarray, "V 3"], energy: Energy, cloth: ElasticCloth, *, steps: int
) -> Float[np.ndarray, "V 3"]:
    """Some steps of L-BFGS, each shortened until it lowers the energy."""
    history: list[tuple[np.ndarray, np.ndarray, float]] = []
    value, gradient = energy(position)
    for _ in range(steps):
        direction = _direction(gradient, history, cloth)
        slope = float((gradient * direction).sum())
        if slope >= 0:
            break
        for halving in range(_SHORTENINGS):
            step = 0.5**halving * direction
            reached, turned = energy(position + step)
            if reached <= value + _DESCENT * 0.5**halving * slope:
                break
        else:
            break
        change = turned - gradient
        curvature = float((step * change).sum())
        if curvature > 0:
            history = [*history[1 - _MEMORY :], (step, change, 1 / curvature)]
        gain, position, value, gradient = value - reached, position + step, reached, turned
        if gain < _SETTLED:
            break
    return position


def _direction(
    gradient: Float[np.ndarray, "V 3"],
    history: list[tuple[np.ndarray, np.ndarray, float]],
    cloth: ElasticCloth,
) -> Float[np.ndarray, "V 3"]:
    """The two-loop recursion of L-BFGS around the factored matrix."""
    left, shares = gradient.copy(), []
    for step, change, weight in reversed(history):
        shares.append(weight * float((step * left).sum()))
        left -= shares[-1] * change
    direction = cloth.solver.solve(left)
    for (step, change, weight), share in zip(history, reversed(shares), strict=True):
        direction += (share - weight * float((change * direction).sum())) * step
    return -direction * cloth.free[:, None]
