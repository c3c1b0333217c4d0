"""Clear a layer of all that lies beneath it, frame by frame; relax it; calm both from frame to frame.

Projection knows one frame only. Where cloth is caught between surfaces it may choose
another way out in the next frame, and a few vertices flicker. Calming lets the moves
of projection follow those of the frame before, and projects again what that brings
into contact, except where there is no room: there any place is as good.

Positions are in metres, in world space; NumPy, one frame at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.dressing import WornGarment
from isp_assets.errors import DrapeError
from isp_assets.geometry.buried import LaidCloth
from isp_assets.geometry.obstacle import Obstacle, joined_at_hips
from isp_assets.geometry.projection import Projection, ProjectionOptions, project
from isp_assets.geometry.relaxation import Relaxation

RELAXED_STRAIN = 0.135
"""Strain (p99) of a layer that is left alone, if not told otherwise."""
MOST_LEFT = 0.28  # strain from which cloth is relaxed, whatever its pose and whatever it lies on
_HARD = (0.24, 0.32)  # strains from which a pose counts as hard, and as wholly so: it leaves the most
_ON_CLOTH = (0.2, 0.5)  # shares of a layer on other cloth: it counts as lying on skin, or as wholly on cloth
_THIN = 0.02  # cloth this near to other cloth [m] lies on it
_LIMIT = 0.03  # how far below the strain that is left edges get stiff
_LIFTED = 0.02  # how far above it, or above what was reached, small cuts are lifted
_PASSES = 6  # at most, in a hard pose
_ROUNDS = 3  # a pass, in a hard pose; in others a pass is one round: they often need no more
_STEP = 0.01  # share of a way to which it is known how far strain allows
_FINE = ProjectionOptions(rounds=1, ease=0, finish=1, longest_move=0.001, reach=0.003, poke_reach=0.003)

Obstacles = Sequence[Sequence[Obstacle]]
"""Per frame, what lies beneath: the body, then every finished layer."""


def clear_layer(
    worn: WornGarment, laid: Sequence[LaidCloth], obstacles: Obstacles, options: ProjectionOptions
) -> list[Projection]:
    """Project every frame of a layer.

    Raises:
        DrapeError: If a position is not finite.
    """
    if not all(np.isfinite(cloth.vertices).all() for cloth in laid):
        raise DrapeError(f"layer {worn.layer.name}: positions are not finite before projection")
    return [
        project(
            cloth.vertices, worn.collision, beneath, options,
            stretch=worn.stretch, parts=_parts_beneath(worn, cloth, beneath),
        )
        for cloth, beneath in zip(laid, obstacles, strict=True)
    ]  # fmt: skip


def _parts_beneath(
    worn: WornGarment, cloth: LaidCloth, beneath: Sequence[Obstacle]
) -> Bool[np.ndarray, "V 6"]:
    """Parts that a layer must stay above: over other layers, and tucked in, only those that it belongs to."""
    if len(beneath) > 1:
        return cloth.parts
    return np.where(worn.tucked[:, None], cloth.parts, joined_at_hips(cloth.parts))


def relax_layer(
    worn: WornGarment,
    laid: Sequence[LaidCloth],
    cleared: Sequence[Projection],
    obstacles: Obstacles,
    *,
    allowed: float = RELAXED_STRAIN,
) -> list[Projection | None]:
    """Relax a layer in the frames that strain it, no further than it takes.

    Args:
        worn: The layer.
        laid: The layer before projection.
        cleared: Its projections.
        obstacles: What lies beneath.
        allowed: Strain (p99) that is left alone. A pose that strains a layer more may leave more, up to .28,
            and so may other cloth that most of the layer lies on, a tucked hem and armholes.

    Returns:
        What takes the place of each projection; None where nothing does.
    """
    return [
        _relaxed(worn, cloth, done, beneath, allowed)
        for cloth, done, beneath in zip(laid, cleared, obstacles, strict=True)
    ]


def _relaxed(
    worn: WornGarment, cloth: LaidCloth, done: Projection, beneath: Sequence[Obstacle], allowed: float
) -> Projection | None:
    strain = worn.elastic.strain_p99(done.vertices)
    if strain <= allowed:
        return None
    if allowed < MOST_LEFT:
        allowed = strain_left(strain, _share_on_cloth(done.vertices, cloth, beneath), allowed)
        if strain <= allowed:
            return None
    mesh = replace(worn.collision, parts=cloth.parts)
    relaxation = Relaxation(
        done.vertices, worn.elastic, mesh, beneath, limit=allowed - _LIMIT, still=worn.tucked
    )
    allowed = max(allowed, min(relaxation.least_strain(allowed), MOST_LEFT))
    if strain <= allowed:
        return None
    before = position = done.vertices
    reached = strain
    rounds = _ROUNDS if strain > _HARD[0] else 1
    for _ in range(_PASSES * _ROUNDS // rounds):
        before, position = position, relaxation.advance(position, rounds=rounds)
        reached = worn.elastic.strain_p99(position)
        if reached <= allowed:
            break
    if reached >= strain:
        return None
    # Back to where strain is just low enough: so cloth does not jump as a pose gets hard.
    back = _share_of_way(worn, position, before, allowed)
    position = position + back * (before - position)
    # Relaxing leaves cuts of tenths of a millimetre; what hardly moved needs no more lifting than before.
    fine = project(position, worn.collision, beneath, _FINE, parts=cloth.parts).vertices
    strained = min(max(allowed, worn.elastic.strain_p99(position)), max(allowed, MOST_LEFT))
    lift = _share_of_way(worn, position, fine, strained + _LIFTED)
    if before is done.vertices:
        lift *= min(4 * (1 - back), 1.0)
    return replace(done, vertices=position + lift * (fine - position))


def strain_left(strain: float, on_cloth: float, allowed: float) -> float:
    """Strain (p99) that relaxing a layer leaves; not below ``allowed``, not above that or .28.

    Args:
        strain: What it has.
        on_cloth: Share of it that lies on other cloth.
        allowed: What is asked for.
    """
    most = max(allowed, MOST_LEFT)
    share = max(_ramp(strain, *_HARD), _ramp(on_cloth, *_ON_CLOTH))
    return allowed + share * (most - allowed)


def _ramp(value: float, low: float, high: float) -> float:
    """0 up to ``low``, 1 from ``high`` on."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _share_on_cloth(
    vertices: Float[np.ndarray, "V 3"], cloth: LaidCloth, beneath: Sequence[Obstacle]
) -> float:
    """Share of a layer's vertices that lie on inner layers."""
    covered = np.zeros(len(vertices), bool)
    for layer in beneath[1:]:
        found = layer.contacts(vertices, cloth.parts, within=_THIN)
        covered |= (np.abs(found.height) < _THIN) & ~found.on_border
    return float(covered.mean())


