"""How writers plug in: the protocol they implement, and how they are found.

A plugin is a class with the attributes of `ShotWriter`, registered under the
entry point group ``isp_assets.writers``, or defined as ``WRITER`` in a Python
file of a folder listed in ``ISP_ASSETS_PLUGIN_PATH``. A broken plugin never
stops the others: it is reported with its error.
"""

import importlib.util
import os
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from isp_assets.errors import PluginError
from isp_assets.frames import FrameChunk, Scene

GROUP = "isp_assets.writers"
PATH_VARIABLE = "ISP_ASSETS_PLUGIN_PATH"


@runtime_checkable
class ShotWriter(Protocol):
    """Writes one shot to one file, chunk by chunk.

    Life cycle: ``begin`` once, ``add`` per chunk in frame order, then ``finish``;
    or ``abort`` at any point. Nothing exists at ``path`` before ``finish`` has
    published the whole file by an atomic rename; ``abort`` leaves no trace.
    """

    name: str
    """Short name, as in ``--write usd``."""
    suffix: str
    """File suffix with its dot, as in ``.usdc``."""
    version: str
    """Version of the file library behind it, shown by ``isp-assets plugins``."""

    def begin(self, path: Path, scene: Scene) -> None: ...

    def add(self, chunk: FrameChunk) -> None: ...

    def finish(self) -> None: ...

    def abort(self) -> None: ...


@dataclass(frozen=True)
class FoundPlugin:
    """A writer class that was found, or the reason why it cannot be used."""

    name: str
    origin: str
    version: str
    error: str | None = None
    writer: type[Any] | None = None


def find_writers() -> dict[str, FoundPlugin]:
    """All writers by name: installed entry points first, then ``ISP_ASSETS_PLUGIN_PATH``."""
    found: dict[str, FoundPlugin] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda p: p.name):
        found[point.name] = _load_entry_point(point)
    for folder in filter(None, os.environ.get(PATH_VARIABLE, "").split(os.pathsep)):
        for file in sorted(Path(folder).glob("*.py")):
            plugin = _load_file(file)
            found[plugin.name] = plugin
    return found


def make_writer(name: str) -> ShotWriter:
    """A fresh writer by name.

    Raises:
        PluginError: If no plugin of that name is found, or it is broken.
    """
    found = find_writers()
    if name not in found:
        raise PluginError(f"no writer plugin named {name!r}; found: {', '.join(sorted(found)) or 'none'}")
    plugin = found[name]
    if plugin.writer is None:
        raise PluginError(f"writer plugin {name!r} from {plugin.origin} is broken: {plugin.error}")
    return plugin.writer()


def _load_entry_point(point: EntryPoint) -> FoundPlugin:
    origin = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
    try:
        return _checked(point.name, origin, point.load())
    except Exception as error:  # a foreign plugin may fail in any way; the others must still work
        return FoundPlugin(point.name, origin, "?", error=f"{type(error).__name__}: {error}")


def _load_file(file: Path) -> FoundPlugin:
    try:
        spec = importlib.util.spec_from_file_location(f"isp_assets_local_plugin_{file.stem}", file)
        if spec is None or spec.loader is None:
            raise ImportError("not a Python module")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return _checked(file.stem, str(file), module.WRITER)
    except Exception as error:  # see above
        return FoundPlugin(file.stem, str(file), "?", error=f"{type(error).__name__}: {error}")


def _checked(name: str, origin: str, writer: Any) -> FoundPlugin:
    missing = [
        m for m in ("name", "suffix", "version", "begin", "add", "finish", "abort") if not hasattr(writer, m)
    ]
    if missing:
        raise TypeError(f"{writer!r} lacks {', '.join(missing)}; see ShotWriter")
    return FoundPlugin(getattr(writer, "name", name), origin, writer.version, writer=writer)
