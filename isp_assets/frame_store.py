"""Chunks of a shot that are finished, kept on disk, so that a job that was cut off can go on.

A folder ``NAME.frames`` beside the job's files holds ``key.txt``, the digest of all that the frames
depend on, and one ``.npz`` a chunk: arrays and a JSON text, nothing pickled. It is removed
when the job ends well.
"""

import hashlib
import json
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import isp_assets
from isp_assets.drape import DrapeOptions
from isp_assets.errors import ShotError
from isp_assets.files import published, write_text
from isp_assets.frames import DrapedFrames, FrameChunk, StageTimes
from isp_assets.shot import ShotJob

_KEY = "key.txt"


class FrameStore:
    """The kept chunks of one job, by the row of their first frame.

    Args:
        folder: Made when the first chunk is kept.
        key: Digest of the job; see `job_key`.
        resume: Go on from what the folder holds; otherwise that is removed.

    Raises:
        ShotError: If the folder is to be resumed but holds frames of another job.
    """

    def __init__(self, folder: Path, key: str, *, resume: bool) -> None:
        self.folder, self.key = folder, key
        self.finished: set[int] = set()
        if not resume:
            self.clear()
        elif (folder / _KEY).is_file():
            if (folder / _KEY).read_text() != key:
                raise ShotError(
                    f"{folder}: the kept frames are of another job: its garments, body, motion, options or "
                    "the version of isp-assets were others; leave --resume out to start over"
                )
            self.finished = {int(path.stem) for path in folder.glob("*.npz") if path.stem.isdigit()}

    def complete(self, draped: DrapedFrames, rows: Sequence[slice]) -> DrapedFrames:
        """All chunks of a shot in order: kept ones as they are, the others as they are draped, and kept.

        Args:
            draped: The chunks that are not kept yet.
            rows: Rows of all chunks.
        """
        return DrapedFrames(draped.scene, self._in_order(iter(draped), rows))

    def _in_order(self, draped: Iterator[FrameChunk], rows: Sequence[slice]) -> Iterator[FrameChunk]:
        for part in rows:
            if part.start in self.finished:
                yield self.load(part.start)
            else:
                chunk = next(draped)
                self.save(part.start, chunk)
                yield chunk
        yield from draped  # nothing more, but lets it end

    def save(self, first: int, chunk: FrameChunk) -> None:
        """Keep a chunk; earlier rungs of the ladder are not kept."""
        if not self.finished:
            write_text(self.folder / _KEY, self.key)
        notes = {"seconds": chunk.times.seconds, "steps": chunk.steps, "metrics": chunk.metrics}
        arrays: dict[str, Any] = {f"layer_{index}": layer for index, layer in enumerate(chunk.layers)}
        with published(self.folder / f"{first:08d}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, frames=chunk.frames, body=chunk.body, notes=np.array(json.dumps(notes)), **arrays)
        self.finished.add(first)

    def load(self, first: int) -> FrameChunk:
        """A kept chunk.

        Raises:
            ShotError: If its file is damaged.
        """
        path = self.folder / f"{first:08d}.npz"
        try:
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            notes = json.loads(str(arrays["notes"]))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ShotError(
                f"{path}: kept frames are damaged ({error}); remove the file, or leave --resume out"
            ) from error
        count = sum(name.startswith("layer_") for name in arrays)
        return FrameChunk(
            frames=arrays["frames"],
            body=arrays["body"],
            layers=tuple(arrays[f"layer_{index}"] for index in range(count)),
            times=StageTimes(notes["seconds"]),
            steps=tuple(tuple(tuple(layer) for layer in frame) for frame in notes["steps"]),
            metrics=tuple(notes["metrics"]),
        )

    def clear(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def job_key(job: ShotJob, options: DrapeOptions, **others: Any) -> str:
    """SHA-256 of all that the frames of a job depend on.

    Args:
        job: Garments, body and motion.
        options: How they are draped.
        others: What else must be the same; plain JSON values.
    """
    shot, outfit, digest = job.shot, job.outfit, hashlib.sha256()
    plain = {
        "version": isp_assets.__version__, "name": shot.name, "body": shot.body.sha256,
        "resolution": job.resolution, "options": asdict(options), "garments": [i.name for i in outfit],
        "fps": shot.motion.fps, **others,
    }  # fmt: skip
    digest.update(json.dumps(plain, sort_keys=True).encode())
    motion = shot.motion
    for array in (motion.poses, motion.translation, motion.frames, shot.betas, *(i.code for i in outfit)):
        digest.update(np.ascontiguousarray(array).tobytes())
    networks: list[Any] = [outfit.skin.skin_field]
    for bundle in {item.bundle.category: item.bundle for item in outfit}.values():
        networks += [*bundle.model.panel_fields.values(), *bundle.model.atlases.values()]
        networks += [bundle.drape_field] if bundle.drape_field is not None else []
    networks += [outfit.layering.layering_net] if outfit.layering is not None else []
    for network in networks:
        for value in network.state_dict().values():
            digest.update(value.cpu().numpy().tobytes())
    return digest.hexdigest()
