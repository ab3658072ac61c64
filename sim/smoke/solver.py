"""Hot smoke on a staggered grid (Fedkiw, Stam & Jensen 2001)."""

import math
from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.parameters import Vector3
from sim.reductions import is_finite
from sim.scene import DomainParameters
from sim.smoke.advection import Advection
from sim.smoke.extrapolation import Extrapolation
from sim.smoke.forces import Forces, upward
from sim.smoke.grid import SmokeGrid, SolidRegion
from sim.smoke.parameters import SmokeParameters
from sim.smoke.projection import PressureProjection
from sim.smoke.reductions import RowReductions
from sim.smoke.sources import build_sources
from sim.snapshots import Snapshot
from sim.solver import Arrays, Diagnostics

RUNAWAY_SPEED = 1.0e4
"""No smoke of this kind moves at thirty times the speed of sound [m/s]."""


@ti.data_oriented
class SmokeSolver:
    """Density, temperature and velocity of smoke in a box of cells, with static solids in it.

    One substep, by operator splitting as in Stam 1999: advect, accelerate, emit, project, cool. Incompressible air of
    constant density (Boussinesq): smoke and heat act through buoyancy alone.

    Exact: smoke is added by sources only, and what they add is counted. Approximate: advection does not conserve the
    total of density where the flow spreads or closes in, nor at open sides, so `mass` is a measured quantity. Not
    supported: solids that move, expansion by heat.

    Closed boxes need no special care: walls let no air through, so the net divergence in a closed region is zero
    whatever sources do (they drive air, they do not add any), and the pressure equation always has a solution.

    State, float32: face velocities [m/s], density [-], temperature above the air's [K].

    Args:
        parameters: the smoke of a job.
        domain: the box that is used where the smoke names none.
        gravity: [m/s²]; its direction is down.
        solids: static obstacles, voxelized on the grid.

    Raises:
        ValueError: the box is empty or full of solids, or a source contains no open cell.
    """

    def __init__(
        self,
        parameters: SmokeParameters,
        *,
        domain: DomainParameters,
        gravity: Vector3,
        solids: Sequence[SolidRegion] = (),
    ) -> None:
        self.name = parameters.name
        self.parameters = parameters
        self.grid = SmokeGrid.build(parameters, domain, solids)
        self._nx, self._ny, self._nz = self.grid.cells
        self._size = self.grid.size
        self._step_x, self._step_y = self.grid.padded[1] * self.grid.padded[2], self.grid.padded[2]
        self.u_face_x, self.v_face_y, self.w_face_z, self.density, self.excess_temperature = (
            ti.field(ti.f32, shape=self._size) for _ in range(5)
        )
        velocity = (self.u_face_x, self.v_face_y, self.w_face_z)
        cell_fields = (self.density, self.excess_temperature)
        self._state = {
            "u_face_x": self.u_face_x,
            "v_face_y": self.v_face_y,
            "w_face_z": self.w_face_z,
            "density": self.density,
            "excess_temperature": self.excess_temperature,
        }
        self._projection = PressureProjection(
            self.grid,
            velocity,
            tolerance=parameters.projection_tolerance,
            max_iterations=parameters.projection_max_iterations,
        )
        multigrid = self._projection.multigrid
        work = self._projection.work_fields
        self._advection = Advection(
            self.grid,
            velocity=velocity,
            cell_fields=cell_fields,
            work=work,
            maccormack=parameters.advection == "maccormack",
        )
        self._forces = Forces(
            self.grid,
            openness=(multigrid.conductance_x, multigrid.conductance_y, multigrid.conductance_z),
            velocity=velocity,
            cell_fields=cell_fields,
            work=work[:4],
            gravity=gravity,
            buoyancy_density=parameters.buoyancy_density,
            buoyancy_temperature=parameters.buoyancy_temperature,
            confinement=parameters.vorticity_confinement,
        )
        self._extrapolation = Extrapolation(self.grid, velocity=velocity, cell_fields=cell_fields, reach=parameters.cfl)
        self._rows = RowReductions(self._nx, self._ny)
        self._sources = build_sources(parameters, self.grid, velocity=velocity, cell_fields=cell_fields)
        self._has_gravity = any(upward(gravity))
        self._time_s = 0.0
        self._emitted_mass = 0.0
        self._iterations = self._not_converged = 0
        self._residual = self._divergence = 0.0

    @property
    def device_bytes(self) -> int:
        """Memory of the state, the work arrays and the coefficients [bytes]; lists along surfaces are left out."""
        multigrid = self._projection.multigrid
        cell_arrays = [*self._state.values(), *self._projection.work_fields]
        coefficients = [multigrid.conductance_x, multigrid.conductance_y, multigrid.conductance_z]
        return 4 * sum(math.prod(field.shape) for field in [*cell_arrays, *coefficients, multigrid.inverse_diagonal])

    def stable_dt(self) -> float:
        """Largest step [s] in which nothing crosses more than `cfl` cells.

        The speed at the end of the step counts, v + a dt with the largest buoyant acceleration a, so that a start
        from rest is bounded as well: dt solves (v + a dt) dt = cfl h.
        """
        self._compute_speed_and_acceleration()
        speed, acceleration = self._rows.maxima()
        without_sources = self._largest_step(speed, acceleration)
        for source in self._sources:
            if source.parameters.emits_during(self._time_s, self._time_s + without_sources):
                speed = max(speed, source.speed)
                acceleration = max(acceleration, self._buoyancy_bound(source.target_excess, source.target_density))
        return self._largest_step(speed, acceleration)

    def _largest_step(self, speed: float, acceleration: float) -> float:
        distance = self.parameters.cfl * self.grid.cell_size
        if acceleration <= 0.0 and speed <= 0.0:
            return math.inf
        return 2.0 * distance / (speed + math.sqrt(speed * speed + 4.0 * acceleration * distance))

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._advection.advance(dt)
        self._forces.accelerate(dt)
        self._emit(dt)
        self._project()
        self._cool(
            math.exp(-self.parameters.density_dissipation * dt),
            math.exp(-self.parameters.cooling * dt),
        )
        self._extrapolation.fill()
        self._time_s += dt

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s` [s]."""
        self._time_s = time_s
        self._iterations = self._not_converged = 0
        self._residual = self._divergence = 0.0

    def snapshots(self) -> dict[str, Snapshot]:
        """Density, temperature and velocity at cell centres; solid cells hold no smoke."""
        air = ~self.grid.solid
        velocity = np.empty((*self.grid.cells, 3), np.float32)
        for axis, name in enumerate(("u_face_x", "v_face_y", "w_face_z")):
            faces = np.moveaxis(self._faces(name, axis), axis, 0)
            velocity[..., axis] = np.moveaxis(0.5 * (faces[1:] + faces[:-1]), 0, axis)
        ambient = np.float32(self.parameters.ambient_temperature)
        arrays = {
            "density": np.where(air, self._cells("density"), np.float32(0.0)),
            "temperature": np.where(air, ambient + self._cells("excess_temperature"), ambient),
            "velocity": np.where(air[..., None], velocity, np.float32(0.0)),
        }
        attributes = {
            "origin": self.grid.origin,
            "cell_size": self.grid.cell_size,
            "ambient_temperature": self.parameters.ambient_temperature,
        }
        return {self.name: Snapshot("smoke", arrays, attributes)}

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The state with its ghosts, the time and the emitted mass."""
        arrays = {name: field.to_numpy().reshape(self.grid.padded) for name, field in self._state.items()}
        return {**arrays, "clock": np.array([self._time_s, self._emitted_mass])}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        expected = {**dict.fromkeys(self._state, self.grid.padded), "clock": (2,)}
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                found = f"shape {arrays[name].shape}" if name in arrays else "nothing"
                raise ValueError(f'checkpoint of smoke "{self.name}": {name} must have shape {shape}, got {found}')
        for name, field in self._state.items():
            field.from_numpy(np.ascontiguousarray(arrays[name], np.float32).ravel())
        self._time_s, self._emitted_mass = (float(value) for value in arrays["clock"])

    def diagnostics(self) -> Diagnostics:
        """Totals of the state, and the projections of the frame.

        `mass` and `emitted_mass` are volume integrals of density [m³]; `iterations` is the sum over the frame,
        `residual` (max|div u| h / max|u|) and `divergence` [1/s] are the worst of the frame.
        """
        self._compute_speed_and_acceleration()
        speed, _ = self._rows.maxima()
        air = ~self.grid.solid
        excess = self._cells("excess_temperature")[air]
        return {
            "mass": float(self._cells("density")[air].sum(dtype=np.float64)) * self.grid.cell_size**3,
            "emitted_mass": self._emitted_mass,
            "max_temperature": self.parameters.ambient_temperature + float(excess.max()),
            "max_speed": speed,
            "iterations": float(self._iterations),
            "residual": self._residual,
            "divergence": self._divergence,
            "not_converged": float(self._not_converged),
        }

    def first_bad_quantity(self) -> str | None:
        """The first field with a value that is no number, or a velocity beyond all reason."""
        for name, field in self._state.items():
            count = self._count_not_finite(field)
            if count:
                return f"{name} is not finite at {count} places"
        self._compute_speed_and_acceleration()
        speed, _ = self._rows.maxima()
        return f"max_speed is {speed:.3g} m/s" if speed > RUNAWAY_SPEED else None

    def _emit(self, dt: float) -> None:
        for source in self._sources:
            if source.parameters.emits_during(self._time_s, self._time_s + dt):
                self._emitted_mass += source.emit(self._time_s) * self.grid.cell_size**3

    def _project(self) -> None:
        report = self._projection.project()
        self._iterations += report.iterations
        self._not_converged += not report.converged
        self._residual = max(self._residual, report.residual)
        self._divergence = max(self._divergence, report.divergence)

    def _cells(self, name: str) -> NDArray[np.float32]:
        return self.grid.trim(self._state[name].to_numpy(), self.grid.cells)

    def _faces(self, name: str, axis: int) -> NDArray[np.float32]:
        return self.grid.trim(self._state[name].to_numpy(), self.grid.face_shape(axis))

    def _buoyancy_bound(self, excess: float, density: float) -> float:
        if not self._has_gravity:
            return 0.0
        return self.parameters.buoyancy_temperature * abs(excess) + self.parameters.buoyancy_density * density

    @ti.kernel
    def _cool(self, density_factor: ti.f32, excess_factor: ti.f32):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 1):
                self.density[row + k] *= density_factor
                self.excess_temperature[row + k] *= excess_factor

    @ti.kernel
    def _compute_speed_and_acceleration(self):
        """Largest face velocity [m/s] and a bound of the largest buoyant acceleration [m/s²], row by row."""
        alpha = ti.static(self.parameters.buoyancy_density if self._has_gravity else 0.0)
        beta = ti.static(self.parameters.buoyancy_temperature if self._has_gravity else 0.0)
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            speed = 0.0
            acceleration = 0.0
            for k in range(1, self._nz + 1):
                at = row + k
                lower = ti.max(ti.abs(self.u_face_x[at]), ti.abs(self.v_face_y[at]), ti.abs(self.w_face_z[at]))
                upper = ti.max(
                    ti.abs(self.u_face_x[at + self._step_x]),
                    ti.abs(self.v_face_y[at + self._step_y]),
                    ti.abs(self.w_face_z[at + 1]),
                )
                speed = ti.max(speed, lower, upper)
                buoyancy = alpha * self.density[at] + beta * ti.abs(self.excess_temperature[at])
                acceleration = ti.max(acceleration, buoyancy)
            self._rows.row[i - 1, j - 1] = ti.Vector([speed, acceleration])

    @ti.kernel
    def _count_not_finite(self, field: ti.template()) -> ti.i32:
        count = 0
        for at in range(self._size):
            count += 1 - is_finite(field[at])
        return count
