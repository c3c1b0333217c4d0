"""Settings of the solver."""

from dataclasses import dataclass

from isp_assets.errors import PluginError


@dataclass(frozen=True)
class NewtonOptions:
    """How finely to simulate, and what touches what."""

    substeps: int = 8
    """Steps a frame."""
    iterations: int = 4
    """Nonlinear iterations a step."""
    linear_iterations: int = 10
    """Conjugate gradient iterations each."""
    first_settle: int = 120
    """Steps with the first pose held, before anything is kept."""
    settle: int = 60
    """Steps, at most, with a frame's pose held to reach its equilibrium."""
    still: float = 2e-3
    """Root mean square speed at which cloth counts as settled [m/s]."""
    damping: float = 0.97
    """Factor on velocities a step while settling."""
    speed_limit: float = 0.5
    """Largest speed while settling [m/s]."""
    margin: float = 0.005
    """Clearance of the vertices over the body [m]."""
    layer_margin: float = 0.004
    """Clearance between garments, and of a garment from itself [m]."""
    contact_gap: float = 0.03
    """How far off contacts are looked for [m]; a body that moves fast needs more than the default of 1 cm."""
    contact_stiffness: float = 5e3
    """Stiffness of a vertex's contact with the body [N/m]."""
    friction: float = 0.2
    gravity: float = 1.0
    """Gravity, relative to the earth's."""
    self_contact: bool = False
    """Whether one garment alone may touch itself; several garments always touch each other and themselves."""
    device: str = "cpu"

    def __post_init__(self) -> None:
        counts = (self.substeps, self.iterations, self.linear_iterations)
        if min(counts) < 1 or min(self.first_settle, self.settle) < 0:
            raise PluginError(f"newton: counts of steps must be 1 or more, settling 0 or more; got {self}")
