"""Hot smoke on a staggered grid (Fedkiw, Stam & Jensen 2001)."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.core.domain import DomainParameters
from sim.core.host_access import copied, viewed
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.reductions import is_finite
from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Diagnostics, OutgrownError, Remedies
from sim.forces.field import ForceField
from sim.shapes.solid import HasSignedDistance
from sim.smoke.advection import Advection
from sim.smoke.arrays import new_state
from sim.smoke.combustion import Combustion
from sim.smoke.extrapolation import Extrapolation
from sim.smoke.forces import accelerate, cool, upward
from sim.smoke.free_bodies import FreeBodies
from sim.smoke.grid import Index3, SmokeGrid, Window
from sim.smoke.guide import Guide
from sim.smoke.lanes import lane_items, lane_place, row_start
from sim.smoke.obstacles import Air, AirForce, Obstacles, time_of_travel
from sim.smoke.outer_forces import OuterForces, OutsideAir
from sim.smoke.parameters import MOST_CELLS, SmokeParameters
from sim.smoke.projection import PressureProjection, ProjectionReport
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place
from sim.smoke.sides import blow_in, brake_inflow, start_wind
from sim.smoke.sources import require_cells, sources_of
from sim.smoke.transport import Transport
from sim.smoke.turbulence import Turbulence
from sim.smoke.window import Ends, Fitting, carry_over

RUNAWAY_SPEED = 1.0e4  # no smoke of this kind moves at thirty times the speed of sound [m/s]


class SmokeSolver:
    """Density, temperature and velocity of smoke in a box of cells, with solids in it that stand still or move.

    One substep, by operator splitting as in Stam 1999: advect velocity, let obstacles move on, accelerate, emit, burn,
    project, carry smoke and heat with what came of it, cool. Incompressible air of constant density (Boussinesq): smoke
    and heat act through buoyancy alone, but for fuel that burns, which expands (`combustion`).

    Exact, but for rounding: smoke is added by sources and leaves through open sides only, what sources add is counted,
    and heat is kept likewise (`Transport`). Heat lets air rise by the strength of gravity, unless the parameters say
    how fast, and does not expand it unless it comes of burning.

    Air that comes in through open sides was at rest outside, or moved with the wind, and is clean (`sim.smoke.sides`).

    Solids cut cells (`cut_cells`), and those that move push air with the velocity of their surface (`Obstacles`): what
    is in a cell that they cover goes where it is pushed. Beside them smoke is kept to second order of the step, so
    `mass` is a measured quantity.

    In a closed region sources drive air, but do not add any; nor do bodies that are wholly inside. What a piston
    presses into it is spread evenly (`PressureProjection`): its air is compressed, and its smoke with it.

    State, float32: face velocities [m/s], density [-], temperature above the air's [K].

    Attributes:
        grid: the cells, with the solids that stand still.
        obstacles: all solids, and how others put some in that move.
        air, state: the fields, with and without what is in their way.
        time_s: simulated time [s].
        air_forces: what pushes the air from outside, in this order in every substep.
        sources: where smoke comes from, in the order of the parameters.
        refusal: of more cells (`Grows`).
        free_bodies: what the air pushes; None: nothing.
        guide: what its large motion is drawn to; None: nothing.

    Raises:
        OutgrownError: at the start of a frame, there is no memory for the window that it needs.
        ValueError: the box is empty or full of solids, a source contains no open cell, or solids shut air in that
            wind blows into.
    """

    def __init__(
        self,
        parameters: SmokeParameters,
        *,
        domain: DomainParameters,
        gravity: Vector3,
        solids: Sequence[HasSignedDistance] = (),
        moving: bool = False,
        free_bodies: int = 0,
        forces: ForceField | None = None,
        frame_s: float = 1.0 / 24.0,
        guide: Guide | None = None,
    ) -> None:
        """Take a smoke, which may have the domain for its box, static solids, and room for obstacles that move.

        Of these so many are bodies that the air may push.

        A window is fitted to frames of `frame_s` [s].
        """
        self.name = parameters.name
        self.parameters = parameters
        self.sources = sources_of(parameters)
        self.air_forces: list[AirForce] = []
        self.refusal: Callable[[float], str | None] | None = None
        self.free_bodies = FreeBodies(free_bodies) if free_bodies else None
        self.guide: Guide | None = None  # none yet: what follows begins no frame of it
        self._gravity, self._has_gravity = gravity, any(upward(gravity))
        self._lift = parameters.lift_per_kelvin(gravity)
        self._domain, self._solids, self._outer = domain, solids, (forces or ForceField(())).on([(self.name,)])
        self._outside = OutsideAir(parameters.wind, self._outer)
        stirred = parameters.turbulence.strength > 0.0 or self._outer.blows
        self._frame_s, self._fitting = frame_s, Fitting(parameters, domain, frame_s, is_stirred=stirred)
        window = self._fitting.first(source.bounds(0.0, 0.0) for source in self.sources)
        self.grid = SmokeGrid.build(parameters, domain, solids, window)
        self.obstacles = Obstacles(self.grid, moving=moving, carries=free_bodies > 0)
        self._compute_in_grid()
        require_cells(parameters, self.sources, self.grid)
        self._emitted_mass, self._burnt_fuel, self._expanded = 0.0, 0.0, 0.0
        self.begin_frame(0.0)
        if any(parameters.wind):
            if cut_off := self.grid.cut_off_faces():
                raise ValueError(f'smoke "{self.name}": wind {parameters.cut_off_problem(cut_off)}')
            start_wind(self.air, parameters.wind, parameters.windward_faces)
            self._projections.append(self._projection.project())
            self._extrapolation.fill()
            self.begin_frame(0.0)
        self.guide = guide

    @property
    def outside_velocity(self) -> Vector3:
        """Velocity of the air outside of the grid [m/s]."""
        return self._outside.velocity

    def _compute_in_grid(self) -> None:
        """Have room for air at rest in the grid, and all that changes it."""
        parameters = self.parameters
        self.state = new_state(self.grid.size)
        self._combustion: Combustion | None = None
        if parameters.fire is not None:
            given = {"ambient_temperature": parameters.ambient_temperature, "cell_size": self.grid.cell_size}
            self._combustion = Combustion(parameters.fire, self.grid.size, **given)
        self._projection = PressureProjection(
            self.obstacles,
            self.state.velocity,
            tolerance=parameters.projection_tolerance,
            max_iterations=parameters.projection_max_iterations,
            expansion=None if self._combustion is None else self._combustion.expansion,
            bodies=self.free_bodies,
        )
        operator, work = self._projection.multigrid.coefficients.operator, self._projection.work
        self.air = Air(self.obstacles.box, self.obstacles.solids, operator.faces, self.state)
        self._advection = Advection(
            self.grid,
            self.air,
            work,
            maccormack=parameters.advection == "maccormack",
        )
        sharpens = parameters.advection == "maccormack"
        self._transport = Transport(self.air, work, sharpens=sharpens, combustion=self._combustion)
        self._open_sides = self.grid.open_sides
        self._extrapolation = Extrapolation(self.obstacles, self.state.velocity, work[:3], reach=parameters.cfl)
        self._rows = new_rows(self.air.box)
        for source in self.sources:
            source.enter(self.grid)
        self._turbulence: Turbulence | None = None
        if parameters.turbulence.strength > 0.0:
            self._turbulence = Turbulence(self.grid, parameters.turbulence, parameters.wind)
        if self._outer.accelerates or self._outer.blows:
            self.air_forces.append(OuterForces(self._outer, self.air, parameters, self.grid))

    def _move_window(self, window: Window) -> None:
        """Compute in another window from now on: what it shares with the present one stays, else there is fresh air."""
        if window == self.grid.window:
            return
        self._require_room(window)
        cells, grid, box, moving = self._arrays, self.grid, self.obstacles.box, self.obstacles.moving
        movers = self.obstacles.movers
        self.air_forces.clear()
        # All but the state is given up before there is more.
        del self._projection, self._advection, self._transport, self._extrapolation, self._turbulence, self._rows
        del self.air, self.obstacles
        self.grid = SmokeGrid.of_box(self.parameters, self._domain, window).with_solids_of(self._cells_of_solids)
        self.obstacles = Obstacles(self.grid, moving=moving, carries=self.free_bodies is not None)
        self.obstacles.movers += movers
        self._compute_in_grid()
        if any(self._outside.velocity):
            start_wind(self.air, self._outside.velocity, self.parameters.windward_faces)
        carry_over(cells, (grid, box), self._arrays, (self.grid, self.obstacles.box))
        for mover in movers:
            mover.exchange(0.0)
        self.move_obstacles()
        self._extrapolation.fill()

    @cached_property
    def _cells_of_solids(self) -> list[SmokeGrid]:
        """The cells around each static solid, wherever it is: distances of meshes are dear, and found once."""
        windows = [Window.around(solid.bounds, self.parameters, self._domain) for solid in self._solids]
        return [
            SmokeGrid.of_box(self.parameters, self._domain, window).with_solids([solid])
            for window, solid in zip(windows, self._solids, strict=True)
        ]

    def _require_room(self, window: Window) -> None:
        before, cells = math.prod(self.grid.cells), math.prod(window.cells)
        reason = self.refusal(float(cells - before)) if self.refusal is not None and cells > before else None
        if cells > MOST_CELLS:
            reason = f"a smoke may have {MOST_CELLS:,} at most"
        if reason is not None:
            raise OutgrownError(
                f'smoke "{self.name}" grows at {self.time_s:.4g} s from {before:,} to {cells:,} cells: {reason}'
            )

    @property
    def _arrays(self) -> dict[str, ti.Ndarray]:
        """The state by the names of a checkpoint."""
        names = ("u_face_x", "v_face_y", "w_face_z", "density", "excess_temperature")
        arrays = dict(zip(names, (*self.state.velocity, self.state.density, self.state.excess), strict=True))
        return arrays if self._combustion is None else {**arrays, "fuel": self._combustion.fuel}

    def stable_dt(self) -> float:
        """Largest step [s] in which no air crosses more than `cfl` cells, and no obstacle more than one.

        The speed at the end of the step counts, v + a dt with the largest buoyant acceleration a, so that a start
        from rest is bounded as well: dt solves (v + a dt) dt = cfl h.
        """
        speed, acceleration = self._find_speed_and_acceleration()
        gusts = 0.0 if self._turbulence is None else self._turbulence.acceleration
        distance = self.parameters.cfl * self.grid.cell_size
        without_sources = time_of_travel(distance, speed, acceleration + gusts)
        for source in self.sources:
            if source.parameters.emits_during(self.time_s, self.time_s + without_sources):
                speed = max(speed, source.speed)
                acceleration = max(acceleration, self._buoyancy_bound(source.target_excess, source.target_density))
        if self.guide is not None:
            speed = max(speed, self.guide.largest_speed())
        limits = [self.obstacles.stable_dt(), *(force.stable_dt() for force in self.air_forces)]
        return min(time_of_travel(distance, speed, acceleration + gusts), *limits)

    def substep(self, dt: float) -> None:
        """Advance by dt [s]; where obstacles are at its end has been marked."""
        self._advection.advance(dt, self._outside.velocity)
        self.move_obstacles()
        self._accelerate(dt)
        blow_in(self.air, self._outside.velocity, self.parameters.windward_faces)
        self._emit(dt)
        self._burn(dt)
        operator, step = self._projection.multigrid.coefficients.operator, dt / self.grid.cell_size
        brake_inflow(self.air, operator, self._open_sides, self.grid.cells, self._outside.velocity, step)
        self._projections.append(self._projection.project())
        self._transport.advance(step)
        cool(self.air, self.parameters, dt)
        self._extrapolation.fill()
        self.time_s += dt

    def move_obstacles(self) -> None:
        """Take the marked solids for the obstacles from now on; each step does so."""
        if self.obstacles.commit():
            self._follow_obstacles()

    def give_way(self, bodies: FreeBodies) -> None:
        """Let air at rest flow as obstacles move now, and bodies keep their velocities: others have set them going.

        A window is fitted to the bodies, and then to the flow around them.
        """
        for _ in range(2 if self._fitting.follows else 1):
            self._fit_window()
            for mover in self.obstacles.movers:
                mover.exchange(0.0)
            self.move_obstacles()  # once more: faces are open as between two commits
            bodies.hold()
            self._projection.project()
            self._extrapolation.fill()

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s` [s]; a window is fitted to what is there."""
        self.time_s = time_s
        self._projections: list[ProjectionReport] = []
        self._fit_window()
        if self.guide is not None:
            self.guide.begin_frame(time_s, self.refusal)

    def _fit_window(self) -> None:
        """Compute, from now on, in a window that fits the coming frame."""
        if self._fitting.follows:
            frame = self.time_s, self.time_s + self._frame_s
            emitting = [source.bounds(*frame) for source in self.sources if source.parameters.emits_during(*frame)]

            def there(frames: float) -> list[Ends]:
                return emitting + [box for each in self.obstacles.movers for box in each.reach(frames * self._frame_s)]

            fuel = None if self._combustion is None else self._combustion.fuel
            given = self.grid.window, self._outside.velocity, there, self._rows
            self._move_window(self._fitting.next(self.air, fuel, *given))

    def snapshots(self) -> dict[str, Snapshot]:
        """Density, temperature and velocity at cell centres; solid cells hold no smoke."""
        air = self.obstacles.is_air()
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

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:  # noqa: ARG002  a solver has one smoke
        """Density [-] and temperature above the air's [K] of the cells, in the solver's memory on a CPU.

        Cells in solids hold none.
        """
        arrays = self._arrays
        return {
            name: self.grid.trim(viewed(arrays[name]), self.grid.cells) for name in ("density", "excess_temperature")
        }

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The state with its ghosts, the obstacles that move, the time and the counted masses."""
        arrays = {name: values.to_numpy().reshape(self.grid.padded) for name, values in self._arrays.items()}
        clock = np.array([self.time_s, self._emitted_mass])
        burnt = {} if self._combustion is None else {"burnt": np.array([self._burnt_fuel, self._expanded])}
        window = {"window": np.array([self.grid.first, self.grid.cells])} if self._fitting.follows else {}
        outside = {"outside": np.array(self._outside.velocity)} if self._outer.blows else {}
        guide = {} if self.guide is None else self.guide.checkpoint()
        return {**arrays, **self.obstacles.checkpoint(), **window, **outside, **burnt, **guide, "clock": clock}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        if self._fitting.follows:
            first, cells = _window_in(arrays, self.name)
            self._move_window(Window(first, cells))
        moving = ["obstacles"] if self.obstacles.moving else []
        expected = {**dict.fromkeys([*self._arrays, *moving], self.grid.padded), "clock": (2,)}
        expected |= {"outside": (3,)} if self._outer.blows else {}
        if self._combustion is not None:
            expected["burnt"] = (2,)
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                found = f"shape {arrays[name].shape}" if name in arrays else "nothing"
                raise ValueError(f'checkpoint of smoke "{self.name}": {name} must have shape {shape}, got {found}')
        for name, values in self._arrays.items():
            values.from_numpy(np.ascontiguousarray(arrays[name], np.float32).ravel())
        if moving:
            self.obstacles.restore(arrays["obstacles"])
            self._follow_obstacles()
        self.time_s, self._emitted_mass = arrays["clock"].tolist()
        if self._outer.blows:
            x, y, z = arrays["outside"].tolist()
            self._outside.velocity = x, y, z
        if self._combustion is not None:
            self._burnt_fuel, self._expanded = arrays["burnt"].tolist()
        if self.guide is not None:
            self.guide.restore(arrays, self.time_s)

    def diagnostics(self) -> Diagnostics:
        """Totals of the state, and the projections of the frame.

        `mass` and `emitted_mass` are integrals of density over the open parts of cells [m³]; `iterations` is the sum
        over the frame, `residual` (max|div u| h / max|u|) and `divergence` [1/s] are the worst of the frame. Where
        obstacles may move there is also `compression` [1/s], the worst of the frame (`ProjectionReport`). Where fuel
        burns its soot counts as emitted, and there are the integrals of the fuel, of what has burnt so far, and the
        volume by which gas has expanded [m³]. With a guide `not_converged` counts its solves too, and there is
        `guide_correlation`, of its velocity and this one [-].
        """
        speed, _ = self._find_speed_and_acceleration()
        volume = self.obstacles.open_volume().astype(np.float64)
        excess = self._cells("excess_temperature")[volume > 0.0]
        numbers = {
            "mass": float((self._cells("density") * volume).sum()) * self.grid.cell_size**3,
            "emitted_mass": self._emitted_mass,
            "max_temperature": self.parameters.ambient_temperature + (float(excess.max()) if len(excess) else 0.0),
            "max_speed": speed,
            "iterations": float(sum(report.iterations for report in self._projections)),
            "residual": max((report.residual for report in self._projections), default=0.0),
            "divergence": max((report.divergence for report in self._projections), default=0.0),
            "not_converged": float(self.unfinished_solves),
        }
        if self._combustion is not None:
            numbers["fuel"] = float((self._cells("fuel") * volume).sum()) * self.grid.cell_size**3
            numbers |= {"burnt_fuel": self._burnt_fuel, "expanded": self._expanded}
        if self._fitting.follows:
            numbers["cells"] = float(np.prod(self.grid.cells))
        if self.guide is not None:
            numbers["guide_correlation"] = self.guide.correlation(self.air, self.grid)
            numbers["not_converged"] += self.guide.unfinished_solves()
        if self.obstacles.moving:
            numbers["compression"] = max((report.compression for report in self._projections), default=0.0)
        return numbers

    @property
    def unfinished_solves(self) -> int:
        """Projections of the frame that have hit their limit."""
        return sum(not report.converged for report in self._projections)

    def remedies(self) -> Remedies:
        """Smaller steps; larger cells, or slower air, cross less in one."""
        return Remedies(
            runaway="give it a smaller cfl, or slower or cooler sources",
            short_steps="give it slower or cooler sources, or a larger cell_size",
        )

    def first_bad_quantity(self) -> str | None:
        """The first field with a value that is no number, or a velocity beyond all reason."""
        for name, values in self._arrays.items():
            count = _count_not_finite(values)
            if count:
                return f"{name} is not finite at {count} places"
        speed, _ = self._find_speed_and_acceleration()
        return f"max_speed is {speed:.3g} m/s" if speed > RUNAWAY_SPEED else None

    def _accelerate(self, dt: float) -> None:
        accelerate(self.air, self.parameters, self._gravity, self._projection.work[:4], dt)
        if self._turbulence is not None:
            self._turbulence.accelerate(self.air, self.time_s + 0.5 * dt, dt)
        for force in self.air_forces:
            force.accelerate(dt)
        if self.guide is not None:
            self.guide.draw(self.air, self.grid, self.time_s + dt, dt)
        self._outside.advance(dt)

    def _emit(self, dt: float) -> None:
        for source in self.sources:
            if source.parameters.emits_during(self.time_s, self.time_s + dt):
                self._emitted_mass += source.emit(self.air, self.time_s, dt) * self.grid.cell_size**3
                if self._combustion is not None and source.parameters.fuel > 0.0:
                    source.add_fuel(self.air, self._combustion.fuel, self.time_s, dt)

    def _burn(self, dt: float) -> None:
        if self._combustion is not None:
            burnt, grown = self._combustion.burn(self.air, dt, self._rows)
            volume = self.grid.cell_size**3
            self._burnt_fuel += burnt * volume
            self._expanded += grown * volume
            self._emitted_mass += self._combustion.parameters.soot * burnt * volume

    def _follow_obstacles(self) -> None:
        self._projection.update()
        self._extrapolation.update()

    def _cells(self, name: str) -> NDArray[np.float32]:
        return self.grid.trim(copied(self._arrays[name]), self.grid.cells)

    def _faces(self, name: str, axis: int) -> NDArray[np.float32]:
        return self.grid.trim(copied(self._arrays[name]), self.grid.face_shape(axis))

    def _buoyancy_bound(self, excess: float, density: float) -> float:
        if not self._has_gravity:
            return 0.0
        return self._lift * abs(excess) + self.parameters.buoyancy_density * density

    def _find_speed_and_acceleration(self) -> tuple[float, float]:
        """Largest face velocity [m/s] and a bound of the largest buoyant acceleration [m/s²]."""
        alpha = self.parameters.buoyancy_density if self._has_gravity else 0.0
        beta = self._lift if self._has_gravity else 0.0
        speed, acceleration = _find_speed_and_acceleration(self.air, alpha, beta, self._rows)
        return speed, acceleration


def _window_in(arrays: Arrays, name: str) -> tuple[Index3, Index3]:
    """First cell and cells of the window of a checkpoint. Raises ValueError when it has none."""
    window = arrays.get("window")
    if window is None or window.shape != (2, 3) or (window[1] < 1).any():
        raise ValueError(f'checkpoint of smoke "{name}": window must be two cells, got {window}')
    (a, b, c), (d, e, f) = window.tolist()
    return (a, b, c), (d, e, f)


@kernel
def _find_speed_and_acceleration(air: Air, alpha: ti.f32, beta: ti.f32, rows: Rows) -> Pair:
    box, state, velocity = ti.static((air.box, air.state, air.state.velocity))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        speed = 0.0
        acceleration = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            u, v, w = velocity.x[at], velocity.y[at], velocity.z[at]
            u_next, v_next, w_next = velocity.x[at + box.step_x], velocity.y[at + box.step_y], velocity.z[at + 1]
            lower = ti.max(ti.abs(u), ti.abs(v), ti.abs(w))
            upper = ti.max(ti.abs(u_next), ti.abs(v_next), ti.abs(w_next))
            speed = ti.max(speed, lower, upper)
            acceleration = ti.max(acceleration, alpha * state.density[at] + beta * ti.abs(state.excess[at]))
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([speed, acceleration])
    find_maxima(rows)
    return rows.nodes[0]


@kernel
def _count_not_finite(values: Floats) -> ti.i32:
    count = 0
    for at in range(values.shape[0]):
        count += 1 - is_finite(values[at])
    return count
