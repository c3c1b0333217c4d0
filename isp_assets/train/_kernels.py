"""Compiled inner loops of the rest drape. Imported late: numba is an optional dependency."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from isp_assets.errors import MissingExtraError

try:
    import numba as nb
except ImportError as error:
    raise MissingExtraError("numba", "train", "draping training garments") from error


def _compiled(**options: Any) -> Callable[[Callable], Callable]:
    """Compile a function as it was written: what tests wrap about it, numba cannot read."""
    return lambda function: nb.njit(fastmath=True, **options)(inspect.unwrap(function))


@_compiled(inline="always")
def sample_distance(grid, origin, cell, x, y, z):
    """Trilinear distance and its gradient; far away outside the grid."""
    fx, fy, fz = (x - origin[0]) / cell, (y - origin[1]) / cell, (z - origin[2]) / cell
    i, j, k = int(np.floor(fx)), int(np.floor(fy)), int(np.floor(fz))
    nx, ny, nz = grid.shape
    if i < 0 or j < 0 or k < 0 or i >= nx - 1 or j >= ny - 1 or k >= nz - 1:
        return 1.0, 0.0, 0.0, 0.0
    u, v, w = fx - i, fy - j, fz - k
    a000, a100, a010, a110 = grid[i, j, k], grid[i + 1, j, k], grid[i, j + 1, k], grid[i + 1, j + 1, k]
    a001, a101 = grid[i, j, k + 1], grid[i + 1, j, k + 1]
    a011, a111 = grid[i, j + 1, k + 1], grid[i + 1, j + 1, k + 1]
    b00, b10 = a000 * (1 - u) + a100 * u, a010 * (1 - u) + a110 * u
    b01, b11 = a001 * (1 - u) + a101 * u, a011 * (1 - u) + a111 * u
    c0, c1 = b00 * (1 - v) + b10 * v, b01 * (1 - v) + b11 * v
    gz = (c1 - c0) / cell
    gy = ((b10 - b00) * (1 - w) + (b11 - b01) * w) / cell
    g0 = (a100 - a000) * (1 - v) + (a110 - a010) * v
    g1 = (a101 - a001) * (1 - v) + (a111 - a011) * v
    return c0 * (1 - w) + c1 * w, (g0 * (1 - w) + g1 * w) / cell, gy, gz


@_compiled(cache=True)
def contact_energy(x, grid, origin, cell, margin, stiffness, twins, thickness, gradient):
    """Quadratic penalty of the body and of crossed twin sheets; adds to the gradient."""
    energy = 0.0
    for i in range(x.shape[0]):
        d, gx, gy, gz = sample_distance(grid, origin, cell, x[i, 0], x[i, 1], x[i, 2])
        if d < margin:
            q = margin - d
            energy += 0.5 * stiffness[i] * q * q
            gradient[i, 0] -= stiffness[i] * q * gx
            gradient[i, 1] -= stiffness[i] * q * gy
            gradient[i, 2] -= stiffness[i] * q * gz
    for k in range(twins.shape[0]):
        i, j = twins[k, 0], twins[k, 1]
        q = thickness - (x[i, 2] - x[j, 2])
        if q > 0:
            energy += 0.5 * stiffness[i] * q * q
            gradient[i, 2] -= stiffness[i] * q
            gradient[j, 2] += stiffness[i] * q
    return energy


@_compiled(cache=True)
def relax(
    x, v, inverse_mass, edges, edge_length, hinges, hinge_weights, hinge_compliance, grid, origin, cell,
    anchors, targets, twins, substeps, dt, gravity, stretch_stiffness, damping, margin, friction, thickness,
    speed,
):  # fmt: skip
    """XPBD, one Gauss-Seidel sweep a substep; moves ``x`` in place, fills ``speed`` [m/s, rms]."""
    n = x.shape[0]
    p = x.copy()
    idt2 = 1.0 / (dt * dt)
    for step in range(substeps):
        for i in range(n):
            for c in range(3):
                v[i, c] *= damping
            v[i, 1] -= gravity * dt
            for c in range(3):
                p[i, c] = x[i, c] + v[i, c] * dt
        for k in range(anchors.shape[0]):
            for c in range(3):
                p[anchors[k], c] = x[anchors[k], c] + 0.05 * (targets[k, c] - x[anchors[k], c])
        # The sweep keeps one direction: reversing it every substep gives a jitter that never settles.
        for k in range(edges.shape[0]):
            i, j = edges[k, 0], edges[k, 1]
            dx, dy, dz = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
            w = inverse_mass[i] + inverse_mass[j]
            if w == 0.0:
                continue
            s = -(length - edge_length[k]) / (w + idt2 * edge_length[k] / stretch_stiffness) / length
            wi, wj = inverse_mass[i] * s, inverse_mass[j] * s
            p[i, 0] += wi * dx
            p[i, 1] += wi * dy
            p[i, 2] += wi * dz
            p[j, 0] -= wj * dx
            p[j, 1] -= wj * dy
            p[j, 2] -= wj * dz
        for k in range(hinges.shape[0]):
            a0, a1, a2, a3 = hinges[k, 0], hinges[k, 1], hinges[k, 2], hinges[k, 3]
            w0, w1, w2, w3 = (
                hinge_weights[k, 0],
                hinge_weights[k, 1],
                hinge_weights[k, 2],
                hinge_weights[k, 3],
            )
            m0, m1, m2, m3 = (
                inverse_mass[a0] * w0,
                inverse_mass[a1] * w1,
                inverse_mass[a2] * w2,
                inverse_mass[a3] * w3,
            )
            total = w0 * m0 + w1 * m1 + w2 * m2 + w3 * m3 + idt2 * hinge_compliance[k]
            for c in range(3):
                s = -(w0 * p[a0, c] + w1 * p[a1, c] + w2 * p[a2, c] + w3 * p[a3, c]) / total
                p[a0, c] += m0 * s
                p[a1, c] += m1 * s
                p[a2, c] += m2 * s
                p[a3, c] += m3 * s
        for k in range(twins.shape[0]):
            i, j = twins[k, 0], twins[k, 1]
            d = p[i, 2] - p[j, 2]
            if d < thickness:
                p[i, 2] += 0.5 * (thickness - d)
                p[j, 2] -= 0.5 * (thickness - d)
        for i in range(n):
            if inverse_mass[i] == 0.0:
                continue
            d, gx, gy, gz = sample_distance(grid, origin, cell, p[i, 0], p[i, 1], p[i, 2])
            if d < margin:
                norm = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-9
                gx, gy, gz = gx / norm, gy / norm, gz / norm
                q = margin - d
                p[i, 0] += q * gx
                p[i, 1] += q * gy
                p[i, 2] += q * gz
                tx, ty, tz = p[i, 0] - x[i, 0], p[i, 1] - x[i, 1], p[i, 2] - x[i, 2]
                along = tx * gx + ty * gy + tz * gz
                tx, ty, tz = tx - along * gx, ty - along * gy, tz - along * gz
                slip = np.sqrt(tx * tx + ty * ty + tz * tz) + 1e-12
                hold = 1.0 if slip < friction * q else friction * q / slip
                p[i, 0] -= hold * tx
                p[i, 1] -= hold * ty
                p[i, 2] -= hold * tz
        total_square = 0.0
        for i in range(n):
            square = 0.0
            for c in range(3):
                d = (p[i, c] - x[i, c]) / dt
                v[i, c] = d
                x[i, c] = p[i, c]
                square += d * d
            if square > 0.25:  # 0.5 m/s: keeps the motion quasi-static
                for c in range(3):
                    v[i, c] *= 0.5 / np.sqrt(square)
            total_square += square
        speed[step] = np.sqrt(total_square / n)
