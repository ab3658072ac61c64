"""Cloths: nodes with mass on springs, in air, held by pins."""

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.contacts import ClothContacts
from sim.cloth.device_springs import DeviceSprings
from sim.cloth.explicit import ExplicitSprings
from sim.cloth.motion import blow_on_triangles, finish_step, predict_displacement
from sim.cloth.parameters import DEFAULT_SUBSTEPS, ClothParameters, shared_conflicts
from sim.cloth.pins import Pins
from sim.cloth.sheet import build_sheet, triangle_areas
from sim.cloth.springs import joined_springs, springs_of
from sim.cloth.stable_step import too_few_substeps
from sim.cloth.state import ClothState, HostCloths
from sim.cloth.totals import ClothTotals
from sim.cloth.xpbd import XPBDSprings
from sim.parameters import Vector3
from sim.scene import DomainParameters
from sim.snapshots import Snapshot
from sim.solver import Arrays, Diagnostics

SOLVER_NAME = "cloth"

INTEGRATORS = {"xpbd": XPBDSprings, "explicit": ExplicitSprings}

LOST_DISTANCE = 10.0
"""Cloth stops this far out, in diagonals of the domain: it fell out of sight."""

RUNAWAY_SPEED = 1.0e4
"""No cloth of a film moves at thirty times the speed of sound [m/s]."""

ACCURATE_SHARE = 0.34
"""Share of the longest stable step that explicit springs take if no number of substeps is given: the energy of a sheet
that swings undamped for 10 s then stays within 0.3 %, and the error falls with the square of the step."""

LIVE_KEYS = frozenset(
    ("mass_per_area", "stretch_stiffness", "shear_stiffness", "bend_stiffness", "damping", "bend_damping", "thickness",
     "friction", "self_collision", "wind", "air_density", "drag", "skin_drag")
)  # fmt: skip
"""What may change between frames."""


