"""The rules of a shot's USD file, one function each.

A rule takes the stage and gives (prim path, message) for each thing that is
wrong. It skips what another rule reports, so that one fault gives one finding.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from pxr import Ar, Sdf, Usd, UsdGeom, UsdShade

from isp_assets.conventions import METRES_PER_UNIT, PANELS, UP_AXIS

Findings = Iterator[tuple[str, str]]

_SLACK = 1e-6
"""How far a point may leave its extent [m]: rounding of foreign tools."""
_MAX_SIZE = 20.0
"""A dressed body larger than this is not in metres [m]."""
_MIN_SIZE = 0.05


def units(stage: Usd.Stage) -> Findings:
    """Metres, Y up, a default prim, and a figure of human size."""
    if stage.GetDefaultPrim() is None or not stage.GetDefaultPrim():
        yield "/", "no default prim"
    if UsdGeom.GetStageUpAxis(stage) != UP_AXIS:
        yield "/", f"up axis must be {UP_AXIS}, got {UsdGeom.GetStageUpAxis(stage)}"
    if not math.isclose(UsdGeom.GetStageMetersPerUnit(stage), METRES_PER_UNIT):
        yield "/", f"metersPerUnit must be {METRES_PER_UNIT:g}, got {UsdGeom.GetStageMetersPerUnit(stage):g}"
    for mesh in _meshes(stage):
        points = _array(mesh.GetPointsAttr(), _first(mesh))
        size = float(np.ptp(points, axis=0).max()) if len(points) and np.isfinite(points).all() else 1.0
        if not _MIN_SIZE < size < _MAX_SIZE:
            yield str(mesh.GetPath()), f"is {size:.3g} units across; are the points in metres?"


def frames(stage: Usd.Stage) -> Findings:
    """Time codes are frame numbers, and every mesh has the same ones, from start to end."""
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if not stage.HasAuthoredTimeCodeRange() or start > end:
        yield "/", f"time code range must be authored and ordered, got {start:g}..{end:g}"
        return
    if stage.GetTimeCodesPerSecond() != stage.GetFramesPerSecond():
        rates = stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()
        yield "/", f"timeCodesPerSecond and framesPerSecond must be equal, got {rates}"
    common: list[float] | None = None
    for mesh in _meshes(stage):
        codes = mesh.GetPointsAttr().GetTimeSamples()
        common = codes if common is None else common
        if not codes or (codes[0], codes[-1]) != (start, end):
            got = f"{codes[0]:g}..{codes[-1]:g}" if codes else "no time samples"
            yield str(mesh.GetPath()), f"points must run from {start:g} to {end:g}, got {got}"
        elif any(code != round(code) for code in codes):
            yield str(mesh.GetPath()), "points have samples between whole frames"
        elif codes != common:
            yield str(mesh.GetPath()), "points have samples at other frames than the first mesh"
        for attribute in (mesh.GetExtentAttr(), mesh.GetNormalsAttr()):
            if attribute.GetTimeSamples() != codes:
                yield (
                    str(mesh.GetPath()),
                    f"{attribute.GetName()} and points have samples at different frames",
                )


def sizes(stage: Usd.Stage) -> Findings:
    """Arrays fit each other in every frame."""
    for mesh in _meshes(stage):
        path = str(mesh.GetPath())
        counts, indices = (
            _array(a) for a in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
        )
        if counts.sum() != len(indices):
            yield (
                path,
                f"faceVertexCounts add up to {counts.sum()}, but there are {len(indices)} faceVertexIndices",
            )
        numbers = {len(_array(mesh.GetPointsAttr(), t)) for t in _samples(mesh)}
        if len(numbers) != 1:
            yield path, f"the number of points changes over time: {sorted(numbers)}"
            continue
        count = numbers.pop()
        if len(indices) and (indices.min() < 0 or indices.max() >= count):
            yield path, f"faceVertexIndices must lie in 0..{count - 1}, got {indices.min()}..{indices.max()}"
        if {len(_array(mesh.GetNormalsAttr(), t)) for t in _samples(mesh)} != {count}:
            yield path, f"there must be one normal a point ({count}) in every frame"
        st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        if st and len(st.ComputeFlattened() or ()) != len(indices):
            yield (
                path,
                f"primvars:st must have one value a face corner ({len(indices)}), with indices in range",
            )


def finite(stage: Usd.Stage) -> Findings:
    """No NaN and no infinity."""
    for mesh in _meshes(stage):
        for attribute in (mesh.GetPointsAttr(), mesh.GetNormalsAttr()):
            bad = [t for t in _samples(mesh) if not np.isfinite(_array(attribute, t)).all()]
            if bad:
                yield (
                    str(mesh.GetPath()),
                    f"{attribute.GetName()} hold NaN or infinity in {len(bad)} frames, first {bad[0]:g}",
                )


def extent(stage: Usd.Stage) -> Findings:
    """Every frame's extent holds every point, and is no larger than needed by more than a centimetre."""
    for mesh in _meshes(stage):
        for t in _samples(mesh):
            box, points = _array(mesh.GetExtentAttr(), t), _array(mesh.GetPointsAttr(), t)
            if not len(points) or not np.isfinite(points).all():
                continue
            tight = np.stack([points.min(0), points.max(0)])
            slack = (tight - box) * [[1], [-1]] if box.shape == (2, 3) else np.full((2, 3), -1.0)
            if slack.min() < -_SLACK or slack.max() > 0.01:
                yield str(mesh.GetPath()), f"extent at {t:g} must be {tight.tolist()}, got {box.tolist()}"
                break


