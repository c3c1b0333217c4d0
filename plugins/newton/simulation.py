"""One running simulation: garments as Style3D cloth, the body as a moving collision mesh.

Newton and Warp are imported here alone, and only when a simulation is asked for.

Style3D stretches each face along the two axes of its panel and shears it; it has no
Poisson coupling. ``E = 4 mu (mu + lam) / (2 mu + lam)`` along both axes and ``E / 2`` in shear
make every direction of pull as stiff as the library's own fabric. Bending is the same model with
the same constant.
"""

import io
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from jaxtyping import Float

from isp_assets.conventions import GRAVITY
from isp_assets.errors import MissingExtraError
from isp_assets.geometry.energy import Fabric
from isp_assets.physics import Cloth, PhysicsScene

from .options import NewtonOptions


def import_newton() -> tuple[Any, Any]:
    """The modules ``newton`` and ``warp``.

    Raises:
        MissingExtraError: If one of them is not installed.
    """
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR  # no banner, nor a warning for want of a GPU
        import newton
    except ImportError as error:
        raise MissingExtraError("newton", "newton", "the physics solver") from error
    return newton, warp


class Simulation:
    """The state of all garments, and one step at a time. Positions are in the space of the scene."""

    def __init__(self, scene: PhysicsScene, options: NewtonOptions) -> None:
        self.options, self._body = options, scene.body[0]
        self._newton, self._warp = import_newton()
        model = self._build(scene)
        config = self._newton.solvers.SolverStyle3D.Config(
            iterations=options.iterations, linear_iterations=options.linear_iterations
        )
        with redirect_stdout(io.StringIO()):  # it prints a timing
            self._solver = self._newton.solvers.SolverStyle3D(model, config=config)
        self._set_self_contact()
        self._states = [model.state(), model.state()]
        self._control = model.control()
        self._pipeline = self._newton.CollisionPipeline(model, soft_contact_gap=options.contact_gap)
        self._contacts = self._pipeline.contacts()

    def place(self, positions: Float[np.ndarray, "V 3"]) -> None:
        """Put all vertices somewhere, at rest."""
        self.restore((np.array(positions, np.float32), np.zeros_like(positions, dtype=np.float32)))

    def save(self) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]]:
        """Positions [m] and velocities [m/s]; copies."""
        state = self._states[0]
        return state.particle_q.numpy().copy(), state.particle_qd.numpy().copy()

    def restore(self, saved: tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]]) -> None:
        """Go back to what `save` gave."""
        self._states[0].particle_q.assign(saved[0])
        self._states[0].particle_qd.assign(saved[1])

    def split(self, values: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "_ 3"], ...]:
        """Rows of every garment."""
        return tuple(np.split(values, self._ends[:-1]))

    def step(
        self, body: Float[np.ndarray, "N 3"], held: Float[np.ndarray, "A 3"], seconds: float
    ) -> Float[np.ndarray, " V"]:
        """Move the body and the held vertices there [m], then let the cloth follow.

        Returns:
            Speed of every vertex [m/s]; 0 at held ones.
        """
        now, after = self._states
        if len(self._held):
            positions = now.particle_q.numpy().copy()
            positions[self._held] = held
            now.particle_q.assign(positions)
        # Without the skin's velocity, friction would hold cloth back in space wherever a limb moves fast.
        self._mesh.velocities.assign(((body - self._body) / seconds).astype(np.float32))
        self._mesh.points.assign(np.ascontiguousarray(body, np.float32))
        self._body = body
        self._mesh.refit()
        self._pipeline.collide(now, self._contacts)
        now.clear_forces()
        self._solver.step(now, after, self._control, self._contacts, seconds)
        self._states = [after, now]
        speed = np.linalg.norm(after.particle_qd.numpy(), axis=1)
        speed[self._held] = 0
        return speed

    def damp(self, factor: float, limit: float) -> None:
        """Slow every vertex down, and to ``limit`` [m/s] at most."""
        velocity = self._states[0].particle_qd.numpy().copy()
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        self._states[0].particle_qd.assign(velocity * factor * np.minimum(1, limit / (speed + 1e-9)))

    def _build(self, scene: PhysicsScene) -> Any:
        builder = self._newton.ModelBuilder(up_axis=self._newton.Axis.Y)
        self._newton.solvers.SolverStyle3D.register_custom_attributes(builder)
        held: list[np.ndarray] = []
        ends: list[int] = []
        for cloth in scene.cloths:
            held.append(cloth.held + (ends[-1] if ends else 0))
            self._add_cloth(builder, cloth, scene.fabric)
            ends.append(builder.particle_count)
        self._held, self._ends = np.concatenate(held).astype(np.int64), ends
        for index in self._held.tolist():
            builder.particle_mass[index] = 0.0
            builder.particle_flags[index] = int(
                builder.particle_flags[index] & ~self._newton.ParticleFlags.ACTIVE
            )
        mesh = self._newton.Mesh(
            scene.body[0].astype(np.float32), scene.body_faces.astype(np.int32).ravel(), compute_inertia=False
        )
        builder.add_shape_mesh(body=-1, mesh=mesh)
        model = builder.finalize(device=self.options.device)
        model.set_gravity((0.0, -self.options.gravity * GRAVITY, 0.0))
        model.soft_contact_ke, model.soft_contact_kd = self.options.contact_stiffness, 1e-4
        model.soft_contact_mu = self.options.friction
        # The builder mixes bending by the direction of the edge; our fabric bends alike in all.
        bending = model.edge_bending_properties.numpy().copy()
        bending[:, 0] = scene.fabric.bending
        model.edge_bending_properties.assign(bending)
        self._mesh = next(source for source in model.shape_source if source is not None).mesh
        return model

    def _add_cloth(self, builder: Any, cloth: Cloth, fabric: Fabric) -> None:
        vec3 = self._warp.vec3
        young = 4 * fabric.mu * (fabric.mu + fabric.lam) / (2 * fabric.mu + fabric.lam)
        self._newton.solvers.style3d.add_cloth_mesh(
            builder,
            pos=vec3(0.0, 0.0, 0.0),
            rot=self._warp.quat_identity(),
            vel=vec3(0.0, 0.0, 0.0),
            vertices=cloth.start[0].astype(np.float64).tolist(),
            indices=cloth.faces.ravel().tolist(),
            panel_verts=_wound_alike(cloth.flat_corners).reshape(-1, 2).tolist(),
            panel_indices=list(range(3 * len(cloth.faces))),
            density=fabric.density,
            tri_aniso_ke=vec3(young, young, 0.5 * young),
            edge_aniso_ke=vec3(*[fabric.bending] * 3),
            particle_radius=self.options.margin,
        )

    def _set_self_contact(self) -> None:
        collision = self._solver.collision
        collision.radius = 0.5 * self.options.layer_margin
        if not (self.options.self_contact or len(self._ends) > 1):
            collision.stiff_vf = collision.stiff_ee = collision.stiff_ef = 0.0


def _wound_alike(corners: Float[np.ndarray, "F 3 2"]) -> Float[np.ndarray, "F 3 2"]:
    """Flat faces, all counter-clockwise: the solver drops the others. Mirrored along the first axis."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    turned = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    result = np.array(corners, np.float64)
    result[turned, :, 0] *= -1
    return result
