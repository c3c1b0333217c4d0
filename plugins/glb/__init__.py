"""Animated GLB: one morph target a frame, textures embedded, played by any glTF 2.0 viewer."""

from .writer import GlbWriter, PackedGlbWriter

WRITER = GlbWriter

__all__ = ["WRITER", "GlbWriter", "PackedGlbWriter"]
