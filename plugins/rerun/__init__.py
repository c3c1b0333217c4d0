"""A rerun recording of a shot, for review: body, layers, and the measured figures over time."""

from .writer import RerunWriter

WRITER = RerunWriter

__all__ = ["WRITER", "RerunWriter"]
