"""How the writers of this package publish a file: whole, or not at all."""

import os
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from isp_assets.errors import PluginError


class PartFile:
    """A file under a temporary name beside its final one.

    ``publish`` syncs it to the disk and renames it; ``discard`` removes it. As a
    context manager it discards what was not published.

    Raises:
        PluginError: If the folder of ``path`` does not exist.
    """

    def __init__(self, path: Path) -> None:
        if not path.parent.is_dir():
            raise PluginError(f"cannot write {path}: the folder {path.parent} does not exist; make it first")
        self.path = path
        self.part = path.with_name(f".{path.name}.{os.getpid()}.part")

    def open(self) -> BinaryIO:
        """The temporary file, opened for writing from its beginning."""
        return self.part.open("wb")

    def publish(self) -> None:
        """Give the finished file its name, atomically."""
        with self.part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(self.part, self.path)

    def discard(self) -> None:
        """Remove the temporary file if there is one."""
        self.part.unlink(missing_ok=True)

    def __enter__(self) -> "PartFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()
