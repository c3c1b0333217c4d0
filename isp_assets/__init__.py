"""Implicit sewing patterns for asset pipelines: garments as codes, draped in layers over SMPL motion."""

__version__ = "0.1.0"
