"""Contact sheet: a few frames of a shot from three sides in one PNG, drawn without a display."""

from .camera import Camera
from .render import RenderMesh, render_view
from .writer import SheetWriter

WRITER = SheetWriter

__all__ = ["WRITER", "Camera", "RenderMesh", "SheetWriter", "render_view"]
