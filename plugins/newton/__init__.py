"""Physics reference: garments draped by Newton's Style3D cloth solver."""

from .solver import NewtonOptions, NewtonSolver

__all__ = ["NewtonOptions", "NewtonSolver"]