def _share_of_way(
    worn: WornGarment, start: Float[np.ndarray, "V 3"], end: Float[np.ndarray, "V 3"], allowed: float
) -> float:
    """How far from the start to the end strain allows to go, 0 to 1; 0 where it allows nothing."""
    share, step = 0.0, 1.0
    while step > _STEP and share < 1:
        if worn.elastic.strain_p99(start + (share + step) * (end - start)) <= allowed:
            share += step
        step /= 2
    return share


@dataclass
class Calm:
    """What projection moved in one layer, smoothed over time; carried from frame to frame."""

    share: float
    """Part that the frame before has in a frame's moves, 0 to below 1."""
    options: ProjectionOptions
    moved: Float[np.ndarray, "V 3"] | None = None
    """Of the last frame, in the pelvis's frame [m]."""

    def follow(
        self,
        worn: WornGarment,
        laid: Sequence[LaidCloth],
        cleared: list[Projection],
        obstacles: Obstacles,
        world_from_pelvis: Float[np.ndarray, "T 3 3"],
        *,
        relaxed: Sequence[bool],
    ) -> Float[np.ndarray, "T V 3"]:
        """Calmed positions of the next frames [m].

        Args:
            worn: The layer.
            laid: The layer before projection.
            cleared: Its projections.
            obstacles: What lies beneath.
            world_from_pelvis: The pelvis's rotation, with which the moves turn.
            relaxed: The frames that relaxing changed: a whole projection would strain them anew.
        """
        short = replace(self.options, rounds=2, ease=0)
        result = np.empty((len(laid), *laid[0].vertices.shape))
        for t, (done, turn) in enumerate(zip(cleared, world_from_pelvis, strict=True)):
            before = laid[t].vertices
            moved = (done.vertices - before) @ turn
            if self.moved is not None:
                moved = self.share * self.moved + (1 - self.share) * moved
            self.moved = moved
            calmed = before + moved @ turn.T
            parts = _parts_beneath(worn, laid[t], obstacles[t])
            how = _FINE if relaxed[t] else short
            clear = project(calmed, worn.collision, obstacles[t], how, parts=parts).vertices
            result[t] = np.where((done.tight | done.pressed)[:, None], calmed, clear)
        return result
