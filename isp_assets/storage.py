"""Our own files: named tensors and a JSON manifest in one safetensors file.

Nothing in such a file is executed on load. Writing is atomic (a temporary name,
then a rename) and deterministic: the same content gives the same bytes.
"""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import save as to_bytes

from isp_assets.errors import BundleError
from isp_assets.files import published

Manifest = dict[str, Any]
Tensors = dict[str, torch.Tensor]
Upgrade = Callable[[Manifest, Tensors], tuple[Manifest, Tensors]]
"""Turns the content of one version into that of the next."""

_KEY = "isp-assets"


def save_tensors(
    path: str | os.PathLike, tensors: Mapping[str, torch.Tensor], manifest: Mapping[str, Any], *,
    schema: str, version: int,
) -> None:  # fmt: skip
    """Write tensors and a manifest.

    Args:
        path: The file to write; its folder is made if need be.
        tensors: What to store; stored on the CPU, at their own dtype.
        manifest: Plain JSON values; NaN and infinity are refused.
        schema: Name of the kind of file, as in "isp-assets/garments".
        version: Version of that kind.

    Raises:
        BundleError: If the manifest holds what JSON cannot keep.
    """
    try:
        content = {**manifest, "schema": schema, "version": version}
        text = json.dumps(content, sort_keys=True, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise BundleError(f"{path}: the manifest holds a value that JSON cannot keep: {error}") from error
    plain = {name: tensors[name].detach().cpu().contiguous().clone() for name in sorted(tensors)}
    with published(Path(path)) as temporary:
        temporary.write_bytes(to_bytes(plain, metadata={_KEY: text}))


def load_tensors(
    path: str | os.PathLike, *, schema: str, version: int, upgrades: Mapping[int, Upgrade] | None = None
) -> tuple[Tensors, Manifest]:
    """Read a file that ``save_tensors`` wrote.

    Args:
        path: The file.
        schema: The kind of file expected.
        version: The version this code knows; older files go through ``upgrades``.
        upgrades: By version, the step from that version to the next.

    Raises:
        BundleError: If the file is missing, damaged, of another kind, or too new.
    """
    path = Path(path)
    if not path.is_file():
        raise BundleError(f"{path}: no such file; expected a file of kind {schema!r}")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(_KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (safetensors.SafetensorError, OSError) as error:
        raise BundleError(
            f"{path}: not a readable safetensors file ({error}); copy or train it again"
        ) from error
    if text is None:
        raise BundleError(f"{path}: a safetensors file without our manifest; expected kind {schema!r}")
    try:
        manifest = json.loads(text)
    except ValueError as error:
        raise BundleError(f"{path}: the manifest is not JSON ({error}); the file is damaged") from error
    _check_kind(path, manifest, schema, version)
    for old in range(manifest["version"], version):
        if upgrades is None or old not in upgrades:
            raise BundleError(f"{path}: version {old} of {schema!r} cannot be upgraded; train it again")
        manifest, tensors = upgrades[old](manifest, tensors)
        manifest["version"] = old + 1
    return tensors, manifest


def _check_kind(path: Path, manifest: Any, schema: str, version: int) -> None:
    if not isinstance(manifest, dict) or not isinstance(manifest.get("version"), int):
        raise BundleError(f"{path}: the manifest names no schema and version; the file is damaged")
    if manifest.get("schema") != schema:
        raise BundleError(f"{path}: expected a file of kind {schema!r}, got {manifest.get('schema')!r}")
    if not 1 <= manifest["version"] <= version:
        raise BundleError(
            f"{path}: version {manifest['version']} of {schema!r} is not known; "
            f"this release reads 1..{version}; upgrade isp-assets"
        )
