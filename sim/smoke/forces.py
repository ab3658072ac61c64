"""What acts in the air: buoyancy and vorticity confinement (Fedkiw, Stam & Jensen 2001, eq. 8-11), and cooling."""

import math

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, clear_ghosts, fill_row, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Air, flux_part
from sim.smoke.parameters import SmokeParameters

TINY_GRADIENT = 1.0e-6  # keeps N = eta / (|eta| + tiny) finite where the vorticity is even [1/(m s)]


def upward(gravity: Vector3) -> tuple[float, float, float]:
    """Unit vector against gravity; zero without gravity, where nothing rises."""
    strength = math.sqrt(sum(g * g for g in gravity))
    x, y, z = (-g / strength if strength > 0.0 else 0.0 for g in gravity)
    return x, y, z


def accelerate(
    air: Air, parameters: SmokeParameters, gravity: Vector3, work: tuple[ti.Ndarray, ...], dt: float
) -> None:
    """Add dt [s] times f = (-alpha rho + beta (T - T_air)) up + epsilon h (N x omega) to the velocity of open faces.

    Sides of the box that are closed are at rest. Of gravity only the direction matters, as alpha and beta
    are accelerations. The confinement is evaluated at cell centres, three cells and more away from the sides of the
    box, where the gradient of the vorticity is not made up by the boundary, and averaged onto faces. There are four
    arrays to work in.
    """
    confinement, vorticity = Faces(*work[:3]), work[3]
    strength, half_per_cell = parameters.vorticity_confinement * parameters.cell_size, 0.5 / parameters.cell_size
    if strength == 0.0:
        for values in confinement:
            values.fill(0.0)
    else:
        clear_ghosts(air.box, confinement)
        _compute_vorticity(air.box, air.state.velocity, confinement, vorticity, half_per_cell)
        _compute_confinement(air.box, confinement, vorticity, half_per_cell, strength)
    x, y, z = upward(gravity)
    alpha, beta = parameters.buoyancy_density, parameters.lift_per_kelvin(gravity)
    sink, lift = ti.math.vec3(-alpha * x, -alpha * y, -alpha * z), ti.math.vec3(beta * x, beta * y, beta * z)
    _apply(air, confinement, sink, lift, dt)


@func
def _centre(face: Floats, step: ti.i32, at: ti.i32):
    return 0.5 * (face[at] + face[at + step])


@kernel
def _compute_vorticity(box: Grid, velocity: Faces, omega: Faces, magnitude: Floats, half_per_cell: ti.f32):
    """omega = curl u by central differences of cell-centred velocities [1/s]."""
    for i, j, lane in ti.ndrange((2, box.nx), (2, box.ny), box.lanes):
        for n in range(lane_items(box, box.nz - 2, lane)):
            at = row_start(box, i, j) + 1 + lane_place(box, n, lane)
            x, y, z = box.step_x, box.step_y, 1
            omega_x = (_centre(velocity.z, z, at + y) - _centre(velocity.z, z, at - y)) - (
                _centre(velocity.y, y, at + z) - _centre(velocity.y, y, at - z)
            )
            omega_y = (_centre(velocity.x, x, at + z) - _centre(velocity.x, x, at - z)) - (
                _centre(velocity.z, z, at + x) - _centre(velocity.z, z, at - x)
            )
            omega_z = (_centre(velocity.y, y, at + x) - _centre(velocity.y, y, at - x)) - (
                _centre(velocity.x, x, at + y) - _centre(velocity.x, x, at - y)
            )
            omega_x *= half_per_cell
            omega_y *= half_per_cell
            omega_z *= half_per_cell
            omega.x[at] = omega_x
            omega.y[at] = omega_y
            omega.z[at] = omega_z
            magnitude[at] = ti.sqrt(omega_x * omega_x + omega_y * omega_y + omega_z * omega_z)


