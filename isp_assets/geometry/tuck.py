"""Tuck a garment under the garments worn over it.

The layering network and the projection move outer garments only. Where an inner
garment hangs far outside an outer one (the wide hem of a shirt worn inside trousers),
that would blow the outer one up. There the inner one gives way: it is drawn in until
it stands out by no more than ``give``, and its neighbourhood follows smoothly. Where a pose
creases both, nobody can tell from there what belongs beneath what: cloth that stands out of a
cover at rest is pressed in to where that lay, over the body.

Positions are in metres, in one shared space. NumPy, one frame and one garment at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import Closest, SurfaceNormals
from isp_assets.geometry.narrow import flatten
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.geometry.spread import keep_larger, spread

GIVE = 0.006
"""How far an inner garment may stand out of an outer one before it gives way [m]."""

_REACH = 0.12  # garments further apart than this [m] have nothing to do with one another
_RINGS, _DECAY = 24, 0.98  # rings of neighbours that follow, and how much of it: over some ten centimetres
_BORDER_RINGS = 2.0  # edges from a cover's border at which its pull is firm
_SURE = (0.3, 0.7)  # cosines between which a pull becomes firm
_OVER_BODY = 0.004  # least height over the body [m] to which hidden cloth is pressed
_SMOOTHINGS = 3  # that take out of hidden cloth what it crumpled
_EASY = 0.01  # cloth further than this [m] beneath its cover at rest needs no pressing


def tuck(
    vertices: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    covers: Sequence[Obstacle],
    body: Obstacle,
    *,
    give: float = GIVE,
) -> Float[np.ndarray, "V 3"]:
    """Draw a garment in under its covers.

    Args:
        vertices: The inner garment in this frame [m].
        mesh: Its collision data.
        covers: The garments worn over it, as they are draped before any correction.
        body: The skin in this frame; nothing is drawn in further than to it.
        give: How far it may stand out of a cover [m]; the cover is lifted by that much later.

    Returns:
        New positions [m]; the same array where nothing stands out.

    Raises:
        GeometryError: If ``give`` is negative.
    """
    if give < 0:
        raise GeometryError(f"give must be >= 0 m, got {give:g}")
    if not covers:
        return vertices
    pull, firm = np.zeros(vertices.shape), np.zeros(len(vertices))
    normals = SurfaceNormals(vertices, mesh.topology.faces).of_vertices
    for cover in covers:
        found = cover.contacts(np.ascontiguousarray(vertices, np.float64), mesh.parts, within=_REACH)
        height = np.where(found.on_border | (found.height > _REACH), 0.0, found.height)
        stands_out = (height > give)[:, None]
        # Straight inwards, not to the closest point: that one leaps as a crease goes by, the height does not.
        offered = np.where(stands_out, (give - height)[:, None] * normals, 0.0)
        towards = np.where(stands_out, (found.point - vertices) / np.maximum(height, 1e-9)[:, None], 0.0)
        firm = np.where(_longer(offered, pull), _firmness(towards, normals, cover, found), firm)
        keep_larger(pull, offered)
    if not pull.any():
        return vertices
    # Where a pull is not firm it fades into what the neighbourhood does: a vertex that slips
    # past a border or round a fold from one frame to the next must not jump.
    held = np.where((firm >= 1)[:, None], pull, 0.0)
    followed = spread(held, mesh.topology.neighbour_average, rings=_RINGS, decay=_DECAY)
    moves = firm[:, None] * pull + (1 - firm[:, None]) * followed
    index = np.flatnonzero(moves.any(axis=1))
    skin = body.contacts(np.ascontiguousarray(vertices[index], np.float64), mesh.parts[index], within=_REACH)
    size = np.maximum(np.sqrt(np.einsum("vc,vc->v", moves[index], moves[index])), 1e-9)
    moves[index] *= ((skin.height - _OVER_BODY).clip(0) / size).clip(max=1)[:, None]
    return vertices + moves


@dataclass(frozen=True, eq=False)
class Hidden:
    """Cloth that is hidden beneath covers although it has no room there at rest."""

    share: Float[np.ndarray, " V"]
    """How far each vertex is pressed: 0 not at all, 1 wholly."""
    height: Float[np.ndarray, " V"]
    """Height over the body to which it is pressed: that of its cover at rest [m]."""

    @classmethod
    def at_rest(
        cls,
        vertices: Float[np.ndarray, "V 3"],
        mesh: CollisionMesh,
        covers: Sequence[Obstacle],
        body: Obstacle,
    ) -> "Hidden":
        """Find what stands out of its covers, and how high these lie.

        Args:
            vertices: The inner garment at rest on the body [m].
            mesh: Its collision data.
            covers: The garments worn over it, in the same pose.
            body: The skin, in the same pose.
        """
        points = np.ascontiguousarray(vertices, np.float64)
        share, height = np.zeros(len(points)), np.full(len(points), _OVER_BODY)
        above = body.contacts(points, mesh.parts, within=_REACH).height
        normals = SurfaceNormals(points, mesh.topology.faces).of_vertices
        for cover in covers:
            found = cover.contacts(points, mesh.parts, within=_REACH)
            near = ~found.on_border & (np.abs(found.height) < _REACH) & np.isfinite(above)
            alike = np.einsum("vc,vc->v", normals, found.normal)
            crowded = (1 + np.where(near, found.height, -np.inf) / _EASY).clip(0, 1)
            here = _inside(cover, found) * _sure(alike) * crowded
            lower = np.where(near, above - found.height, 0.0).clip(_OVER_BODY)
            height = np.where(here > share, lower, height)
            share = np.maximum(share, here)
        return cls(share, height)


def press(
    vertices: Float[np.ndarray, "V 3"], mesh: CollisionMesh, hidden: Hidden, body: Obstacle
) -> Float[np.ndarray, "V 3"]:
    """Draw hidden cloth in to where its cover lies at rest, and smooth it.

    Args:
        vertices: The garment in this frame [m].
        mesh: Its collision data.
        hidden: Which of its cloth is hidden.
        body: The skin in this frame.

    Returns:
        New positions [m]; the same array where nothing is hidden.
    """
    index = np.flatnonzero(hidden.share)
    if len(index) == 0:
        return vertices
    points = np.ascontiguousarray(vertices[index], np.float64)
    found = body.contacts(points, mesh.parts[index], within=_REACH)
    above = np.isfinite(found.height) & (found.height > hidden.height[index])
    way = hidden.share[index] * (1 - hidden.height[index] / np.where(above, found.height, 1.0))
    result = vertices.copy()
    result[index] += np.where(above[:, None], way[:, None] * (found.point - points), 0.0)
    for _ in range(_SMOOTHINGS):
        result += flatten(result, mesh, hidden.share, fade=0.0)
    return result


def _firmness(
    towards: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"], cover: Obstacle, found: Closest
) -> Float[np.ndarray, " V"]:
    """0 to 1: how sure it is that a vertex belongs beneath the cover.

    It is sure inside the cover's border, where both cloths face the same way and the cover
    lies straight inwards. In the folds of an armpit none of this holds.
    """
    alike = np.einsum("vc,vc->v", normals, found.normal)
    inwards = -np.einsum("vc,vc->v", normals, towards)
    return _inside(cover, found) * _sure(np.minimum(alike, inwards))


def _inside(cover: Obstacle, found: Closest) -> Float[np.ndarray, " V"]:
    """0 on the cover's border, 1 well inside."""
    return (cover.border_rings_at(found) / _BORDER_RINGS).clip(0, 1)


def _sure(cosine: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """0 where directions differ, 1 where they agree."""
    low, high = _SURE
    return ((cosine - low) / (high - low)).clip(0, 1)


def _longer(first: Float[np.ndarray, "V 3"], second: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
    return np.einsum("vc,vc->v", first, first) > np.einsum("vc,vc->v", second, second)
