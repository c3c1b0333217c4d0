"""Contact sheet: a few frames of a shot from three sides in one PNG, drawn without a display."""

from .camera import Camera
from .render import RenderMesh, render_view
from .writer import SheetStyle, SheetWriter

WRITER = SheetWriter

__all__ = ["WRITER", "Camera", "RenderMesh", "SheetStyle", "SheetWriter", "render_view"]
