"""Joints between rigid bodies: what they hold, limit, drive and pull, and when they break."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.solver import Arrays, Diagnostics
from sim.rigid.contacts import Array, Indices, pair_keys
from sim.rigid.joint_order import elimination_of
from sim.rigid.joint_parameters import RIGID_KINDS, JointParameters, points_of
from sim.rigid.joint_points import JointPoints, no_points
from sim.rigid.joint_system import UNBOUNDED, JointDemand, JointSolution, JointSystem, solve_alone
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.states import MovingBodies, turned_freely
from sim.rigid.steps import groups_of

POINT, ACROSS, ALONG, LENGTH, TURN, ALIGN, ANGLE, SWING = range(8)
"""What a row is about: the way between the two points; its parts across and along the axis; its length; the turn of one
body against the other; the axis of one across that of the other; the angle about it; the angle between both."""

HOLDS, LIMITS, DRIVES, PULLS = range(4)
"""What a row does with it: keeps it at 0; not below 0; lets it change at a speed, as far as the motor can; pulls it to
0 as a spring does."""

MOST_STEPS = 20  # of Newton's method to where the joints hold at the end of a step
HELD = 1.0e-9  # change of a gap [m], [rad] by which these steps end: what is left is far less
APART = 1.0e-6  # error that no impulse changes: what joints ask for is more than there is to move [m], [rad]
FIGHTS = 0.1  # of the largest error of a joint, from which on others fight with it
DIVERGES = 4.0  # growth from one of these steps to another with which they end
CLOSING_SHARE = 0.2  # of an error at the start of a step that is taken back in it
TOUCHING = 1.0e-6  # a limit nearer than this counts as reached in an impact [m], [rad]
REDUNDANT = 1.0e-9  # of the largest: rows of one body with smaller eigenvalues say what others say


@dataclass(frozen=True, eq=False)
class _Frames:
    """Where the joints are: (j, ...)."""

    ends: Array  # the two points [m], (j, 2, 3)
    centres: Array  # of mass of the two bodies [m], (j, 2, 3)
    axis: Array  # on the second body, (j, 3)
    own_axis: Array  # on the first body, (j, 3)
    tangents: Array  # across the axis of the second body, (j, 2, 3)
    turn: Array  # of the first body against the second since the start [rad], (j, 3)
    angle: Array  # of a hinge [rad], (j,)


@dataclass(frozen=True, eq=False)
class JointStep:
    """The joints at the start of a step."""

    system: JointSystem
    values: Array  # of all rows, (r,)
    dt: float  # [s]
    velocity: Array  # of all bodies before their impulses, (b, 6)
    speeds: Array  # that motors want, (r,), 0 elsewhere


class Joints:
    """All joints of a scene; the n bodies that move are numbered as in `MovingBodies`, n is all that stands, and points
    follow.

    Where nothing touches, a step is one of RATTLE (Andersen 1983; for bodies that turn freely in between, Reich 1996):
    impulses at its start hold the joints at its end, and impulses at its end hold their velocities; it is of second
    order, keeps momenta, and the energy without drift. Springs have the mean force of both ends, with which they swing
    on for ever. Bodies of a component that contacts or a fluid pushed take the velocity that joints and contacts find
    together for the whole step, as bodies in contact do, and the joints hold at its end as well. Where Newton's
    method does not find where they hold, and no shorter step does either, velocities alone hold, which adds no energy.

    Approximate: what contacts move apart, in poses alone, joints take back. A body that a joint jerks may be as deep in
    another after that step as it moved in it.

    Attributes:
        names: (j,).
        is_broken: (j,).
        points: that joints hold beside bodies.
    """

    def __init__(
        self,
        parameters: Sequence[JointParameters],
        everybody: Sequence[RigidBodyParameters],
        bodies: MovingBodies,
        points: JointPoints | None = None,
    ) -> None:
        """Take the joints of a scene, without problems, its bodies where they start, and points."""
        self.points = no_points(len(parameters)) if points is None else points
        self.names, self._parameters, self._n = (
            tuple(joint.name for joint in parameters),
            tuple(parameters),
            len(bodies),
        )
        numbers = {body.name: number for number, body in enumerate(everybody)}
        named = np.array([[numbers.get(name, -1) for name in (*joint.between, None)[:2]] for joint in parameters])
        self._named = np.where(named < 0, len(everybody), named)
        ends = self.points.ends
        self._bodies = np.where(ends >= 0, self._n + 1 + ends, np.minimum(self._named, self._n))  # (j, 2)
        self.is_broken = np.zeros(len(parameters), dtype=bool)
        self._touches = np.array([joint.contacts for joint in parameters])
        self._members = np.unique(self._bodies[self._bodies < self._n])
        self._place(parameters, everybody, bodies)
        self._make_rows(parameters)
        self._order = elimination_of(self._bodies, self._counts, self._with_points(bodies.is_dynamic, True))
        row = self._first_rows[self._order.joint] + self._order.number
        self._joint, self._about, self._part, self._sign, self._offset, self._does = (
            self._joint[row],
            self._about[row],
            self._part[row],
            self._sign[row],
            self._offset[row],
            self._does[row],
        )
        self._row_bodies = self._bodies[self._joint]
        self._is_linear = self._about <= LENGTH
        stiffness = np.array([joint.stiffness or 0.0 for joint in parameters])
        self._stiffness, self._damping = stiffness[self._joint], np.array([j.damping for j in parameters])[self._joint]
        self._set_motors(parameters)
        self._breaks_at = np.array([joint.breaks_at or np.inf for joint in parameters])
        self._breaks_at_torque = np.array([joint.breaks_at_torque or np.inf for joint in parameters])
        self.begin_frame()

    def __len__(self) -> int:
        return len(self.names)

    def _place(
        self, parameters: Sequence[JointParameters], everybody: Sequence[RigidBodyParameters], bodies: MovingBodies
    ) -> None:
        """Fix points and axes to the bodies."""
        points = np.array([points_of(joint, everybody) for joint in parameters], dtype=np.float64)
        for number, ends in enumerate(self.points.ends):
            for side in np.flatnonzero(ends >= 0):
                both = slice(None) if parameters[number].kind in RIGID_KINDS else side
                points[number, both] = self.points.position[ends[side]]
        axes = np.array([joint.axis or (0.0, 0.0, 1.0) for joint in parameters], dtype=np.float64)
        axes /= np.sqrt(np.square(axes).sum(axis=1))[:, None]
        position, orientation = self._with_world(bodies.position, bodies.orientation, self.points.position)
        first, second = self._bodies.T
        inverse = rotation.conjugate(orientation[self._bodies])
        # The point of each body, its axis, and tangents across that.
        own = np.empty((len(parameters), 2, 4, 3))
        own[:, :, 0], own[:, :, 1] = points - position[self._bodies], axes[:, None]
        own[:, :, 2:] = _across(axes)[:, None]
        self._own = rotation.rotated(inverse[:, :, None], own)
        self._turn = rotation.product(rotation.conjugate(orientation[second]), orientation[first])
        self._angle = np.zeros(len(parameters))
        lengths = np.sqrt(np.square(points[:, 0] - points[:, 1]).sum(axis=1))
        given = np.array([np.nan if joint.length is None else joint.length for joint in parameters])
        self._length = np.where(np.isnan(given), lengths, given)
        for number, joint in enumerate(parameters):
            # The node of a cloth may be a little farther than the place that was given.
            is_short = joint.kind == "rope" and (self.points.ends[number] >= 0).any()
            if joint.kind == "distance" or (is_short and self._length[number] < lengths[number]):
                self._length[number] = lengths[number]

    def _make_rows(self, parameters: Sequence[JointParameters]) -> None:
        """The rows of each joint: whose, about what, which part of it, its sign, where it is 0, and what it does."""
        rows: list[tuple[int, int, int, float, float, int]] = []
        self._counts: list[int] = []
        for number, joint in enumerate(parameters):
            own: list[tuple[int, int, float, float, int]] = []
            if joint.kind in ("fixed", "hinge", "ball"):
                own += [(POINT, part, 1.0, 0.0, HOLDS) for part in range(3)]
            if joint.kind == "slider":
                own += [(ACROSS, part, 1.0, 0.0, HOLDS) for part in range(2)]
            if joint.kind in ("fixed", "slider"):
                own += [(TURN, part, 1.0, 0.0, HOLDS) for part in range(3)]
            if joint.kind == "hinge":
                own += [(ALIGN, part, 1.0, 0.0, HOLDS) for part in range(2)]
            if joint.kind in ("distance", "spring"):
                own.append((LENGTH, 0, 1.0, self._length[number], HOLDS if joint.kind == "distance" else PULLS))
            if joint.kind == "rope":
                own.append((LENGTH, 0, -1.0, self._length[number], LIMITS))
            if joint.cone_deg is not None:
                own.append((SWING, 0, -1.0, float(np.radians(joint.cone_deg)), LIMITS))
            free = ANGLE if joint.kind == "hinge" else ALONG
            for limits in (joint.limits, np.radians(joint.limits_deg) if joint.limits_deg else None):
                if limits is not None:
                    own += [(free, 0, 1.0, float(limits[0]), LIMITS), (free, 0, -1.0, float(limits[1]), LIMITS)]
            if joint.motor is not None:
                own.append((free, 0, 1.0, 0.0, DRIVES))
            rows += [(number, *row) for row in own]
            self._counts.append(len(own))
        self._first_rows = np.concatenate([[0], np.cumsum(self._counts)]).astype(np.int64)
        table = np.array(rows, dtype=np.float64)
        self._joint, self._about, self._part = (table[:, column].astype(np.int64) for column in range(3))
        self._sign, self._offset, self._does = table[:, 3], table[:, 4], table[:, 5].astype(np.int64)

    def _set_motors(self, parameters: Sequence[JointParameters]) -> None:
        """What motors want, by row: a speed, or to be somewhere; and what they can."""
        count = len(self._joint)
        self._speed, self._goal, self._response = np.zeros(count), np.full(count, np.nan), np.ones(count)
        self._strength = np.zeros(count)
        for row in np.flatnonzero(self._does == DRIVES):
            motor = parameters[self._joint[row]].motor
            assert motor is not None
            self._strength[row] = motor.max_torque or motor.max_force
            self._response[row] = motor.response_s
            if motor.speed is not None:
                self._speed[row] = motor.speed
            else:
                self._goal[row] = np.radians(motor.angle_deg) if motor.position is None else motor.position

    def untouching(self) -> Indices:
        """Keys of the pairs of bodies that do not touch each other, as joints hold them, ascending."""
        holds = ~self.is_broken & ~self._touches & (self.points.ends < 0).all(axis=1)
        first, second = np.sort(self._named[holds], axis=1).T
        return np.unique(pair_keys(first, second))

    def links(self) -> tuple[Indices, Indices]:
        """The pairs of moving bodies that joints hold together, (p,) each."""
        pairs = self._bodies[~self.is_broken]
        first, second = pairs[(pairs < self._n).all(axis=1)].T
        return first, second

    def beside(self, moves: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Bodies, (n,), that joints hold to bodies that move, (n,)."""
        among, beside = self._with_points(moves, False), self._with_points(np.zeros(self._n, dtype=bool), False)
        first, second = self._bodies[~self.is_broken].T
        beside[first[among[second]]] = beside[second[among[first]]] = True
        return beside[: self._n]

    def driven(self) -> NDArray[np.bool_]:
        """Moving bodies that a motor keeps turning or going, or that hang on a point, which never rests, (n,)."""
        restless = self._with_points(np.zeros(self._n, dtype=bool), False)
        rows = ((self._speed != 0.0) | (self._row_bodies > self._n).any(axis=1)) & ~self.is_broken[self._joint]
        restless[self._row_bodies[rows]] = True
        return restless[: self._n]

    def begin(
        self, bodies: MovingBodies, dt: float, is_active: NDArray[np.bool_], inverse_inertia: Array
    ) -> JointStep | None:
        """The joints of active bodies, (n,), before a step of dt [s]; None where there are none.

        The velocities of the bodies are those with gravity; of kinematic bodies the means over the step.
        """
        system, values, _ = self._system(bodies, is_active, inverse_inertia)
        if not system.is_there.any():
            return None
        speeds = np.where(np.isnan(self._goal), self._speed, (self._goal - values) / self._response)
        return JointStep(system, values, dt, self._velocities(bodies), speeds)

    def _system(
        self, bodies: MovingBodies, is_active: NDArray[np.bool_], inverse_inertia: Array
    ) -> tuple[JointSystem, Array, Array]:
        """The rows where the bodies are now, their values, and the angles of all hinges [rad], (j,)."""
        frames = self._frames(bodies.position, bodies.orientation, self.points.position)
        direction = self._directions(frames)
        among = self._with_points(is_active, self.points.is_free)
        is_there = ~self.is_broken[self._joint] & among[self._row_bodies].any(axis=1)
        jacobian = self._jacobian(frames, direction)
        inverse_mass = self._with_points(np.where(is_active, bodies.inverse_mass, 0.0), self.points.inverse_mass)
        inverse_inertia = np.concatenate([inverse_inertia, np.zeros((1 + len(self.points), 3, 3))])
        system = JointSystem.build(self._order, is_there, self._row_bodies, jacobian, inverse_mass, inverse_inertia)
        return system, self._values(frames), frames.angle

    def impacts(self, step: JointStep) -> JointDemand:
        """What joints ask while bodies bounce: what holds, holds."""
        system, holds, limits = step.system, self._does == HOLDS, self._does == LIMITS
        is_there = system.is_there & (holds | (limits & (step.values < TOUCHING)))
        nothing = np.zeros(len(holds))
        upper = np.full(len(holds), UNBOUNDED)
        return JointDemand(system, is_there, nothing, nothing, np.where(holds, -UNBOUNDED, 0.0), upper)

    def velocities(self, step: JointStep) -> JointDemand:
        """What joints ask of a whole step, together with contacts."""
        dt, does, values = step.dt, self._does, step.values
        give = self._stiffness * 0.5 * dt + self._damping
        pull = np.divide(self._stiffness * values, give, out=np.zeros_like(give), where=give > 0.0)
        bias = np.select(
            [does == HOLDS, does == LIMITS, does == DRIVES, does == PULLS],
            [CLOSING_SHARE * values / dt, np.where(values > 0.0, 1.0, CLOSING_SHARE) * values / dt, -step.speeds, pull],
        )
        softness = self._softness(np.full(len(does), dt), dt)
        return JointDemand(step.system, step.system.is_there, bias, softness, *self._bounds(dt))

    def _softness(self, duration_s: Array, dt: float) -> Array:
        """Velocity that a spring's impulse adds by giving way, (r,), of forces of such durations [s], (r,)."""
        give = duration_s * (self._stiffness * 0.5 * dt + self._damping)
        return np.divide(1.0, give, out=np.zeros_like(give), where=give > 0.0)

    def _bounds(self, duration_s: Array | float) -> tuple[Array, Array]:
        """Least and largest impulses of the rows in such a time [s]."""
        drives = self._does == DRIVES
        lower = np.where(self._does == LIMITS, 0.0, -UNBOUNDED)
        most = self._strength * duration_s
        return np.where(drives, -most, lower), np.where(drives, most, UNBOUNDED)

    def hold(
        self,
        step: JointStep,
        bodies: MovingBodies,
        impulses: Array,
        is_touched: NDArray[np.bool_],
        *,
        gravity: Array,
        extra: Array,
        is_held: NDArray[np.bool_],
    ) -> JointHold:
        """Change velocities so that the joints hold where the bodies get in the step.

        Args:
            step: the step.
            bodies: with the velocities that contacts and joints found together.
            impulses: of the joints among these, (r,).
            is_touched: bodies that contacts or a fluid pushed, (n,); out: all of their components.
            gravity: [m/s²], (3,).
            extra: velocities (v, omega) of this step's change of poses alone, (n, 6).
            is_held: bodies whose spin turns with that change, (n,).
        """
        system, dt, n = step.system, step.dt, self._n
        component = self._order.component
        pushed = np.zeros(len(self._order.components), dtype=bool)
        touched = self._with_points(is_touched, False)
        np.logical_or.at(pushed, component, (touched[self._row_bodies] & (system.movers >= 0)).any(axis=1))
        whole = pushed[component]  # whether a row acts in one impulse for all of the step
        velocity = self._velocities(bodies)
        for side in range(2):
            rows = system.is_there & (system.movers[:, side] >= 0)
            touched[system.movers[rows & whole, side]] = True
            alone = system.movers[rows & ~whole, side]
            velocity[alone] = step.velocity[alone]
        is_touched |= touched[:n]
        total = np.where(whole & system.is_there, impulses, 0.0)
        duration_s = np.where(whole, dt, 0.5 * dt)
        lower, upper = self._bounds(duration_s)
        softness = self._softness(duration_s, dt)
        self._set_velocities(bodies, velocity)
        of_points = self.points.drift(dt, touched[n + 1 :])

        moving = self._members
        fall = np.where(bodies.is_dynamic & ~is_touched, 0.5 * dt, 0.0)[:, None] * gravity
        drift = (bodies.velocity - fall)[moving]
        turn = rotation.exponential(dt * extra[moving, 3:])
        base_position = bodies.position[moving] + dt * extra[moving, :3]
        base_orientation = rotation.normalized(rotation.product(turn, bodies.orientation[moving]))
        spin = bodies.angular_momentum()
        is_led = ~bodies.is_dynamic[moving]
        led = rotation.product(rotation.exponential(dt * bodies.angular_velocity[moving]), bodies.orientation[moving])
        position, orientation = bodies.position.copy(), bodies.orientation.copy()
        still = np.zeros_like(velocity)
        change, converged = still.copy(), False
        start = step.values
        wanted = np.where((self._does == HOLDS) | (start < 0.0), (1.0 - CLOSING_SHARE) * start, 0.0)
        wanted[np.abs(start) <= HELD] = 0.0
        drives, pulls, holds = self._does == DRIVES, self._does == PULLS, system.is_there & (self._does == HOLDS)

        def solve(values: Array) -> JointSolution:
            """Impulses that take back what is wrong with the values at the end of the step."""
            stretched = self._stiffness * 0.5 * (start + values) + self._damping * (values - start) / dt
            bias = np.where(drives, (values - start) / dt - step.speeds, (values - wanted) / dt)
            bias = np.where(pulls, softness * (total + duration_s * stretched), bias)
            return solve_alone(
                JointDemand(system, system.is_there, bias, softness, lower - total, upper - total), still
            )

        before, least = total, np.inf
        for _ in range(MOST_STEPS):
            turning = np.where(is_held[moving, None], rotation.rotated(turn, spin[moving]), spin[moving])
            position[moving] = base_position + dt * (drift + change[moving, :3])
            free = turned_freely(
                base_orientation, bodies.principal_orientation[moving], bodies.principal_moments[moving], turning, dt
            )
            orientation[moving] = np.where(is_led[:, None], led, free)
            frames = self._frames(position, orientation, self.points.position + dt * (of_points + change[n + 1 :, :3]))
            values = self._values(frames)
            found = solve(values)
            total = total + found.impulses
            change += found.velocity
            spin += system.torques(found.impulses)[:n]
            moved = dt * float(np.abs(system.velocities(found.velocity))[system.is_there].max())
            if not found.converged or not moved < DIVERGES * least:
                break
            least = min(least, moved)
            if moved <= HELD:
                converged = float(np.max(np.abs(values - wanted), initial=0.0, where=holds)) <= APART
                break
        if not converged:
            # As if joints stayed as they are: that adds no energy, and leaves gaps of second order.
            total = before
            velocity[:n, :3] -= fall
            velocity[:n] += extra
            velocity[n + 1 :, :3] = of_points
            found = solve(start + dt * system.velocities(velocity))
            total, change = total + found.impulses, found.velocity
        self._set_velocities(bodies, self._velocities(bodies) + change)
        was_held = float(np.max(np.abs(start), initial=0.0, where=holds)) <= APART
        return JointHold(step, whole, total, converged, was_held and not converged)

    def settle(
        self, hold: JointHold, bodies: MovingBodies, is_active: NDArray[np.bool_], inverse_inertia: Array
    ) -> None:
        """Change velocities at the end of a step so that they agree with the joints, and break what is overloaded."""
        step, dt = hold.step, hold.step.dt
        before = step.system
        system, values, angle = self._system(bodies, is_active, inverse_inertia)
        is_there = np.zeros(len(self), dtype=bool)
        is_there[self._joint[system.is_there]] = True
        self._angle = np.where(is_there, angle, self._angle)
        does, first, whole = self._does, hold.impulses, hold.is_whole
        kick = np.where((does == PULLS) & ~whole & before.is_there, first, 0.0)
        velocity = system.change(kick) + self._velocities(bodies)
        takes_part = system.is_there & (
            (does == HOLDS) | ((does == LIMITS) & (first > 0.0)) | ((does == DRIVES) & ~whole)
        )
        bias = np.where(does == DRIVES, -step.speeds, 0.0)
        lower, upper = self._bounds(0.5 * dt)
        found = solve_alone(JointDemand(system, takes_part, bias, np.zeros(len(does)), lower, upper), velocity)
        self._set_velocities(bodies, found.velocity)

        last = kick + found.impulses
        self._break(before, first, system, last, dt)
        holds = system.is_there & (does == HOLDS) & self._is_linear
        if holds.any():
            errors = np.where(holds, np.abs(values), 0.0)
            self._gap_m = max(self._gap_m, float(errors.max()))
        if not hold.converged:
            self._apart += 1
            worst = np.zeros(len(self))
            np.maximum.at(worst, self._joint, np.where(system.is_there & (does == HOLDS), np.abs(values), 0.0))
            self._apart_of += (worst > APART) & (worst >= FIGHTS * worst.max())

    def _break(self, before: JointSystem, first: Array, after: JointSystem, last: Array, dt: float) -> None:
        """Break joints whose mean force or torque over a step of dt [s] was too large."""
        if not (np.isfinite(self._breaks_at).any() or np.isfinite(self._breaks_at_torque).any()):
            return
        for is_meant, part, limits in (
            (self._is_linear, slice(0, 3), self._breaks_at),
            (~self._is_linear, slice(3, 6), self._breaks_at_torque),
        ):
            sums = np.zeros((len(self), 3))
            terms = before.jacobian[:, 0, part] * first[:, None] + after.jacobian[:, 0, part] * last[:, None]
            np.add.at(sums, self._joint[is_meant], terms[is_meant])
            self.is_broken |= np.sqrt(np.square(sums).sum(axis=1)) > limits * dt

    def reduce_mobility(self, bodies: MovingBodies, inverse_mass: Array, inverse_inertia: Array) -> None:
        """Take from inverse masses, (n,), and inertia, (n, 3, 3), what joints to the unmoved do not let move.

        W - W Jᵀ (J W Jᵀ)⁺ J W of each body, without the parts that link its way and its turning, and the largest of the
        masses of all directions.
        """
        system, _, _ = self._system(bodies, np.ones(len(bodies), dtype=bool), inverse_inertia)
        movers = system.movers.max(axis=1)
        alone = system.is_there & (self._does == HOLDS) & ((system.movers >= 0).sum(axis=1) == 1) & (movers < self._n)
        for body in np.unique(movers[alone]):
            rows = np.flatnonzero(alone & (movers == body))
            side = np.argmax(system.movers[rows], axis=1)
            jacobian, response = system.jacobian[rows, side], system.response[rows, side]
            mobility = np.zeros((6, 6))
            mobility[:3, :3], mobility[3:, 3:] = inverse_mass[body] * np.eye(3), inverse_inertia[body]
            mobility -= response.T @ np.linalg.pinv(jacobian @ response.T, rcond=REDUNDANT, hermitian=True) @ response
            inverse_mass[body] = max(np.linalg.eigvalsh(mobility[:3, :3])[-1], 0.0)
            inverse_inertia[body] = 0.5 * (mobility[3:, 3:] + mobility[3:, 3:].T)

    def begin_frame(self) -> None:
        """A frame starts: reset its counters."""
        self._gap_m, self._apart, self._apart_of = 0.0, 0, np.zeros(len(self), dtype=np.int64)

    def diagnostics(self) -> Diagnostics:
        """The largest gap of a joint in the frame [m], steps that did not find where all hold, and joints broken.

        `joints_apart_NAME` is in how many of these steps a joint was among those that gaped most.
        """
        of_joints = {f"joints_apart_{self.names[j]}": float(self._apart_of[j]) for j in np.flatnonzero(self._apart_of)}
        return {
            **of_joints,
            "joint_gap": self._gap_m,
            "joints_apart": float(self._apart),
            "joints_broken": float(np.count_nonzero(self.is_broken)),
        }

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """What is broken, the angles of hinges, whole turns included [rad], and the points."""
        own = {"joints_broken": self.is_broken.copy(), "joint_angles": self._angle.copy()}
        return {**own, **self.points.checkpoint()}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing or has another shape."""
        for name in ("joints_broken", "joint_angles"):
            if name not in arrays or arrays[name].shape != (len(self),):
                raise ValueError(f"checkpoint of the rigid bodies: {name} must have shape ({len(self)},)")
        self.is_broken = np.array(arrays["joints_broken"], dtype=bool)
        self._angle = np.array(arrays["joint_angles"], dtype=np.float64)
        self.points.restore(arrays)

    def hanging_mass(self, bodies: MovingBodies) -> Array:
        """Mass of all that hangs together with each point, itself included [kg], (h,)."""
        mass = self._with_points(np.where(bodies.is_free, bodies.mass, 0.0), self.points.mass)
        first, second = self._bodies[~self.is_broken & (mass[self._bodies] > 0.0).all(axis=1)].T
        groups = groups_of(first, second, len(mass))
        result: Array = np.bincount(groups, weights=mass)[groups][self._n + 1 :]
        return result

    def _with_points(self, of_bodies: NDArray[Any], of_points: NDArray[Any] | bool) -> NDArray[Any]:
        """Values of the moving bodies, of what stands, 0, and of points, (b,)."""
        own = np.broadcast_to(np.asarray(of_points, dtype=of_bodies.dtype), len(self.points))
        return np.concatenate([of_bodies, np.zeros(1, dtype=of_bodies.dtype), own])

    def _velocities(self, bodies: MovingBodies) -> Array:
        """Velocities (v, omega) of bodies, of what stands and of points, (b, 6)."""
        n, velocity = self._n, np.zeros((self._n + 1 + len(self.points), 6))
        velocity[:n, :3], velocity[:n, 3:] = bodies.velocity, bodies.angular_velocity
        velocity[n + 1 :, :3] = self.points.velocity
        return velocity

    def _set_velocities(self, bodies: MovingBodies, velocity: Array) -> None:
        """Give bodies and points such velocities, (b, 6)."""
        n = self._n
        bodies.velocity, bodies.angular_velocity = velocity[:n, :3].copy(), velocity[:n, 3:].copy()
        self.points.velocity = velocity[n + 1 :, :3].copy()

    def _with_world(self, position: Array, orientation: Array, of_points: Array) -> tuple[Array, Array]:
        """Poses of the moving bodies, of the world and of points, (b, ...)."""
        unturned = np.tile([1.0, 0.0, 0.0, 0.0], (1 + len(of_points), 1))
        return np.concatenate([position, np.zeros((1, 3)), of_points]), np.concatenate([orientation, unturned])

    def _frames(self, position: Array, orientation: Array, of_points: Array) -> _Frames:
        """Where the joints are with bodies in these poses, (n, 3) and (n, 4), and points, (h, 3)."""
        position, orientation = self._with_world(position, orientation, of_points)
        centres, turned = position[self._bodies], orientation[self._bodies]
        own = rotation.rotated(turned[:, :, None], self._own)
        axis, own_axis, tangents = own[:, 1, 1], own[:, 0, 1], own[:, 1, 2:]
        cosine, sine = np.einsum("ji,jti->tj", own[:, 0, 2], tangents)
        angle = np.arctan2(sine, cosine)
        angle = angle + 2.0 * np.pi * np.round((self._angle - angle) / (2.0 * np.pi))
        turn = rotation.product(turned[:, 0], rotation.conjugate(rotation.product(turned[:, 1], self._turn)))
        return _Frames(
            centres + own[:, :, 0],
            centres,
            axis,
            own_axis,
            tangents,
            rotation.logarithm(turn),
            angle,
        )

    def _values(self, frames: _Frames) -> Array:
        """How far each row is from where it is 0, with its sign, (r,)."""
        joint, about, part = self._joint, self._about, self._part
        way = frames.ends[:, 0] - frames.ends[:, 1]
        length = np.sqrt(np.square(way).sum(axis=1))
        across = np.einsum("ji,jti->jt", way, frames.tangents)
        aligned = np.einsum("ji,jti->jt", frames.own_axis, frames.tangents)
        leaning = rotation.cross(frames.axis, frames.own_axis)
        swing = np.arctan2(np.sqrt(np.square(leaning).sum(axis=1)), np.einsum("ji,ji->j", frames.axis, frames.own_axis))
        along = np.einsum("ji,ji->j", way, frames.axis)
        two = np.minimum(part, 1)
        value = np.choose(
            about,
            [
                way[joint, part],
                across[joint, two],
                along[joint],
                length[joint],
                frames.turn[joint, part],
                aligned[joint, two],
                frames.angle[joint],
                swing[joint],
            ],
        )
        result: Array = self._sign * (value - self._offset)
        return result

    def _directions(self, frames: _Frames) -> Array:
        """Along what, or about what, each row acts on the first body, (r, 3)."""
        joint, part = self._joint, self._part
        way = frames.ends[:, 0] - frames.ends[:, 1]
        leaning = rotation.cross(frames.axis, frames.own_axis)
        unit = np.eye(3)[part]
        two = np.minimum(part, 1)
        aligned = rotation.cross(frames.own_axis[joint], frames.tangents[joint, two])
        ways = [
            unit,
            frames.tangents[joint, two],
            frames.axis[joint],
            _unit(way)[joint],
            unit,
            aligned,
            frames.axis[joint],
            _unit(leaning)[joint],
        ]
        result: Array = self._sign[:, None] * np.choose(self._about[:, None], ways)
        return result

    def _jacobian(self, frames: _Frames, direction: Array) -> Array:
        """Of the velocities (v, omega) of both bodies, (r, 2, 6)."""
        jacobian = np.empty((len(direction), 2, 6))
        # What slides along a body acts where the other's point is.
        slides = (self._about == ACROSS) | (self._about == ALONG)
        for side, sign in ((0, 1.0), (1, -1.0)):
            end = frames.ends[self._joint, side]
            end = np.where(slides[:, None], frames.ends[self._joint, 0], end)
            arm = end - frames.centres[self._joint, side]
            linear = self._is_linear[:, None]
            jacobian[:, side, :3] = sign * np.where(linear, direction, 0.0)
            jacobian[:, side, 3:] = sign * np.where(linear, rotation.cross(arm, direction), direction)
        return jacobian


@dataclass(frozen=True, eq=False)
class JointHold:
    """What held the joints in a step."""

    step: JointStep
    is_whole: NDArray[np.bool_]  # rows whose impulses are those of the whole step, not of its first half, (r,)
    impulses: Array  # at the start of the step, (r,)
    converged: bool  # whether they hold at its end
    is_too_long: bool  # whether a shorter step may do better: they held at its start


def _unit(vectors: Array) -> Array:
    """Vectors, (k, 3), of unit length, along x where they have none."""
    length = np.sqrt(np.square(vectors).sum(axis=1))[:, None]
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), np.array([1.0, 0.0, 0.0]))


def _across(axis: Array) -> Array:
    """Two unit vectors across each axis, (k, 2, 3), right-handed with it (Duff et al. 2017)."""
    x, y, z = axis.T
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = np.empty((len(axis), 2, 3))
    tangents[:, 0, 0], tangents[:, 0, 1], tangents[:, 0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    tangents[:, 1, 0], tangents[:, 1, 1], tangents[:, 1, 2] = b, sign + y * y * a, -y
    return tangents
