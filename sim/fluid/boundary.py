"""Boundary samples on the device: of walls and static bodies, then of bodies that move, then of sheets."""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.cells import CellGrid, CellSort, Grid, SortArrays, SortedPoints, counting_sort
from sim.core.host_access import put
from sim.core.launch import kernel
from sim.core.solver import Arrays
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import Discretization

FAR = 1.0e30  # coordinate that no sample reaches [m]
EVERYWHERE = (-FAR,) * 3, (FAR,) * 3  # corners of a box that holds every sample [m]
STATE_WIDTH = 18  # numbers of a body's state: centre of mass, rotation row by row, velocity, angular velocity
NO_BODY = 2**31 - 1  # stands for the number of a body where there is none
WRENCH_WIDTH = 6  # numbers of a force with its torque


@bundle
class Samples(NamedTuple):
    """Boundary samples as sums over neighbours read them: fixed ones by cell, those of bodies, those of sheets."""

    position: Vectors  # [m], (m,)
    velocity: Vectors  # [m/s], (m,); 0 for the fixed ones
    volume: Floats  # V_b [m³], (m,)
    friction_volume: Floats  # V_b as friction counts it [m³], 0 for samples without friction, (m,)
    with_moving: ti.template()  # whether any sample moves
    behind: Vectors  # normals of sheets, as long as their samples are felt behind them [m]; 0 for all others
    with_sheets: ti.template()  # whether there are sheets; `behind` is empty without


@bundle
class Bodies(NamedTuple):
    """Moving bodies and their samples, which are numbered from 0 here."""

    first: ti.i32  # index of the first sample of a body among all samples
    sample_count: ti.i32  # samples of all bodies
    body: Integers  # number of the body that each moving sample moves with, `NO_BODY` for those of sheets, (moving,)
    count: ti.i32  # bodies
    members: Integers  # the bodies that move with the first, then those that move with the next, (bodies,)
    first_member: Integers  # where those of each begin there, and the end, (bodies + 1,)
    states: Floats  # centre of mass, rotation, velocity and angular velocity of the first, then of the next body


@bundle
class Sheets(NamedTuple):
    """Samples of sheets, which are numbered from 0 here."""

    first: ti.i32  # index of the first of them among all samples
    skipped: ti.i32  # and among the moving ones: as many as bodies have
    count: ti.i32


@bundle
class NearParticles(NamedTuple):
    """Particles near each moving sample b: `particles[start[b] : start[b] + count[b]]`."""

    first: ti.i32  # index of the first moving sample among all samples
    sample_count: ti.i32  # moving samples
    start: Integers  # (moving + 1,)
    count: Integers  # (moving,)
    particles: Integers  # in the order of the sorted particles


@func
def shift_behind(samples: Samples, b: ti.i32, x_i: ti.math.vec3) -> ti.math.vec3:
    """From where a particle feels a sample to the sample: those of sheets lie behind them, on whichever side it is."""
    shift = ti.math.vec3(0.0)
    if ti.static(samples.with_sheets):
        behind = samples.behind[b]
        shift = ti.select((x_i - samples.position[b]).dot(behind) < 0.0, -behind, behind)
    return shift


@func
def to_particle(samples: Samples, b: ti.i32, x_i: ti.math.vec3) -> ti.math.vec3:
    """From where a particle feels a sample to the particle [m]."""
    return x_i - samples.position[b] + shift_behind(samples, b, x_i)


class BodyStates(NamedTuple):
    """Moving bodies as they are now."""

    position: NDArray[np.float64]  # centres of mass [m], (bodies, 3)
    rotation: NDArray[np.float64]  # from body to world axes, (bodies, 3, 3)
    velocity: NDArray[np.float64]  # of the centres of mass [m/s], (bodies, 3)
    angular_velocity: NDArray[np.float64]  # [rad/s], (bodies, 3)


def states_of(rows: NDArray[np.generic]) -> BodyStates:
    """Bodies whose states stand one after the other, `STATE_WIDTH` numbers each."""
    of_bodies = rows.reshape(-1, STATE_WIDTH)
    rotations = of_bodies[:, 3:12].reshape(-1, 3, 3)
    return BodyStates(of_bodies[:, :3], rotations, of_bodies[:, 12:15], of_bodies[:, 15:])


def at_origin(count: int) -> BodyStates:
    """So many bodies at rest at the origin, unturned."""
    return BodyStates(
        np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    )