@kernel
def _compute_confinement(box: Grid, omega: Faces, magnitude: Floats, half_per_cell: ti.f32, strength: ti.f32):
    """Replace omega by epsilon h (N x omega), N = eta / |eta|, eta = grad |omega| [m/s²]."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        inner_row = 2 < i < box.nx - 1 and 2 < j < box.ny - 1
        for n in range(lane_items(box, box.nz, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            eta_x = half_per_cell * (magnitude[at + box.step_x] - magnitude[at - box.step_x])
            eta_y = half_per_cell * (magnitude[at + box.step_y] - magnitude[at - box.step_y])
            eta_z = half_per_cell * (magnitude[at + 1] - magnitude[at - 1])
            length = ti.sqrt(eta_x * eta_x + eta_y * eta_y + eta_z * eta_z)
            # Beside the sides the arrays hold what others left there.
            is_inner, scale = inner_row and 2 < k < box.nz - 1, strength / (length + TINY_GRADIENT)
            omega_x, omega_y, omega_z = omega.x[at], omega.y[at], omega.z[at]
            omega.x[at] = ti.select(is_inner, scale * (eta_y * omega_z - eta_z * omega_y), 0.0)
            omega.y[at] = ti.select(is_inner, scale * (eta_z * omega_x - eta_x * omega_z), 0.0)
            omega.z[at] = ti.select(is_inner, scale * (eta_x * omega_y - eta_y * omega_x), 0.0)


@kernel
def _apply(air: Air, confinement: Faces, sink: ti.math.vec3, lift: ti.math.vec3, dt: ti.f32):
    # Ghost cells have no density, no excess and no confinement: half of what the cell inside has acts on a side.
    box, velocity, openness = ti.static((air.box, air.state.velocity, air.openness))
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        row = row_start(box, i, j)
        for axis, face, is_open, force in ti.static(
            (
                (0, velocity.x, openness.x, confinement.x),
                (1, velocity.y, openness.y, confinement.y),
                (2, velocity.z, openness.z, confinement.z),
            )
        ):
            given = ti.static((row, axis, air, face, is_open, force, sink[axis], lift[axis], dt))
            fill_row(box, face, row, box.nz + 1, lane, _accelerated, given)


@func
def _accelerated(
    k: ti.i32,
    row: ti.i32,
    axis: ti.template(),
    air: Air,
    face: Floats,
    openness: Floats,
    confinement: Floats,
    sink: ti.f32,
    lift: ti.f32,
    dt: ti.f32,
):
    """Velocity of a face: with the mean force of the cells beside it, or at rest on sides of the box.

    What is continued into solids stays.
    """
    density, excess = ti.static((air.state.density, air.state.excess))
    at = row + k
    below = at - steps(air.box)[axis]
    force = confinement[at] + sink * density[at] + lift * excess[at]
    force += confinement[below] + sink * density[below] + lift * excess[below]
    closed = 0.0
    if ti.static(air.solids.cuts):
        closed = ti.select(flux_part(air.solids, axis, at) > 0.0, 0.0, face[at])
    return ti.select(openness[at] == 0.0, closed, face[at] + 0.5 * dt * force)


def cool(air: Air, parameters: SmokeParameters, dt: float) -> None:
    """Let dt [s] pass for density rho and excess e of the temperature, each solved exactly over a step.

    d rho/dt = -d rho with the dissipation d; de/dt = -c e - k (max(e, 0)/e_max)⁴ with the cooling c, the radiative
    cooling k and the excess e_max of the hottest source (Nguyen, Fedkiw & Jensen 2002).
    """
    density_factor = math.exp(-parameters.density_dissipation * dt)
    excess_factor = math.exp(-parameters.cooling * dt)
    radiates = parameters.radiative_cooling > 0.0
    _cool(air, density_factor, excess_factor, radiated(parameters, dt), radiates)


def radiated(parameters: SmokeParameters, dt: float) -> float:
    """The factor r [1/K³], by which e' = e exp(-c dt) (1 + r e³)^(-1/3) solves both laws exactly.

    The law of e is linear in e^-3: r = k (1 - exp(-3 c dt)) / (c e_max⁴).
    """
    hottest = parameters.hottest_excess
    if parameters.radiative_cooling == 0.0 or hottest == 0.0:
        return 0.0
    rate = 3.0 * parameters.cooling
    time = -math.expm1(-rate * dt) / rate if rate > 0.0 else dt
    return 3.0 * parameters.radiative_cooling * time / hottest**4


@kernel
def _cool(air: Air, density_factor: ti.f32, excess_factor: ti.f32, radiated: ti.f32, radiates: ti.template()):
    box, state = ti.static((air.box, air.state))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            state.density[at] *= density_factor
            excess = state.excess[at]
            if ti.static(radiates):
                heat = ti.max(excess, 0.0)
                excess *= (1.0 + radiated * heat * heat * heat) ** (-1.0 / 3.0)
            state.excess[at] = excess * excess_factor