class ClothSolver:
    """All cloths of a scene, as they share their substeps and collide with each other.

    One substep: pins move; gravity and air accelerate the nodes, and explicit springs; compliant springs, then contacts
    correct where that leads; velocities and positions follow from where nodes end up. Every node has its share of the
    sheet's mass (lumped), every triangle its share of the air.

    Attributes:
        state: of all nodes.
        parameters: of the cloths, as they are now.
        gravity: [m/s²]; may be changed between frames.
        contacts: resolved in this order in every substep.
        air_velocity: of the air at each triangle [m/s], (k,) vec3: the wind, unless a coupling writes there.
        air_force: of the air on each triangle in the last substep [N], (k,) vec3.
        warnings: what was repaired in meshes, a sentence each.

    Args:
        parameters: the cloths, in the order of the job.
        domain: cloth may come ten of its diagonals away from it.
        gravity: [m/s²].
        frames_per_second: substeps are counted per frame [1/s].

    Raises:
        ShapeError: a mesh cannot be read, or is no sheet.
        ValueError: cloths that cannot step together, a pin that holds nothing, too few substeps for explicit springs.
    """

    def __init__(
        self,
        parameters: Sequence[ClothParameters],
        *,
        domain: DomainParameters,
        gravity: Vector3,
        frames_per_second: float,
    ) -> None:
        self.name = SOLVER_NAME
        self.parameters = tuple(parameters)
        if conflicts := shared_conflicts(self.parameters):
            number, key, message = conflicts[0]
            raise ValueError(f'cloth "{self.parameters[number].name}": {key} {message}')
        sheets = [build_sheet(cloth.shape) for cloth in self.parameters]
        self.warnings = tuple(warning for sheet in sheets for warning in sheet.warnings)
        host = HostCloths.of(self.parameters, sheets)
        self.state = ClothState(host, reach=_reach(domain, host.position))
        self.gravity = gravity
        self.contacts: list[ClothContacts] = []
        families = joined_springs([springs_of(sheet) for sheet in sheets], host.first_node.tolist())
        self._springs = [DeviceSprings(springs, cloth_of) for springs, cloth_of in families]
        self._integrator = INTEGRATORS[self.parameters[0].integrator](self.state, self._springs)
        self._totals = ClothTotals(self.state, self._springs)
        self._frame_dt = 1.0 / frames_per_second
        self._allocate_air()
        self._pins = Pins(self.parameters, sheets, self.state)
        self._take_parameters()
        self._time_s = 0.0
        self._hold_pins()

    def add_contacts(self, contacts: ClothContacts) -> None:
        """Resolve these too in every substep, after those that are there."""
        self.contacts.append(contacts)

    def change(self, name: str, **changes: object) -> None:
        """Change parameters of a cloth between frames, by the keys of a job; nothing is built anew.

        Raises:
            ValueError: a key that cannot change, or a value that it cannot have; nothing has changed then.
        """
        if fixed := set(changes) - LIVE_KEYS:
            raise ValueError(f"{min(fixed)} of a cloth cannot change while it is simulated; build it anew")
        number = self.state.names.index(name)
        changed = ClothParameters.model_validate({**self.parameters[number].model_dump(exclude_unset=True), **changes})
        before = self.parameters
        try:
            self._adopt((*before[:number], changed, *before[number + 1 :]))
        except ValueError:
            self._adopt(before)  # what explicit springs bear is known once they have their stiffness
            raise

    def _adopt(self, parameters: tuple[ClothParameters, ...]) -> None:
        """Step with these parameters from now on."""
        self.parameters = parameters
        self._take_parameters()
        self._pins.hold_anew()
        self._own_dt = self._largest_dt()

    # --- the step ---------------------------------------------------------------------------------------------------

    def stable_dt(self) -> float:
        """Largest step [s]: the share of a frame that was asked for, what springs bear, what contacts bear."""
        return min([self._own_dt, *(contacts.stable_dt(self.state) for contacts in self.contacts)])

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._hold_pins()
        self._integrator.accelerate(dt)
        self._predict(dt)
        self._pins.displace(self._time_s, dt)
        self._integrator.displace(dt)
        for contacts in self.contacts:
            contacts.resolve(self.state, dt)
        state = self.state
        finish_step(
            state.displacement, state.quantum, state.limit, dt, state.lattice, state.position, state.carry,
            state.velocity,
        )  # fmt: skip
        self._time_s += dt

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s` [s]."""
        self._time_s = time_s
        self._hold_pins()  # as `restore` does: both take their first step from what pins hold now
        for contacts in self.contacts:
            contacts.begin_frame()

    def synchronize(self) -> None:
        """Wait until the device has done all that it was asked to, as measurements of time need."""
        ti.sync()

    def _predict(self, dt: float) -> None:
        """Gravity and air."""
        state, gravity = self.state, ti.math.vec3(*self.gravity)
        if self._is_windy:
            blow_on_triangles(
                state.position, state.velocity, state.triangles, self.air_velocity, self._drag,
                self._air_share, gravity, dt, self.air_force,
            )  # fmt: skip
        predict_displacement(
            state.velocity, state.carry, state.inverse_mass, self.air_force, self._air_share, self._triangle_start,
            self._triangle_list, int(self._is_windy), gravity, dt, state.displacement,
        )  # fmt: skip

    def _hold_pins(self) -> None:
        if self._pins.hold(self._time_s):
            self._own_dt = self._largest_dt()

    # --- what it is built from --------------------------------------------------------------------------------------

    def _allocate_air(self) -> None:
        """Velocities and forces of the air; the triangles of each node in ascending order, and its share of each.

        The share is the node's area over that of its triangles, so that a flat sheet is pushed alike everywhere: 1/3 in
        meshes; 1/2 or 1/4 in rectangles, whose nodes have four triangles or eight. A triangle's shares sum to 1.
        """
        host, count = self.state.host, self.state.triangle_count
        triangles = host.triangles
        self.air_velocity = ti.Vector.ndarray(3, ti.f32, count)
        self.air_force = ti.Vector.ndarray(3, ti.f32, count)
        self._drag = ti.Vector.ndarray(3, ti.f32, count)
        order = np.argsort(triangles.ravel(), kind="stable")
        start = np.searchsorted(triangles.ravel()[order], np.arange(self.state.vertex_count + 1))
        self._triangle_start = ti.ndarray(ti.i32, len(start))
        self._triangle_start.from_numpy(start.astype(np.int32))
        self._triangle_list = ti.ndarray(ti.i32, len(order))
        self._triangle_list.from_numpy((order // 3).astype(np.int32))
        around = np.bincount(triangles.ravel(), weights=np.repeat(triangle_areas(host.position, triangles), 3))
        self._air_share = ti.ndarray(ti.f32, self.state.vertex_count)
        self._air_share.from_numpy((host.node_area / around).astype(np.float32))

    def _take_parameters(self) -> None:
        """Masses, surfaces, stiffness and air as the parameters have them now."""
        cloths, host = self.parameters, self.state.host
        self.state.set_material(cloths)
        for springs in self._springs:
            springs.set_material(cloths)
        drag = [
            [0.5 * cloth.air_density * cloth.drag for cloth in cloths],
            [0.5 * cloth.air_density * cloth.skin_drag for cloth in cloths],
            [cloth.mass_per_area for cloth in cloths],
        ]
        self._drag.from_numpy(np.stack([host.of_triangles(each) for each in drag], axis=1).astype(np.float32))
        wind = [host.of_triangles([cloth.wind[axis] for cloth in cloths]) for axis in range(3)]
        self.air_velocity.from_numpy(np.stack(wind, axis=1).astype(np.float32))
        self._is_windy = any(cloth.air_density * (cloth.drag + cloth.skin_drag) > 0.0 for cloth in cloths)
        self._mass = float(self.state.mass.to_numpy().sum(dtype=np.float64))

    def _largest_dt(self) -> float:
        """Largest step [s] without contacts.

        Raises:
            ValueError: the share of a frame that was asked for is longer than what explicit springs bear.
        """
        first, stable_dt = self.parameters[0], self._integrator.stable_dt()
        if first.substeps is None:
            return min(self._frame_dt / DEFAULT_SUBSTEPS, ACCURATE_SHARE * stable_dt)
        if reason := too_few_substeps(first.substeps, self._frame_dt, stable_dt):
            raise ValueError(f'cloth "{first.name}": {reason}')
        return self._frame_dt / first.substeps

    # --- what goes out ----------------------------------------------------------------------------------------------

    def snapshots(self) -> dict[str, Snapshot]:
        """Each cloth: its nodes, and the triangles between them."""
        host = self.state.host
        position = self.state.positions().astype(np.float32)
        velocity = self.state.velocity.to_numpy()
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

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Where nodes are and how they move, and the time."""
        state = self.state
        arrays = {name: getattr(state, name).to_numpy() for name in _STATE}
        return {**arrays, "clock": np.array([self._time_s])}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        expected = {**dict.fromkeys(_STATE, (self.state.vertex_count, 3)), "clock": (1,)}
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                found = f"shape {arrays[name].shape}" if name in arrays else "nothing"
                raise ValueError(f"checkpoint of the cloth: {name} must have shape {shape}, got {found}")
        for name, kind in _STATE.items():
            getattr(self.state, name).from_numpy(np.ascontiguousarray(arrays[name], dtype=kind))
        self.state.place_displaced()
        self._time_s = float(arrays["clock"][0])
        self._hold_pins()

    def diagnostics(self) -> Diagnostics:
        """Totals of all cloths, sums in float32; `max_strain` [-] is of springs between two nodes.

        `potential_energy` [J] is zero at the origin; `nodes_lost` were stopped far outside of the domain.
        """
        nodes = self._totals.of_nodes(self.gravity)
        lost = nodes.pop("lost")
        del nodes["not_finite"]
        contacts = {name: value for each in self.contacts for name, value in each.diagnostics().items()}
        return {
            "mass": self._mass,
            "node_count": float(self.state.vertex_count),
            **nodes,
            **self._totals.of_springs(),
            "nodes_lost": lost,
            **contacts,
        }

    def first_bad_quantity(self) -> str | None:
        """Nodes whose motion is not finite, or beyond all reason."""
        totals = self._totals.of_nodes(self.gravity)
        if totals["not_finite"]:
            return f"velocity is not finite at {totals['not_finite']:.0f} nodes"
        speed = totals["max_speed"]
        return f"max_speed is {speed:.3g} m/s" if speed > RUNAWAY_SPEED else None


_STATE = {"lattice": np.int32, "carry": np.float32, "velocity": np.float32}
"""Arrays of the state that a restart needs, each (n, 3)."""


def _reach(domain: DomainParameters, positions: NDArray[np.float64]) -> float:
    """How far from the origin, along an axis, cloth may come [m]."""
    corners = np.concatenate([np.array([domain.min, domain.max]), positions])
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return float(np.abs(corners).max()) + LOST_DISTANCE * diagonal
