"""A collection: a folder of latent bundles, and the garments they hold by name.

``collection.toml`` names the files and says how each garment's cloth looks::

    schema = "isp-assets/collection"
    version = 1
    name = "basics"
    body_sha256 = "..."
    skin = "skin.safetensors"
    layering = "layering.safetensors"

    [garments.tank_top]
    bundle = "top.safetensors"
    code = "tank_top"
    color = "#e8e4da"
    fabric = "knit"
"""

import difflib
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
from isp_assets.code_file import GarmentCode
from isp_assets.errors import BundleError, CollectionError, InputError
from isp_assets.fabric_style import FabricStyle
from isp_assets.files import write_text
from isp_assets.outfit import Outfit, OutfitItem
from isp_assets.toml_file import check_keys, read_toml

SCHEMA = "isp-assets/collection"
VERSION = 1
FILE_NAME = "collection.toml"
DEFAULT_FOLDER = Path(__file__).parent / "data" / "collection"

_KEYS = {
    "schema": str, "version": int, "name": str, "body_sha256": str, "skin": str, "layering": str,
    "garments": dict,
}  # fmt: skip
_GARMENT_KEYS = {
    "bundle": str, "code": str, "color": str, "fabric": str, "accent": str, "scale": (int, float),
    "about": str,
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """One garment as the collection lists it."""

    name: str
    bundle: str
    """File name of the bundle, in the collection's folder."""
    code: str
    """Row of the bundle's code table."""
    style: FabricStyle
    about: str


@dataclass(frozen=True, eq=False)
class Collection:
    """Garments by name. Bundles are read when first needed, then kept."""

    folder: Path
    name: str
    body_sha256: str
    entries: dict[str, Entry]
    skin_file: str
    layering_file: str | None

    @classmethod
    def load(cls, source: str | Path = "default") -> "Collection":
        """Read ``collection.toml`` of a folder; ``"default"`` is the built-in collection.

        Raises:
            CollectionError: If the folder or a file is missing, or an entry is wrong.
        """
        folder = DEFAULT_FOLDER if source == "default" else Path(source)
        path = folder / FILE_NAME
        table = read_toml(path, CollectionError)
        _check_head(table, path)
        entries = {name: _entry(name, row, path) for name, row in table["garments"].items()}
        for file in {
            table["skin"],
            table.get("layering", table["skin"]),
            *(e.bundle for e in entries.values()),
        }:
            if Path(file).name != file:
                raise CollectionError(f"{path}: names the file {file!r}; expected one in the folder itself")
            if not (folder / file).is_file():
                raise CollectionError(f"{path}: names the file {file!r}, which is not in {folder}")
        return cls(folder, table["name"], table["body_sha256"], entries, table["skin"], table.get("layering"))

    def names(self) -> tuple[str, ...]:
        """Names of the garments, in the file's order."""
        return tuple(self.entries)

    def entry(self, name: str) -> Entry:
        """One entry by name.

        Raises:
            CollectionError: If there is no such garment; the message names the nearest ones.
        """
        if name not in self.entries:
            near = difflib.get_close_matches(name, self.entries, n=3)
            hint = (
                f"did you mean {' or '.join(map(repr, near))}?"
                if near
                else f"it has: {', '.join(self.entries)}"
            )
            raise CollectionError(f"collection {self.name!r} has no garment {name!r}; {hint}")
        return self.entries[name]

    def bundle(self, file: str) -> GarmentBundle:
        """The bundle of one file, checked against the collection's body."""
        if file not in self._bundles:
            bundle = GarmentBundle.load(self.folder / file)
            self._check_body(file, bundle.body_sha256)
            self._bundles[file] = bundle
        return self._bundles[file]

    @cached_property
    def skin(self) -> SkinBundle:
        """The diffused skinning field that all garments share."""
        skin = SkinBundle.load(self.folder / self.skin_file)
        self._check_body(self.skin_file, skin.body_sha256)
        return skin

    @cached_property
    def layering(self) -> LayeringBundle | None:
        """The layering network, if the collection has one."""
        return LayeringBundle.load(self.folder / self.layering_file) if self.layering_file else None

    def item(self, name: str) -> OutfitItem:
        """One garment, ready to be worn."""
        entry = self.entry(name)
        bundle = self.bundle(entry.bundle)
        if entry.code not in bundle.codes:
            raise CollectionError(
                f"collection {self.name!r}: garment {name!r} names the code {entry.code!r}, "
                f"which bundle {entry.bundle!r} does not hold"
            )
        return OutfitItem(name, bundle, bundle.codes[entry.code], entry.style)

    def outfit(self, names: Sequence[str]) -> Outfit:
        """An outfit of named garments, innermost first.

        Raises:
            CollectionError: If a garment is not in the collection.
            OutfitError: If the list is empty or the parts do not belong together.
        """
        return Outfit(tuple(self.item(n) for n in names), self.skin, self.layering)

    def bundle_files(self) -> tuple[str, ...]:
        """Names of the bundle files, each once."""
        return tuple(dict.fromkeys(entry.bundle for entry in self.entries.values()))

    def add(self, garment: GarmentCode, *, color: str = "#8f8f8f", fabric: str = "plain") -> "Collection":
        """Add a garment to the folder: its code to the bundle of its category, its entry to the list.

        Args:
            garment: Found with the networks of that bundle.
            color: Of the cloth, as in ``collection.toml``.
            fabric: Kind of the cloth, as in ``collection.toml``.

        Returns:
            The collection as it is now. Both files are replaced whole; should the second fail,
            the bundle holds a code that no entry names, and adding the garment again completes it.

        Raises:
            CollectionError: If the collection is the built-in one, has no bundle of the category,
                or has a garment of that name.
            BundleError: If the code belongs to other networks, or its name is taken.
        """
        path = self.folder / FILE_NAME
        if self.folder.resolve() == DEFAULT_FOLDER.resolve():
            raise CollectionError("the built-in collection is not changed; copy it, and add to the copy")
        self.check_new_name(garment.name)
        files = [file for file in self.bundle_files() if self.bundle(file).category == garment.category]
        if not files:
            raise CollectionError(f"{path}: no bundle of category {garment.category!r} to add the garment to")
        found = [file for file in files if self.bundle(file).model_sha256 == garment.model_sha256]
        if not found:
            raise BundleError(
                f"{self.folder / files[0]}: the code of {garment.name!r} was found with other networks; "
                "fit it with this collection"
            )
        bundle = self.bundle(found[0])
        FabricStyle.from_text(color=color, kind=fabric)
        lines = [f"[garments.{garment.name}]", f'bundle = "{found[0]}"', f'color = "{color}"']
        text = (
            path.read_text(encoding="utf-8").rstrip()
            + "\n\n"
            + "\n".join([*lines, f'fabric = "{fabric}"', ""])
        )
        if not np.array_equal(bundle.codes.get(garment.name, np.empty(0)), garment.code):
            bundle.with_code(garment.name, garment.code).save(self.folder / found[0])
        write_text(path, text)
        return Collection.load(self.folder)

    def check_new_name(self, name: str) -> None:
        """Whether a further garment may have a name.

        Raises:
            CollectionError: If the name is taken, or holds anything but letters, digits, _ and -.
        """
        path = self.folder / FILE_NAME
        if name in self.entries:
            raise CollectionError(f"{path}: has a garment {name!r} already; choose another name")
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise CollectionError(
                f"{path}: a garment's name is made of letters, digits, _ and -, got {name!r}; choose another"
            )

    def copy_to(self, folder: str | Path) -> "Collection":
        """Copy the collection's files into a new folder.

        Raises:
            CollectionError: If the folder exists.
        """
        folder = Path(folder)
        if folder.exists():
            raise CollectionError(f"{folder} exists; a collection is copied into a new folder")
        partial = folder.with_name(f".{folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        try:
            files = {FILE_NAME, self.skin_file, *self.bundle_files()}
            for file in files | ({self.layering_file} if self.layering_file else set()):
                shutil.copyfile(self.folder / file, partial / file)
            partial.rename(folder)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        return Collection.load(folder)

    @cached_property
    def _bundles(self) -> dict[str, GarmentBundle]:
        return {}

    def _check_body(self, file: str, sha256: str) -> None:
        if sha256 != self.body_sha256:
            raise CollectionError(
                f"{self.folder / file}: trained on body {sha256[:12]}, but collection {self.name!r} "
                f"is for body {self.body_sha256[:12]}; "
                "put the bundle into a collection of its own body, or retrain it"
            )


def _check_head(table: dict[str, Any], path: Path) -> None:
    check_keys(
        table,
        _KEYS,
        {"schema", "version", "name", "body_sha256", "skin", "garments"},
        str(path),
        CollectionError,
    )
    if table["schema"] != SCHEMA:
        raise CollectionError(f"{path}: schema must be {SCHEMA!r}, got {table['schema']!r}")
    if table["version"] != VERSION:
        raise CollectionError(
            f"{path}: version {table['version']} is not known here, only {VERSION}; update isp-assets"
        )
    if not table["garments"]:
        raise CollectionError(f"{path}: the collection lists no garments")


def _entry(name: str, row: object, path: Path) -> Entry:
    where = f"{path}: garment {name!r}"
    if not isinstance(row, dict):
        raise CollectionError(f"{where}: must be a table, got {type(row).__name__}")
    check_keys(row, _GARMENT_KEYS, {"bundle", "color"}, where, CollectionError)
    style = {
        "color": row.get("color"),
        "kind": row.get("fabric"),
        "accent": row.get("accent"),
        "scale": row.get("scale"),
    }
    try:
        fabric = FabricStyle.from_text(**{k: v for k, v in style.items() if v is not None})
    except InputError as cause:
        raise CollectionError(f"{where}: {cause}") from cause
    return Entry(name, row["bundle"], row.get("code", name), fabric, row.get("about", ""))