def winding(stage: Usd.Stage) -> Findings:
    """Neighbouring faces run the same way round, outward, and the normals agree with them."""
    for mesh in _meshes(stage):
        if mesh.GetOrientationAttr().Get() != UsdGeom.Tokens.rightHanded:
            yield str(mesh.GetPath()), "orientation must be rightHanded"
        points, normals = (_array(a, _first(mesh)) for a in (mesh.GetPointsAttr(), mesh.GetNormalsAttr()))
        faces = _triangles(mesh, len(points))
        if faces is None or not np.isfinite(points).all():
            continue
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        _, uses = np.unique(edges @ [len(points), 1], return_counts=True)
        if (uses > 1).any():
            yield (
                str(mesh.GetPath()),
                f"{int((uses > 1).sum())} edges run the same way in two faces: faces are flipped",
            )
            continue
        a, b, c = (points[corner].astype(float) for corner in faces.T)
        area = np.cross(b - a, c - a)
        centre = (a + b + c) / 3
        if np.sum((centre - centre.mean(0)) * area) < 0:
            yield str(mesh.GetPath()), "faces point inward"
        elif len(normals) == len(points) and np.einsum("fi,fki->", area, normals[faces]) < 0:
            yield str(mesh.GetPath()), "normals point against the faces"


def panels(stage: Usd.Stage) -> Findings:
    """Each garment's faces are split into the front and the back panel, with nothing left over or doubled."""
    for mesh in _meshes(stage):
        if not UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st"):
            continue  # the body has no pattern
        subsets = UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face, "panel")
        names = tuple(s.GetPrim().GetName() for s in subsets)
        if names != PANELS:
            yield str(mesh.GetPath()), f"family 'panel' must have the subsets {PANELS}, got {names}"
            continue
        chosen = np.sort(np.concatenate([_array(s.GetIndicesAttr()) for s in subsets]))
        if not np.array_equal(chosen, np.arange(len(_array(mesh.GetFaceVertexCountsAttr())))):
            yield str(mesh.GetPath()), "the panels must hold every face once"


def textures(stage: Usd.Stage) -> Findings:
    """Images are named by relative paths, and exist."""
    for prim in stage.Traverse():
        shader = UsdShade.Shader(prim)
        if not shader or shader.GetIdAttr().Get() != "UsdUVTexture":
            continue
        asset = shader.GetInput("file").Get() if shader.GetInput("file") else None
        name = asset.path if isinstance(asset, Sdf.AssetPath) else ""
        if not name or Path(name).is_absolute() or "\\" in name:
            yield (
                str(prim.GetPath()),
                f"the image must have a relative path with forward slashes, got {name!r}",
            )
        elif not Ar.GetResolver().Resolve(stage.GetRootLayer().ComputeAbsolutePath(name)):
            yield str(prim.GetPath()), f"the image {name!r} is missing"


RULES: dict[str, Callable[[Usd.Stage], Findings]] = {
    rule.__name__: rule for rule in (units, frames, sizes, finite, extent, winding, panels, textures)
}


def _meshes(stage: Usd.Stage) -> list[UsdGeom.Mesh]:
    return [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def _samples(mesh: UsdGeom.Mesh) -> list[float]:
    return mesh.GetPointsAttr().GetTimeSamples() or [Usd.TimeCode.EarliestTime().GetValue()]


def _first(mesh: UsdGeom.Mesh) -> float:
    return _samples(mesh)[0]


def _array(
    attribute: Usd.Attribute, time: float | None = None
) -> Float[np.ndarray, "..."] | Int[np.ndarray, "..."]:
    value = attribute.Get() if time is None else attribute.Get(time)
    return np.zeros((0, 3), np.float32) if value is None else np.asarray(value)


def _triangles(mesh: UsdGeom.Mesh, num_points: int) -> Int[np.ndarray, "F 3"] | None:
    """The faces, or None where another rule already complains or faces are no triangles."""
    counts, indices = (_array(a) for a in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()))
    if (counts != 3).any() or len(indices) != 3 * len(counts) or not len(counts):
        return None
    return indices.reshape(-1, 3) if indices.min() >= 0 and indices.max() < num_points else None