class Boundary:
    """Samples of walls and bodies, as the sums over neighbours read them.

    The fixed samples come first, sorted by cell; the moving ones follow in the order they were given, body by body, and
    after them those of sheets, which the coupling with the sheets places.

    Attributes:
        fixed_count: fixed samples near enough to the grid to matter.
        moving_count: samples of moving bodies and of sheets, `body_sample_count` and `sheet_count`.
        body_count: moving bodies.
        samples: all samples on the device.
        bodies, sheets: which samples are of bodies, and of sheets, on the device.
        index: row in the fixed samples given of each fixed sample here, (fixed,), on the host.
        body_start: first moving sample of each body, (bodies + 1,), on the host.
        mover: number of the body that each moves with, its own unless it is glued to others, (bodies,), on the host.
        reach: largest distance of a sample from the centre of mass of what it moves with [m], (bodies,), on the host.
        moving: the samples of moving bodies as they were given.
        deforming_speed: largest speed of samples in the frame of their body [m/s], (bodies,), on the host.
        moving_index: index of each of the sorted moving samples, (moving,), on the device.
    """

    def __init__(
        self,
        fixed: BoundarySamples,
        moving: BoundarySamples,
        *,
        is_smooth: NDArray[np.bool_],
        sheets: BoundarySamples,
        body_count: int,
        grid: CellGrid,
        discretization: Discretization,
    ) -> None:
        """Sort and weigh samples; those of the fixed ones that are smooth, (m,), exert no friction."""
        if (np.diff(moving.body) < 0).any() or moving.body.max(initial=-1) >= body_count:
            raise ValueError(f"moving samples must be given body by body, numbered from 0 to {body_count - 1}")
        low = np.array(grid.origin)
        high = low + grid.cell_size * np.array(grid.shape)
        near = np.flatnonzero(((fixed.positions >= low) & (fixed.positions <= high)).all(axis=1))
        self.fixed_count = len(near)
        self.body_sample_count, self.sheet_count = len(moving.positions), len(sheets.positions)
        self.moving_count = self.body_sample_count + self.sheet_count
        self.body_count = body_count
        ids = on_device(near)
        cells = CellSort(grid, self.fixed_count)
        cells.sort(on_device(fixed.positions[near]), ids, self.fixed_count, *EVERYWHERE)
        self.index: NDArray[np.int64] = near[cells.order.to_numpy()[: self.fixed_count]]
        fixed_positions = fixed.positions[self.index]
        self.fixed_points = _sorted_points(fixed_positions, cells)

        fixed_volumes, *others = (
            each.volumes(discretization.spacing, discretization.support_in_spacings) for each in (fixed, moving, sheets)
        )
        volumes = np.concatenate([fixed_volumes[self.index], *others])
        moving_positions = np.concatenate([moving.positions, sheets.positions])
        frictional = volumes.copy()
        frictional[: self.fixed_count][is_smooth[self.index]] = 0.0
        self.samples = Samples(
            position=on_device(np.concatenate([fixed_positions, moving_positions])),
            velocity=on_device(np.zeros((self.fixed_count + self.moving_count, 3), dtype=np.float32)),
            volume=on_device(volumes),
            friction_volume=on_device(frictional),
            with_moving=self.moving_count > 0,
            behind=on_device(np.zeros((self.count if self.sheet_count else 0, 3), dtype=np.float32)),
            with_sheets=self.sheet_count > 0,
        )
        no_body = np.full(self.sheet_count, NO_BODY, dtype=np.int32)
        self.bodies = Bodies(
            first=self.fixed_count,
            sample_count=self.body_sample_count,
            body=on_device(np.concatenate([moving.body, no_body])),
            count=body_count,
            members=on_device(np.arange(body_count, dtype=np.int32)),
            first_member=on_device(np.arange(body_count + 1, dtype=np.int32)),
            states=ti.ndarray(ti.f32, max(body_count, 1) * STATE_WIDTH),
        )
        self.mover = self._reference_mover = np.arange(body_count)
        self._with_others = False  # whether bodies move with others
        self._before: NDArray[np.float64] | None = None  # where samples were before bodies moved with others
        self.sheets = Sheets(self.fixed_count + self.body_sample_count, self.body_sample_count, self.sheet_count)
        self._offset, self.moving = on_device(moving.positions), moving
        self._host_offset = self._reference_offset = moving.positions
        self._own_velocity: ti.Ndarray | None = None  # of samples in the frame of their body, as soon as some deform
        self._host_own_velocity = np.zeros_like(moving.positions)
        self._host_volume = volumes[self.fixed_count : self.fixed_count + self.body_sample_count].astype(np.float32)
        self._deformed_by = 0.0
        self.deforming_speed: NDArray[np.float64] = np.zeros(body_count)
        self.body_start: NDArray[np.int64] = np.searchsorted(moving.body, np.arange(body_count + 1))
        self.reach = self._reach()
        self._host_states = self._reference_states = self.bodies.states.to_numpy()
        self._moving_cells = CellSort(grid, self.moving_count) if self.moving_count else None
        self._moving_ids = on_device(np.arange(self.moving_count, dtype=np.int32))
        self._moving_position = ti.Vector.ndarray(3, ti.f32, max(self.moving_count, 1))
        self._moving_points = _sorted_points(moving_positions, self._moving_cells) if self._moving_cells else None
        self._reference_sheets, self._reference_behind = (on_device(sheets.positions) for _ in range(2))
        self.moving_index = on_device(np.zeros(self.moving_count, dtype=np.int32))

    @property
    def count(self) -> int:
        """Samples of walls, of all bodies and of sheets."""
        return self.fixed_count + self.moving_count

    def sample_counts(self) -> NDArray[np.int64]:
        """Numbers of samples that move with each body, (bodies,)."""
        return np.bincount(self.mover[self.moving.body], minlength=self.body_count)

    def glue(
        self,
        mover: NDArray[np.int64],
        arm: NDArray[np.float64],
        rows: NDArray[np.int64],
        position: NDArray[np.float64],
        volume: NDArray[np.float64],
    ) -> None:
        """Let bodies move with others: with which, and how far from its centre of mass [m], (n,) and (n, 3).

        Arms are in the axes that all have that move together; emitters' pistons, the last bodies, are left out. The
        samples of some rows, (k,), are where they are about the centre of mass of their own body [m], (k, 3), with
        volumes [m³], (k,), 0 where they do not count now. `place` puts them there.
        """
        pistons = self.body_count - len(mover)
        mover = np.append(mover, np.arange(len(mover), self.body_count))
        arm = np.concatenate([arm, np.zeros((pistons, 3))])
        offset, volumes = self._host_offset.copy(), self._host_volume.copy()
        offset[rows], volumes[rows] = position + arm[self.moving.body[rows]], volume
        known = self._host_offset, self._host_volume, self.mover
        if all(map(np.array_equal, (offset, volumes, mover), known)):
            return
        self._before, self._with_others = self._positions(), True
        self._put_deformed(offset, self._host_own_velocity, volumes)
        self._put_movers(mover)

    def _put_movers(self, mover: NDArray[np.generic]) -> None:
        """Of samples whose offsets are put already."""
        was_alone = np.bincount(self.mover, minlength=self.body_count) == 1
        self.mover = np.asarray(mover, dtype=np.int64)
        order = np.argsort(self.mover, kind="stable")
        put(self.bodies.members, order)
        put(self.bodies.first_member, np.searchsorted(self.mover[order], np.arange(self.body_count + 1)))
        no_body = np.full(self.sheet_count, NO_BODY)
        put(self.bodies.body, np.concatenate([self.mover[self.moving.body], no_body]))
        members = np.bincount(self.mover, minlength=self.body_count)
        self.reach = np.where(was_alone & (members == 1), self.reach, self._reach())

    def _reach(self) -> NDArray[np.float64]:
        """Of bodies whose samples are where they are put; those that deform may get farther."""
        reach = np.zeros(self.body_count)
        distance = np.linalg.norm(self._host_offset.astype(np.float64), axis=1)
        np.maximum.at(reach, self.mover[self.moving.body], distance)
        return reach

    def _positions(self) -> NDArray[np.float64]:
        """Where the samples of bodies are, by the states on the host [m], (m, 3)."""
        states = states_of(self._host_states.astype(np.float64))
        of_samples = self.mover[self.moving.body]
        arms = np.einsum("nij,nj->ni", states.rotation[of_samples], self._host_offset.astype(np.float64))
        result: NDArray[np.float64] = states.position[of_samples] + arms
        return result

    def deform(
        self,
        body: int,
        position: NDArray[np.floating],
        velocity: NDArray[np.floating],
        volume: NDArray[np.floating],
    ) -> None:
        """Say where the samples of a body are in its frame [m], (m, 3), how they move there, and their volumes [m³].

        `place` puts them there.
        """
        rows = slice(self.body_start[body], self.body_start[body + 1])
        offset, own_velocity, volumes = (
            each.copy() for each in (self._host_offset, self._host_own_velocity, self._host_volume)
        )
        offset[rows], own_velocity[rows], volumes[rows] = position, velocity, volume
        moved = offset[rows].astype(np.float64) - self._host_offset[rows]
        self._deformed_by = max(self._deformed_by, float(np.linalg.norm(moved, axis=1).max(initial=0.0)))
        self.deforming_speed[body] = np.linalg.norm(velocity, axis=1).max(initial=0.0)
        self._put_deformed(offset, own_velocity, volumes)

    def _put_deformed(
        self,
        offset: NDArray[np.generic],
        own_velocity: NDArray[np.generic],
        volumes: NDArray[np.generic],
    ) -> None:
        if self._own_velocity is None:
            self._own_velocity, self._volume = on_device(self._host_own_velocity), on_device(self._host_volume)
        self._host_offset, self._host_own_velocity, self._host_volume = offset, own_velocity, volumes
        put(self._offset, offset)
        put(self._own_velocity, own_velocity)
        put(self._volume, volumes)
        put_volumes(self._volume, self.bodies, self.samples)

    def place(self, states: BodyStates) -> float:
        """Put the moving samples where their bodies are; returns the largest displacement of one [m]."""
        if not self.body_count:
            return 0.0
        rows = np.concatenate(
            [states.position, states.rotation.reshape(-1, 9), states.velocity, states.angular_velocity], axis=1
        )
        before = self._host_states
        self._place(np.ascontiguousarray(rows, dtype=np.float32).ravel())
        # In float64 of the float32 states, which a checkpoint holds: a run that continues finds the same.
        moved = (self._host_states.astype(np.float64) - before).reshape(-1, STATE_WIDTH)
        # Two rotations by an angle a apart differ by 2 sqrt(2) sin(a/2), and points at a distance of 1 by 2 sin(a/2).
        turned = np.linalg.norm(moved[:, 3:12], axis=1) / math.sqrt(2.0)
        deformed_by, self._deformed_by = self._deformed_by, 0.0
        if self._before is not None:  # samples may have another body now, whose state moved otherwise
            moved_by = np.linalg.norm(self._positions() - self._before, axis=1)
            deformed_by, self._before = max(deformed_by, float(moved_by.max(initial=0.0))), None
        return float((np.linalg.norm(moved[:, :3], axis=1) + turned * self.reach).max()) + deformed_by

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Where the bodies and sheets are, and where they were when the moving samples were sorted last."""
        arrays: dict[str, NDArray[np.generic]] = {
            "body_states": self.bodies.states.to_numpy(),
            "reference_body_states": self._reference_states.copy(),
        }
        if self._own_velocity is not None:
            arrays["body_offsets"], arrays["reference_body_offsets"] = self._host_offset, self._reference_offset
            arrays["body_offset_velocities"], arrays["body_volumes"] = self._host_own_velocity, self._host_volume
        if self._with_others:
            arrays["body_movers"], arrays["reference_body_movers"] = self.mover, self._reference_mover
        if self.sheet_count:
            own = slice(self.sheets.first, self.count)
            arrays["sheet_position"] = self.samples.position.to_numpy()[own].copy()
            arrays["sheet_velocity"] = self.samples.velocity.to_numpy()[own].copy()
            arrays["sheet_behind"] = self.samples.behind.to_numpy()[own].copy()
            arrays["reference_sheet_position"] = self._reference_sheets.to_numpy()
            arrays["reference_sheet_behind"] = self._reference_behind.to_numpy()
        return arrays

    def restore_reference(self, arrays: Arrays) -> None:
        """Put bodies and sheets where they were when the moving samples were sorted before the checkpoint."""
        if self._own_velocity is not None:
            self._put_deformed(
                arrays["reference_body_offsets"], arrays["body_offset_velocities"], arrays["body_volumes"]
            )
        if self._with_others:
            self._put_movers(arrays["reference_body_movers"])
        self._place(arrays["reference_body_states"])
        if self.sheet_count:
            self._put_sheets(self.samples.position, arrays["reference_sheet_position"])
            self._put_sheets(self.samples.behind, arrays["reference_sheet_behind"])

    def restore(self, arrays: Arrays) -> None:
        """Put bodies and sheets where they were at the checkpoint."""
        if self._own_velocity is not None:
            self._put_deformed(arrays["body_offsets"], arrays["body_offset_velocities"], arrays["body_volumes"])
            self._deformed_by = 0.0
        if self._with_others:
            self._put_movers(arrays["body_movers"])
            self._before = None
        self._place(arrays["body_states"])
        if self.sheet_count:
            self._put_sheets(self.samples.position, arrays["sheet_position"])
            self._put_sheets(self.samples.velocity, arrays["sheet_velocity"])
            self._put_sheets(self.samples.behind, arrays["sheet_behind"])

    def _put_sheets(self, array: ti.Ndarray, rows: NDArray[np.generic]) -> None:
        values = array.to_numpy()
        values[self.sheets.first : self.count] = rows
        array.from_numpy(values)

    def _place(self, states: NDArray[np.generic]) -> None:
        self._host_states = np.ascontiguousarray(states)
        put(self.bodies.states, self._host_states)
        place_samples(self._offset, self.bodies, self.samples)
        if self._own_velocity is not None:
            add_own_velocities(self._own_velocity, self.bodies, self.samples)

    def sort_moving(self) -> SortedPoints | None:
        """Sort the moving samples by cell, where they are now, into `moving_index` too; None where there are none."""
        if self._moving_cells is None or self._moving_points is None:
            return None
        self._reference_states, self._reference_offset = self._host_states, self._host_offset
        self._reference_mover = self.mover
        sort_moving_samples(
            self.samples,
            self.fixed_count,
            self.moving_count,
            self.sheets,
            self._moving_position,
            self._reference_sheets,
            self._reference_behind,
            self._moving_ids,
            self._moving_cells.grid.on_device,
            self._moving_cells.arrays,
            self._moving_points,
            self.moving_index,
        )
        return self._moving_points


def _sorted_points(positions: NDArray[np.float32], cells: CellSort) -> SortedPoints:
    x, y, z = (on_device(positions[:, axis]) for axis in range(3))
    return SortedPoints(x, y, z, cells.cell_start)


@kernel
def place_samples(offset: Vectors, bodies: Bodies, samples: Samples):
    """x_b = x_com + R r_b, v_b = v + omega x R r_b."""
    for b in range(bodies.sample_count):
        s = bodies.body[b] * STATE_WIDTH
        r = offset[b]
        arm = ti.math.vec3(0.0)
        for row in ti.static(range(3)):
            arm[row] = (
                bodies.states[s + 3 + 3 * row] * r[0]
                + bodies.states[s + 4 + 3 * row] * r[1]
                + bodies.states[s + 5 + 3 * row] * r[2]
            )
        centre = ti.math.vec3(bodies.states[s], bodies.states[s + 1], bodies.states[s + 2])
        speed = ti.math.vec3(bodies.states[s + 12], bodies.states[s + 13], bodies.states[s + 14])
        spin = ti.math.vec3(bodies.states[s + 15], bodies.states[s + 16], bodies.states[s + 17])
        samples.position[bodies.first + b] = centre + arm
        samples.velocity[bodies.first + b] = speed + spin.cross(arm)


@kernel
def add_own_velocities(own: Vectors, bodies: Bodies, samples: Samples):
    """v_b += R u_b, where surfaces deform."""
    for b in range(bodies.sample_count):
        s = bodies.body[b] * STATE_WIDTH
        u = own[b]
        for row in ti.static(range(3)):
            samples.velocity[bodies.first + b][row] += (
                bodies.states[s + 3 + 3 * row] * u[0]
                + bodies.states[s + 4 + 3 * row] * u[1]
                + bodies.states[s + 5 + 3 * row] * u[2]
            )


@kernel
def put_volumes(volumes: Floats, bodies: Bodies, samples: Samples):
    """V_b of the samples of bodies."""
    for b in range(bodies.sample_count):
        samples.volume[bodies.first + b] = volumes[b]
        samples.friction_volume[bodies.first + b] = volumes[b]


@kernel
def sort_moving_samples(
    samples: Samples,
    first: ti.i32,
    count: ti.i32,
    sheets: Sheets,
    position: Vectors,
    reference: Vectors,
    reference_behind: Vectors,
    ids: Integers,
    grid: Grid,
    arrays: SortArrays,
    points: SortedPoints,
    index: Integers,
):
    """Sort the moving samples, wherever they are, and note where those of sheets are, and are felt.

    Coordinates as they are sorted, and the index of each among all samples.
    """
    for b in range(count):
        position[b] = samples.position[first + b]
    for s in range(sheets.count):
        reference[s] = samples.position[sheets.first + s]
        if ti.static(samples.with_sheets):
            reference_behind[s] = samples.behind[sheets.first + s]
    counting_sort(position, ids, count, grid, ti.math.vec3(-FAR), ti.math.vec3(FAR), arrays)
    for k in range(count):
        x_b = position[arrays.order[k]]
        points.x[k] = x_b[0]
        points.y[k] = x_b[1]
        points.z[k] = x_b[2]
        index[k] = first + arrays.order[k]
