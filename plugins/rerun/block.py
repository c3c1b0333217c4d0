"""Consecutive frames in transit: positions, and the scalar figures of every frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from isp_assets.frames import FrameChunk


@dataclass(frozen=True, eq=False)
class Block:
    """T consecutive frames."""

    frames: Int[np.ndarray, " T"]
    meshes: tuple[Float[np.ndarray, "T _ 3"], ...]
    """Body first, then the layers from the inside out [m]."""
    figures: tuple[dict[str, float], ...]
    """Per frame: the measured metrics, and ``seconds/<stage>`` for the time it took."""

    @classmethod
    def of_chunk(cls, chunk: FrameChunk) -> "Block":
        """A copy of a chunk, its stage times shared evenly among its frames."""
        count = len(chunk.frames)
        times = {f"{stage}/ms_per_frame": 1e3 * s / count for stage, s in chunk.times.seconds.items()}
        metrics: Sequence[dict[str, float]] = chunk.metrics or [{}] * count
        meshes = tuple(np.array(vertices, np.float32) for vertices in (chunk.body, *chunk.layers))
        return cls(chunk.frames.copy(), meshes, tuple({**figures, **times} for figures in metrics))

    @classmethod
    def joined(cls, blocks: Sequence["Block"]) -> "Block":
        """Blocks one after the other."""
        meshes = tuple(np.concatenate(parts) for parts in zip(*(b.meshes for b in blocks), strict=True))
        figures = tuple(figures for block in blocks for figures in block.figures)
        return cls(np.concatenate([block.frames for block in blocks]), meshes, figures)

    def part(self, start: int, end: int) -> "Block":
        """Frames ``start`` to ``end - 1``, counted within the block."""
        meshes = tuple(vertices[start:end] for vertices in self.meshes)
        return Block(self.frames[start:end], meshes, self.figures[start:end])
