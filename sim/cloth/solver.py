"""Cloths: nodes with mass on springs, in air, held by pins."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.air import ClothAir, push_nodes
from sim.cloth.continuous_contacts import ContinuousContacts, SpringTurns
from sim.cloth.device_springs import DeviceCells, DeviceSprings
from sim.cloth.integrators import ExplicitSprings, XPBDSprings
from sim.cloth.parameters import (
    DEFAULT_SUBSTEPS,
    MOST_REFINED,
    MOST_SWEEPS,
    RUNAWAY_SPEED,
    ClothParameters,
    shared_conflicts,
    substeps_of,
)
from sim.cloth.pins import Pins
from sim.cloth.sheet import build_sheet
from sim.cloth.springs import ACCURATE_SHARE, cells_of, joined, springs_of, too_few_substeps
from sim.cloth.start import reach_of, too_coarse_positions
from sim.cloth.state import ClothState, HostCloths, Load, finish_step
from sim.cloth.totals import ClothTotals
from sim.core.domain import DomainParameters
from sim.core.host_access import add, copied, viewed
from sim.core.parameters import Vector3
from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Diagnostics, Remedies
from sim.forces.field import ForceField

SOLVER_NAME = "cloth"

INTEGRATORS = {"xpbd": XPBDSprings, "explicit": ExplicitSprings}

REFINED_BEYOND, RESTORED_BELOW, LENGTHENED_BELOW = 0.05, 0.02, 0.035
"""Excess of a spring [rest lengths] beyond which the next step has twice as many sweeps, or half the length; below
which sweeps go back, and below which steps do: turns end between both (`RELAXED_BEYOND`). It falls with every turn and
sweep, and with the square of the step."""

FIXED_KEYS = frozenset(
    ("name", "shape", "position", "rotation_deg", "velocity", "material", "pin", "integrator", "substeps", "iterations")
)
"""What cannot change between frames; all else can."""


class ClothSolver:
    """All cloths of a scene, as they share their substeps and collide with each other.

    One substep: pins move; gravity and air accelerate the nodes, and explicit springs; compliant springs, then contacts
    correct where that leads; velocities and positions follow from where nodes end up.

    Attributes:
        state: of all nodes.
        parameters: of the cloths, as they are now.
        gravity: [m/s²]; may be changed between frames.
        contacts: of the cloths with each other, bodies and walls; None where they pass through all.
        loads: what couplings lay onto the nodes in every substep.
        air: at every triangle, the wind unless a coupling puts other air there.
        warnings: what was repaired in meshes, a sentence each.

    Args:
        parameters: the cloths, in the order of the job.
        domain: cloth may come ten of its diagonals away from it.
        gravity: [m/s²].
        frames_per_second: substeps are counted per frame [1/s].
        forces: from outside; none if omitted.

    Raises:
        ShapeError: a mesh cannot be read, or is no sheet.
        ValueError: cloths that cannot step together, a pin that holds nothing, too few substeps for explicit springs,
            a scene so large that positions are too coarse.
    """

    def __init__(
        self,
        parameters: Sequence[ClothParameters],
        *,
        domain: DomainParameters,
        gravity: Vector3,
        frames_per_second: float,
        forces: ForceField | None = None,
    ) -> None:
        self.name = SOLVER_NAME
        self.parameters = tuple(parameters)
        if conflicts := shared_conflicts(self.parameters):
            number, key, message = conflicts[0]
            raise ValueError(f'cloth "{self.parameters[number].name}": {key} {message}')
        sheets = [build_sheet(cloth.shape) for cloth in self.parameters]
        self.warnings = tuple(warning for sheet in sheets for warning in sheet.warnings)
        host = HostCloths.of(self.parameters, sheets)
        reach = reach_of(domain, host.position)
        for cloth, (first, end) in zip(self.parameters, pairwise(host.first_node), strict=True):
            if reason := too_coarse_positions(cloth, host.position[first:end], reach):
                raise ValueError(f'cloth "{cloth.name}": {reason}')
        self.state = ClothState(host, reach=reach)
        self.gravity = gravity
        self.contacts: ContinuousContacts | None = None
        self.loads: list[Load] = []
        shared = self.parameters[0]
        first_nodes = host.first_node.tolist()
        groups = [(cloth.iterations or 0, cloth.substeps is None) for cloth in self.parameters]
        springs, cells = (
            joined([elements_of(sheet) for sheet in sheets], first_nodes, groups=groups)
            for elements_of in (springs_of, lambda sheet: [cells_of(sheet)])
        )
        self._springs = [DeviceSprings(*family) for family in springs]
        self._cells = [DeviceCells(*family) for family in cells]
        self._integrator = INTEGRATORS[shared.integrator](self.state, self._springs, self._cells)
        self._totals = ClothTotals(self.state, self._springs, self._cells)
        self._frame_dt = 1.0 / frames_per_second
        self.air = ClothAir(self.state)
        self._forces = (forces or ForceField(())).on([(name,) for name in self.state.names])
        self._pins = Pins(self.parameters, sheets, self.state)
        self._take_parameters()
        self._time_s = 0.0
        self._no_reasons = ti.ndarray(ti.i32, 3)
        self._no_reasons.fill(0)
        self._sweeps = self._refinement = 1
        self._excess = 0.0
        self._hold_pins()

    def change(self, name: str, **changes: object) -> None:
        """Change parameters of a cloth between frames, by the keys of a job; nothing is built anew.

        Raises:
            ValueError: a key that cannot change, or a value that it cannot have; nothing has changed then.
        """
        if fixed := set(changes) - (ClothParameters.model_fields.keys() - FIXED_KEYS):
            raise ValueError(f"{min(fixed)} of a cloth cannot change while it is simulated; build it anew")
        number = self.state.names.index(name)
        changed = ClothParameters.model_validate({**self.parameters[number].model_dump(exclude_unset=True), **changes})
        self._change_to((*self.parameters[:number], changed, *self.parameters[number + 1 :]))

    def take_substeps(self, count: int) -> None:
        """Take so many substeps a frame from now on, all cloths of the scene, as they share them; between frames.

        Raises:
            ValueError: below 1, or too few for explicit springs; nothing has changed then.
        """
        self._change_to(
            tuple(
                ClothParameters.model_validate({**cloth.model_dump(exclude_unset=True), "substeps": count})
                for cloth in self.parameters
            )
        )

    def hold(
        self, name: str, nodes: Sequence[int], *, shift: Vector3 = (0.0, 0.0, 0.0), within_s: float | None = None
    ) -> None:
        """Hold nodes of a cloth from now on, as a hand would, and lead them straight by a way; between frames.

        Called again for the same nodes, it leads them on; nodes of a pin with keyframes leave its path. A checkpoint
        does not know of it. What was sized when the scene was built does not follow: the speeds that a fluid expects,
        and the stiffness that it has from them.

        Args:
            name: of the cloth.
            nodes: their numbers in the cloth, as in its snapshot.
            shift: the way, from where they are [m].
            within_s: time that it takes [s]; a frame if omitted.

        Raises:
            ValueError: there is no such cloth or node; the way is not finite, or takes no time.
        """
        numbers = self._nodes_of(name, nodes)
        within_s = self._frame_dt if within_s is None else within_s
        self._pins.grip(numbers, shift, time_s=self._time_s, within_s=within_s)
        self._hold_pins()

    def let_go(self, name: str, nodes: Sequence[int]) -> None:
        """Let nodes of a cloth go that `hold` or pins hold; they keep their velocity. See `hold`."""
        self._pins.let_go(self._nodes_of(name, nodes))
        self._hold_pins()

    def put_eyelets(self, nodes: NDArray[np.int64], mass: NDArray[np.float64]) -> None:
        """Let nodes, by their numbers in the scene, weigh so much more [kg], (h,), for good."""
        self.state.eyelets[nodes] += mass
        self._change_to(self.parameters)

    def _nodes_of(self, name: str, nodes: Sequence[int]) -> NDArray[np.int64]:
        """Numbers of a cloth's nodes in the scene."""
        if name not in self.state.names:
            raise ValueError(f'no cloth is named "{name}"; cloths are {", ".join(self.state.names)}')
        rows, numbers = self._rows_of(name), np.unique(np.asarray(nodes, dtype=np.int64))
        if not len(numbers) or numbers[0] < 0 or numbers[-1] >= rows.stop - rows.start:
            raise ValueError(f'nodes of cloth "{name}" are 0 to {rows.stop - rows.start - 1}, got {list(nodes)}')
        return numbers + rows.start

    def _change_to(self, parameters: tuple[ClothParameters, ...]) -> None:
        """Adopt parameters, or keep those that are there and raise ValueError if the solver cannot have them."""
        before = self.parameters
        try:
            self._adopt(parameters)
        except ValueError:
            self._adopt(before)  # what explicit springs bear is known once they have their stiffness
            raise

    def _adopt(self, parameters: tuple[ClothParameters, ...]) -> None:
        """Step with these parameters from now on."""
        self.parameters = parameters
        self._take_parameters()
        self._pins.hold_anew()
        self._asked_dt, self._free_dt = self._largest_dts()

    # --- the step ---------------------------------------------------------------------------------------------------

    def stable_dt(self) -> float:
        """Largest step [s]: the share of a frame that was asked for, what springs bear, what contacts bear.

        Of cloths for which no number of substeps is given, a fraction of that while contacts leave their springs longer
        than their tension makes them.
        """
        dt = min(self._asked_dt, self._free_dt / self._refinement)
        return dt if self.contacts is None else self.contacts.stable_dt(dt)

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._hold_pins()
        for load in self.loads:
            load.put_on(self.state, self.gravity, dt)
        if self._forces.accelerates:
            state = self.state
            push_nodes(state.nodes, state.position, state.body, state.carried, self._forces.now, dt)
        if self._forces.blows and self.air.acts:
            self.air.blow(self._forces)
        self._integrator.accelerate(dt)
        self.air.predict(self.gravity, dt)
        self._pins.displace(self._time_s, dt)
        self._displace(dt)
        for load in reversed(self.loads):
            load.take_off(self.state)
        self._time_s += dt

    def _displace(self, dt: float) -> None:
        """Springs and contacts in turns, and where they lead; as these leave springs too long, the next step has more
        sweeps, or is shorter.

        Sweeps adapt to cloths that omit both keys, turns are taken by those that omit `iterations`, and steps are
        shortened for those that omit `substeps`.
        """
        state, integrator = self.state, self._integrator
        integrator.displace(dt, np.where(self._adapts, self._sweeps, self._iterations))
        is_loose = self._excess > RESTORED_BELOW or self._sweeps > 1  # else it does not matter by what
        turns = SpringTurns(integrator, dt, self._takes_turns)
        if self._adapts.any() and is_loose:
            turns.measure()
        by_springs = float(turns.excess[self._adapts].max()) if turns.is_measured else 0.0

        def conclude(reasons: ti.Ndarray) -> None:
            if not turns.is_measured:
                turns.measure()
            finish_step(state.nodes, state.position, state.limit, dt, reasons)

        if self.contacts is None or not self.contacts.resolve(dt, turns, conclude):
            conclude(self._no_reasons)
        excess = turns.excess
        self._excess = float(excess[self._refines].max(initial=0.0))
        if by_springs > REFINED_BEYOND and self._sweeps < MOST_SWEEPS:
            self._sweeps *= 2
        elif is_loose and self._excess > REFINED_BEYOND:
            self._refinement = min(2 * self._refinement, MOST_REFINED)
        elif self._excess < LENGTHENED_BELOW and turns.taken < 2:
            self._refinement = max(self._refinement // 2, 1)
        if by_springs < RESTORED_BELOW:
            self._sweeps = max(self._sweeps // 2, 1)

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s` [s]."""
        self._time_s = time_s
        self._hold_pins()  # as `restore` does: both take their first step from what pins hold now
        if self.contacts is not None:
            self.contacts.begin_frame()

    def synchronize(self) -> None:
        """Wait until the device has done all that it was asked to, as measurements of time need."""
        ti.sync()

    def _hold_pins(self) -> None:
        if self._pins.hold(self._time_s):
            self._asked_dt, self._free_dt = self._largest_dts()

    # --- what it is built from --------------------------------------------------------------------------------------

    def _take_parameters(self) -> None:
        """Masses, surfaces, stiffness and air as the parameters have them now."""
        cloths = self.parameters
        self.state.set_material(cloths)
        for family in (*self._springs, *self._cells):
            family.set_material(cloths)
        self._integrator.take_parameters()
        self._integrator.usual_dt = self._frame_dt / substeps_of(cloths)
        self._iterations = np.array([cloth.iterations or 1 for cloth in cloths])
        self._takes_turns = np.array([cloth.iterations is None for cloth in cloths])
        self._refines = np.array([cloth.substeps is None for cloth in cloths])
        self._adapts = self._takes_turns & self._refines
        self.air.take_parameters(cloths)
        self._mass = float(self.state.mass.to_numpy().sum(dtype=np.float64))

    def _largest_dts(self) -> tuple[float, float]:
        """Largest step without contacts [s]: of cloths that are given `substeps`, and of those that omit it.

        Raises:
            ValueError: the share of a frame that was asked for is longer than what explicit springs bear.
        """
        frame_dt, free_dt = self._frame_dt, np.inf
        if self._refines.any():
            free_dt = min(frame_dt / DEFAULT_SUBSTEPS, ACCURATE_SHARE * self._integrator.stable_dt(self._refines))
        asking = max(self.parameters, key=lambda cloth: cloth.substeps or 0)
        if asking.substeps is None:
            return np.inf, free_dt
        stable_dt = self._integrator.stable_dt()
        if min(frame_dt / asking.substeps, free_dt) > stable_dt:
            raise ValueError(f'cloth "{asking.name}": {too_few_substeps(asking.substeps, frame_dt, stable_dt)}')
        return frame_dt / asking.substeps, free_dt

    # --- what goes out ----------------------------------------------------------------------------------------------

    def snapshots(self) -> dict[str, Snapshot]:
        """Each cloth: its nodes, and the triangles between them."""
        host = self.state.host
        position = self.state.positions().astype(np.float32)
        velocity = copied(self.state.velocity)
        snapshots = {}
        for number, cloth in enumerate(self.parameters):
            first, last = host.first_node[number : number + 2]
            own = slice(*host.first_triangle[number : number + 2])
            arrays = {
                "position": position[first:last],
                "velocity": velocity[first:last],
                "triangles": host.triangles[own] - np.int32(first),
                "uv": host.uv[first:last].astype(np.float32),
            }
            snapshots[cloth.name] = Snapshot("cloth", arrays, {"thickness": cloth.thickness})
        return snapshots

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:
        """Positions [m] and velocities [m/s] of a cloth's nodes, in the solver's memory on a CPU."""
        rows = self._rows_of(body)
        return {name: viewed(getattr(self.state, name))[rows] for name in ("position", "velocity")}

    def push(self, body: str, change: NDArray[np.floating]) -> None:
        """Change the velocities of a cloth's nodes by (n, 3) or (3,) [m/s]; those that pins hold keep theirs."""
        rows = self._rows_of(body)
        is_free = viewed(self.state.inverse_mass)[rows, None] > 0.0
        add(self.state.velocity, rows, np.where(is_free, change, 0.0))

    def _rows_of(self, body: str) -> slice:
        first, last = self.state.host.first_node[self.state.names.index(body) :][:2]
        return slice(int(first), int(last))

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Where nodes are and how they and strains move; the time, how many sweeps steps take, how they are divided and
        why, and how long the last one was.
        """
        state = self.state
        arrays = {name: getattr(state, name).to_numpy() for name in _STATE}
        arrays |= {f"strain_{k}": cells.on_device.followed.to_numpy() for k, cells in enumerate(self._cells)}
        clock = self._time_s, self._sweeps, self._refinement, self._excess, self._integrator.last_dt
        return {**arrays, "clock": np.array(clock)}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        expected = {**dict.fromkeys(_STATE, (self.state.vertex_count, 3)), "clock": (5,)}
        expected |= {f"strain_{k}": (*cells.on_device.followed.shape, 2) for k, cells in enumerate(self._cells)}
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                found = f"shape {arrays[name].shape}" if name in arrays else "nothing"
                raise ValueError(f"checkpoint of the cloth: {name} must have shape {shape}, got {found}")
        for name, kind in _STATE.items():
            getattr(self.state, name).from_numpy(np.ascontiguousarray(arrays[name], dtype=kind))
        for k, cells in enumerate(self._cells):
            cells.on_device.followed.from_numpy(np.ascontiguousarray(arrays[f"strain_{k}"], dtype=np.float32))
        self.state.place_displaced()
        self._time_s, sweeps, refinement, self._excess, self._integrator.last_dt = arrays["clock"].tolist()
        self._sweeps, self._refinement = int(sweeps), int(refinement)
        self._hold_pins()

    def diagnostics(self) -> Diagnostics:
        """Totals of all cloths, sums in float32; `max_strain` [-] is of springs between two nodes.

        `potential_energy` [J] is zero at the origin; `nodes_lost` were stopped far outside of the domain.
        """
        nodes = self._totals.of_nodes(self.gravity)
        lost = nodes.pop("lost")
        del nodes["not_finite"]
        return {
            "mass": self._mass,
            "node_count": float(self.state.vertex_count),
            **nodes,
            **self._totals.of_springs(),
            **self._integrator.diagnostics(),
            "nodes_lost": lost,
            **({} if self.contacts is None else self.contacts.diagnostics()),
        }

    def remedies(self) -> Remedies:
        """Softer cloth, more steps, or springs that are stable at any; slower wind, pins and bodies."""
        if self.parameters[0].integrator == "explicit":
            return Remedies(
                runaway='give more substeps, a softer stretch_stiffness, or use integrator = "xpbd"',
                short_steps='give a softer stretch_stiffness or a coarser sheet, or use integrator = "xpbd"',
            )
        return Remedies(
            runaway="give more substeps, a softer stretch_stiffness, or slower wind and pins",
            short_steps="give lower speeds to cloth, pins and bodies, or make small bodies larger",
        )

    def first_bad_quantity(self) -> str | None:
        """Nodes whose motion is not finite, or beyond all reason."""
        totals = self._totals.of_nodes(self.gravity)
        if totals["not_finite"]:
            return f"velocity is not finite at {totals['not_finite']:.0f} nodes"
        speed = totals["max_speed"]
        return f"max_speed is {speed:.3g} m/s" if speed > RUNAWAY_SPEED else None


_STATE = {"lattice": np.int32, "carry": np.float32, "velocity": np.float32, "elastic": np.float32}
"""Arrays of the state that a restart needs, each (n, 3)."""
