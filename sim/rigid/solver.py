"""Rigid bodies that move: gravity, contacts with each other and with walls, and kinematic paths."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.core.motion import rotation
from sim.core.motion.paths import Path, Poses, path_onwards
from sim.core.motion.rotation import Array
from sim.core.parameters import Vector3
from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Diagnostics, Remedies
from sim.core.walls import walls_of
from sim.forces.field import ForceField
from sim.rigid.air import OuterForces
from sim.rigid.collision import CollisionDetector
from sim.rigid.contact_response import ContactResponse, Surfaces
from sim.rigid.contact_solver import NOT_CARRIED, Carried
from sim.rigid.contacts import Contacts, Indices
from sim.rigid.glue import MOST_ROUNDS, Glue
from sim.rigid.joint_parameters import JointParameters
from sim.rigid.joint_points import JointPoints
from sim.rigid.joints import Joints
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.parts import PartsDetector, detector_of
from sim.rigid.paths import path_of
from sim.rigid.states import MovingBodies, lengths
from sim.rigid.steps import LARGEST_TURN, MOST_OWN_STEPS, StepChooser, groups_of
from sim.rigid.surroundings import Surroundings
from sim.shapes.body_geometry import BodyGeometry

LARGEST_DT = 2.0e-3
"""Largest step [s] of dynamic bodies, which holds a stack of boxes to a micrometre, and of bodies with keyframes, as
nothing else looks ahead to where a path sets in."""

SLEEP_SHARE, SLEEP_TIME_S = 0.1, 0.5
"""A group of bodies that touch sleeps when all of them were slower for such a time [s] than a share of the speed that
gravity gives in the largest step: 2 mm/s on Earth, by which they get 1 mm in that time."""

MOST_HALVINGS = 4
"""How often a step is halved until joints find where they hold at its end: whips of light links may turn fast."""

MOST_LOOKS, LEAST_MISSED = 16, 0.01
"""How often contacts of a step are looked for again as others made bodies faster, and by how much farther they have to
get for that, in shortest edges: this is how deep they may get into each other."""

LOST_DISTANCE = 10.0  # a dynamic body farther from the domain's centre, in diagonals, is stopped: it fell out of sight

SOLVER_NAME = "rigid"

RUNAWAY_SPEED = 1.0e4  # no rigid body of a film moves at thirty times the speed of sound [m/s]


class RigidSolver:
    """All dynamic and kinematic bodies of a scene; static bodies and the domain's closed faces are obstacles.

    State in float64 on the host; contacts are found and solved in kernels, for which `sim.core.runtime.initialize` must
    have run. One substep: gravity, contact impulses from the poses at its start, then the poses. Groups of bodies that
    are too fast for it take several steps of their own, and groups that rest sleep (`steps`).
    Free flight is exact for constant gravity, and angular momentum is kept to round-off (`states.turned_freely`).
    Impulses of contacts are equal and opposite at one point, so that contacts change neither the linear nor the angular
    momentum of bodies that nothing else holds.

    Approximate: boxes and convex meshes touch each other and walls as rounded polytopes (`polytopes`), other shapes as
    unions of balls (`balls.Balls`); both round sharp corners by 2 % of the shortest edge; friction
    has one coefficient for sticking and sliding; moving overlapping bodies apart, where they do not bounce, changes
    the angular momentum of the pair by some 1e-5 of itself. Restitution is Newton's, of normal
    velocities, where Stronge's, of energy, allows it (`restitution`): impulses never add energy. Bringing corners to
    where their bounce leads within a step may lift a body: up to 0.3 % of its energy at a restitution of 1, to first
    order in the step. Unsupported: rolling friction. Joints: `joints.Joints`.

    Attributes:
        bodies: state of the moving bodies.
        solids: geometries of the moving bodies.
        all_names, all_geometries: of the moving bodies, then of the static ones.
        surfaces: friction and restitution of all of these.
        walls: closed faces of the domain.
        joints: between the bodies, or None.
        deforming: deformations of the bodies that have one, by their number.
        glue: between the pieces of bodies that break, or None.
        surroundings: the air that others compute around them.
        paths, time_s, gravity: of each kinematic body, by its number; simulated time [s]; [m/s²].
        has_own_steps: whether fast bodies divide the step of all; nothing that is coupled to them shares it then.

    Raises:
        ShapeError: a shape cannot be built.
    """

    def __init__(
        self,
        parameters: Sequence[RigidBodyParameters],
        *,
        obstacles: Sequence[RigidBodyParameters] = (),
        joints: Sequence[JointParameters] = (),
        points: JointPoints | None = None,
        domain: DomainParameters,
        gravity: Vector3,
        forces: ForceField | None = None,
    ) -> None:
        self.name = SOLVER_NAME
        self.gravity = np.array(gravity, dtype=np.float64)  # its own, which contacts share
        self.solids = tuple(_geometries_of(parameters))
        self.paths: dict[int, Path] = {
            number: path_of(body) for number, body in enumerate(parameters) if body.kind == "kinematic"
        }
        self.bodies = _starting_bodies(parameters, self.solids)
        self._groups = tuple(body.group for body in parameters)
        self._centres = np.array([solid.centre_of_mass for solid in self.solids])
        self.deforming = {
            number: solid.deformation for number, solid in enumerate(self.solids) if solid.deformation is not None
        }
        self._animated = {n for n, body in enumerate(parameters) if body.shape.type == "animation"}
        has_pieces = any(body.whole is not None for body in parameters)
        self.glue = Glue(parameters, self.solids, self.bodies) if has_pieces else None
        self._place_kinematic_bodies(0.0)

        fixed = _geometries_of(obstacles)
        self._fixed_position, self._fixed_rotation = _poses_of_obstacles(obstacles, fixed)
        still = np.concatenate([self._fixed_position, self._fixed_rotation.reshape(-1, 9)], axis=1)
        self._pose = np.concatenate([np.zeros((len(parameters), 12)), still])
        everybody = [*parameters, *obstacles]
        self.all_names = tuple(body.name for body in everybody)
        self.all_geometries = (*self.solids, *fixed)
        self.walls = tuple(walls_of(domain))
        make = detector_of if self.bodies.is_dynamic.any() else CollisionDetector
        self._detector = make(self.all_geometries, self.walls, len(self.solids))
        self.surfaces = Surfaces(
            friction=np.array([body.friction for body in everybody]),
            restitution=np.array([body.restitution for body in everybody]),
        )
        self._response = ContactResponse(self.surfaces, self.gravity)
        corners = np.array([domain.min, domain.max])
        self._chooser = StepChooser(self.all_geometries, self.bodies, self.walls, self._detector, self.gravity)
        self.joints = Joints(joints, everybody, self.bodies, points) if joints else None
        self._obey_links()
        self.surroundings = Surroundings(self.bodies, self.solids, self.glue)
        self.has_own_steps = False
        self._outer_forces = self._forces_on(parameters, forces)
        self._domain_centre = corners.mean(axis=0)
        self._domain_diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
        self._radius = np.array([geometry.radius for geometry in self.solids])
        self._edge = np.array([geometry.shortest_edge for geometry in self.solids])
        self._largest_dt = largest_dt(parameters)
        self.time_s = 0.0
        self.begin_frame(0.0)

    def poses(self) -> Poses:
        """Where all bodies are now: moving, static, and the domain."""
        return Poses(
            np.concatenate([self.bodies.position, self._fixed_position]),
            np.concatenate([self.bodies.rotation(), self._fixed_rotation]),
        )

    def _poses_described(self) -> Poses:
        """The same as `MovingBodies.describe` noted it last, without a copy."""
        return Poses(self._pose[:, :3], self._pose[:, 3:].reshape(-1, 3, 3))

    def mobility(self) -> tuple[Array, Array]:
        """How easily impulses move bodies: inverse masses [1/kg], (n,), and inertia tensors in world axes, (n, 3, 3).

        Of what is glued together that of all of it, by its leader; 0 for the others. Of what joints hold to something
        that stands or is led, as far as they let it; joints between free bodies are not foreseen.
        """
        glue = self.glue
        movers = self.bodies if glue is None else glue.movers
        inverse_mass, inverse_inertia = movers.inverse_mass, movers.inverse_inertia()
        if glue is not None:
            inverse_mass[~glue.is_leader], inverse_inertia[~glue.is_leader] = 0.0, 0.0
        if self.joints is not None:
            self.joints.reduce_mobility(self.bodies, inverse_mass, inverse_inertia)
        return inverse_mass, inverse_inertia

    def touching(self, first: Indices, second: Indices) -> tuple[Indices, Indices]:
        """Those of some pairs of bodies, the lower number first, that no joint keeps from touching, (p,) each."""
        return self._detector.touching(first, second)

    def apply_impulses(self, linear: Array, angular: Array) -> None:
        """Change velocities of dynamic bodies, and of what they are glued to, by impulses [N s], [N m s], (n, 3)."""
        self.bodies.apply_impulses(linear, angular)
        if self.glue is not None:
            self.glue.share()

    def max_surface_speed(self) -> float:
        """Upper bound of the speed of any surface point [m/s]."""
        return float(np.max(self._surface_speeds(), initial=0.0))

    def stable_dt(self) -> float:
        """Largest step [s] in which bodies turn little, and those that may meet something move little.

        Gravity's part counts. Where fast bodies have steps of their own it is that of a stack; none, 0, where the state
        is bad.
        """
        if self.first_bad_quantity() is not None:
            return 0.0
        spin = float(np.max(self.bodies.spins(), initial=0.0))
        is_dynamic = self.bodies.is_dynamic
        own_steps = MOST_OWN_STEPS if self.has_own_steps and is_dynamic.any() else 1
        dt = self._largest_dt if spin == 0.0 else min(self._largest_dt, own_steps * LARGEST_TURN / spin)
        if not is_dynamic.any() or self._chooser.needs_none(dt / own_steps):
            return dt
        awake = ~self.bodies.is_asleep
        meetings = self._chooser.meetings(self.poses(), dt, awake, has_own_steps=self.has_own_steps)
        shortest = min(float(np.min(each, initial=np.inf)) for each in (meetings.time_s, meetings.alone_s))
        return min(dt, own_steps * shortest)

    def _forces_on(self, parameters: Sequence[RigidBodyParameters], forces: ForceField | None) -> OuterForces | None:
        """Forces from outside, if there are any that these bodies feel."""
        if forces is None or not self.bodies.is_dynamic.any():
            return None
        on = forces.on([(body.name, body.group) for body in parameters])
        return OuterForces(on, parameters, self.solids, self.glue) if on.accelerates or on.blows else None

    def substep(self, dt: float) -> None:
        """Advance by dt [s]; groups of bodies that are too fast for it by several steps of their own."""
        bodies, start_s = self.bodies, self.time_s
        if self._outer_forces is not None:
            self._outer_forces.push(bodies, self.gravity, dt, self.surroundings.surrounded())
            if self.glue is not None:
                self.glue.share()
        if self.surroundings.boxes:
            self.surroundings.push(self.gravity, dt)
        if bodies.is_dynamic.any() and self.first_bad_quantity() is None:
            awake = self._awake(dt)
            groups = self._chooser.divided(self.poses(), dt, awake)
            if len(groups) > 1 and self.joints is not None and len(self.joints.points):
                # Points of cloth move in each step, so that all bodies take the same ones.
                groups = [(max(count for count, _ in groups), np.any([which for _, which in groups], axis=0))]
            for count, is_active in groups:
                self._place_kinematic_bodies(start_s)
                for step in range(count):
                    self._advance(dt / count, start_s + step * (dt / count), is_active)
            self._put_to_sleep(dt)
        self.time_s = start_s + dt
        self._place_kinematic_bodies(self.time_s)
        self._stop_lost_bodies()

    def _advance(
        self,
        dt: float,
        time_s: float,
        is_active: NDArray[np.bool_],
        halvings: int = MOST_HALVINGS,
        rounds: int = MOST_ROUNDS,
        looked_for: Array | None = None,
        looks: int = MOST_LOOKS,
    ) -> None:
        """Advance free bodies, (n,), by dt [s], and kinematic ones from a time [s] on; by halves if joints ask it.

        Where bodies break, the step is taken again from its start by what is left of them, in some rounds. So it is
        where contacts make bodies so fast that they meet others of which no contacts were looked for: these are looked
        for as far as surfaces may get by their own speed, or so far [m], (n,).
        """
        self._set_mean_velocities_of_kinematic_bodies(time_s, dt)
        bodies, glue, everybody = self.bodies, self.glue, is_active
        if glue is not None:
            glue.gather()
            bodies, is_active = glue.movers, is_active & glue.is_leader
        poses_before = (self.bodies.position.copy(), self.bodies.orientation.copy())
        before = (bodies.position.copy(), bodies.orientation.copy())
        velocities = (bodies.velocity, bodies.angular_velocity.copy())
        free = is_active[:, None]
        bodies.velocity = bodies.velocity + np.where(free, dt * self.gravity, 0.0)
        if glue is not None:
            glue.scatter()
        moves = everybody | ~bodies.is_dynamic
        reach = np.where(moves, dt * self._surface_speeds(), 0.0)
        if looked_for is not None:
            reach = np.maximum(reach, looked_for)
        among = np.append(everybody, np.zeros(len(self._fixed_position) - 1, dtype=bool))
        ease = np.zeros((len(bodies) + 1, 7))
        bodies.describe(is_active, self._pose, ease)
        if glue is not None:
            self.bodies.describe(everybody, self._pose, np.zeros_like(ease))
        joints, unstopped = self.joints, (bodies.velocity, bodies.angular_velocity)
        points = None if joints is None else joints.points.state()
        if joints is not None:
            joints.points.push(dt)

        def put_back() -> None:
            """Let all be as it was when the step began."""
            if joints is not None and points is not None:
                joints.points.set_state(points)
            bodies.position, bodies.orientation = before
            bodies.velocity, bodies.angular_velocity = velocities
            if glue is not None:
                glue.scatter()

        self._detector.find(self._poses_described(), self._with_obstacles(reach), among, time_s)
        step = None if joints is None else joints.begin(bodies, dt, is_active, bodies.inverse_inertia())
        carried = partial(self._carried, time_s=time_s + 0.5 * dt) if self.deforming else None
        outcome = self._response.resolve(self._detector, bodies, dt, ease, joints, step, carried)
        if outcome.forces is not None:
            self._detector.keep_forces(outcome.forces)
        if glue is not None and isinstance(self._detector, PartsDetector):
            contacts, pieces = self._detector.contacts(), self._detector.pieces
            friction = self.surfaces.of_pairs(*pieces)[0]
            broken = glue.overloaded(contacts, pieces, friction, outcome.impulses, unstopped, dt, everybody)
            if len(broken) and rounds > 0:
                put_back()
                glue.split(broken)
                self._obey_links()
                self._advance(dt, time_s, everybody, halvings, rounds - 1)
                return
            glue.scatter()
        if looks > 0:
            got = np.where(moves, dt * self._surface_speeds(), 0.0)
            if self._misses(dt, reach, got, moves):
                put_back()
                self._advance(dt, time_s, everybody, halvings, rounds, np.maximum(reach, got), looks - 1)
                return
        self._contact_count = self._detector.active_count()
        self._iterations += outcome.iterations
        self._not_converged += not outcome.converged
        self._max_penetration = max(self._max_penetration, self._detector.deepest)

        is_touched = outcome.is_touched | (bodies.is_pushed & is_active)
        hold = None
        if joints is not None and step is not None:
            hold = joints.hold(
                step,
                bodies,
                outcome.joint_impulses,
                is_touched,
                gravity=self.gravity,
                extra=outcome.extra[:-1],
                is_held=outcome.is_held,
            )
            if hold.is_too_long and halvings > 0:
                put_back()
                for half in range(2):
                    self._advance(0.5 * dt, time_s + half * 0.5 * dt, everybody, halvings - 1)
                return
        if glue is not None:
            glue.settle()

        # One that a fluid pushed is touched as well: the fluid is to see how it moves.
        bodies.is_pushed = bodies.is_pushed & ~is_active
        bodies.fly_on(
            dt, self.gravity, outcome.extra, is_active=is_active, is_touched=is_touched, is_held=outcome.is_held
        )
        if glue is not None:
            glue.scatter()
        if joints is not None:
            joints.points.fly_on(dt)
        self._place_kinematic_bodies(time_s + dt)
        self._detector.follow(self._with_obstacles(self._surface_motion_since(*poses_before)))
        if joints is not None and hold is not None:
            broken = int(joints.is_broken.sum())
            joints.settle(hold, bodies, is_active, bodies.inverse_inertia())
            if glue is not None:
                glue.scatter()
            if int(joints.is_broken.sum()) > broken:
                self._obey_links()

    def _misses(self, dt: float, reach: Array, got: Array, moves: NDArray[np.bool_]) -> bool:
        """Whether bodies that move, (n,), may meet in dt [s] as contacts made them faster than was looked for.

        Surfaces were thought to get so far, and may get so far [m], (n,) each.
        """
        if not np.any(got > reach + LEAST_MISSED * self._edge):
            return False
        bodies = self.bodies
        turning = np.where(moves, dt * (bodies.spins() * self._radius + bodies.deforming), 0.0)
        velocity = np.where(moves[:, None], dt * bodies.velocity, 0.0)
        return self._detector.misses(self._with_obstacles(velocity), self._with_obstacles(turning), LEAST_MISSED)

    def _carried(self, contacts: Contacts, time_s: float) -> Carried:
        """The sides of contacts that are on surfaces that deform, with their velocities at a time [s]."""
        found = []
        for number, deformation in self.deforming.items():
            if self.bodies.deforming[number] == 0.0:
                continue
            turned, velocity = rotation.matrices(self.bodies.orientation[number]), self.bodies.velocity[number]
            for side, own in enumerate((contacts.first, contacts.second)):
                rows = np.flatnonzero(own == number)
                if not len(rows):
                    continue
                arm = contacts.point[rows] - self.bodies.position[number]
                of_surface = deformation.velocities(arm @ turned + self._centres[number], time_s) @ turned.T
                led = velocity + rotation.cross(self.bodies.angular_velocity[number], arm) + of_surface
                found.append((rows, np.full(len(rows), side), led))
        return Carried(*map(np.concatenate, zip(*found, strict=True))) if found else NOT_CARRIED

    def _obey_links(self) -> None:
        """Tell who looks for contacts, and who chooses steps, what joints and glue hold together now."""
        links = []
        if self.joints is not None:
            self._detector.untouching = self.joints.untouching()
            links.append(self.joints.links())
        if self.glue is not None and isinstance(self._detector, PartsDetector):
            stands = np.arange(len(self.bodies), len(self.all_names))
            self._detector.glue(np.concatenate([self.glue.leader, stands]))
            links.append(self.glue.links())
        if links:
            first, second = (np.concatenate(each) for each in zip(*links, strict=True))
            self._chooser.links = first, second

    def _awake(self, dt: float) -> NDArray[np.bool_]:
        """Bodies that do not sleep, (n,), after those were woken that what moves may meet in dt [s], and so on."""
        bodies = self.bodies
        while bodies.is_asleep.any():
            moves = np.where(bodies.is_dynamic, bodies.is_free & ~bodies.is_asleep, self._surface_speeds() > 0.0)
            if not moves.any():
                break
            meetings = self._chooser.meetings(self.poses(), dt, moves)
            met = np.zeros(len(self.all_geometries), dtype=bool)
            met[meetings.first] = met[meetings.second] = True
            if self.joints is not None:
                met[: len(bodies)] |= self.joints.beside(moves)
            if self.glue is not None:
                met[: len(bodies)] |= np.bincount(self.glue.leader, weights=moves)[self.glue.leader] > 0.0
            woken = met[: len(bodies)] & bodies.is_asleep
            if not woken.any():
                break
            bodies.wake(woken)
        return ~bodies.is_asleep

    def _put_to_sleep(self, dt: float) -> None:
        """Let groups sleep that have rested long enough, beside nothing that is led; without gravity nothing rests."""
        bodies, n, speeds = self.bodies, len(self.bodies), self._surface_speeds()
        awake = bodies.is_free & ~bodies.is_asleep
        slow = speeds <= SLEEP_SHARE * LARGEST_DT * float(np.linalg.norm(self.gravity))
        bodies.rest_s = np.where(awake & slow, bodies.rest_s + dt, 0.0)
        rests = awake & (bodies.rest_s >= SLEEP_TIME_S) & ~self.surroundings.stirs(self.gravity)
        if not rests.any() or not self.gravity.any():
            return
        # Those that would wake each other rest together.
        meetings = self._chooser.meetings(self.poses(), dt, ~bodies.is_asleep)
        first, second = (np.minimum(numbers, n) for numbers in (meetings.first, meetings.second))
        free, leads = np.append(awake, False), np.append(~bodies.is_dynamic & (speeds > 0.0), False)
        first, second = (np.concatenate(each) for each in zip((first, second), self._chooser.links, strict=True))
        links = free[first] & free[second]
        groups = groups_of(first[links], second[links], n)
        restless = np.zeros(n, dtype=bool)
        if self.joints is not None:
            restless[groups[self.joints.driven()]] = True
        np.logical_or.at(restless, groups, awake & ~rests)
        for one, two in ((first, second), (second, first)):
            restless[groups[one[free[one] & leads[two]]]] = True
        stopped = rests & ~restless[groups]
        bodies.put_to_sleep(stopped)
        self.surroundings.forget(stopped)

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s` [s]."""
        self.time_s = time_s
        self._contact_count = self._iterations = self._not_converged = 0
        if self.glue is not None:
            self.glue.not_shared = 0
        self._max_penetration = 0.0
        if self.joints is not None:
            self.joints.begin_frame()

    def lead(self, name: str, position: Vector3, *, rotation_deg: Vector3 | None = None, within_s: float) -> None:
        """Lead a kinematic body on, between frames; no checkpoint, nor what `path_onwards` names, knows of it."""
        number = self.bodies.names.index(name) if name in self.bodies.names else -1
        if number not in self.paths:
            raise ValueError(f'no kinematic body is named "{name}"; only such bodies can be led')
        if number in self.deforming:
            raise ValueError(f'"{name}" deforms as its file has it, by time alone; nothing else can lead it')
        now = self.paths[number].at(self.time_s)
        self.paths[number] = path_onwards(now, self.time_s, position, rotation_deg, within_s)
        self._place_kinematic_bodies(self.time_s)  # couplings see how it moves from now on

    def scale_mass(self, name: str, factor: float) -> None:
        """Multiply the mass of a dynamic body by a factor, between frames; no checkpoint knows of it.

        Raises:
            ValueError: there is no such dynamic body, or the factor is not finite and positive.
        """
        number = self.bodies.names.index(name) if name in self.bodies.names else -1
        if number < 0 or not self.bodies.is_dynamic[number]:
            raise ValueError(f'no dynamic body is named "{name}"; only such bodies have a mass')
        if not 0.0 < factor < math.inf:
            raise ValueError(f'the mass of "{name}" can only be scaled by a finite number above 0, got {factor:g}')
        self.bodies.scale_mass(number, factor)
        if self.glue is not None:
            self.glue.weigh()
        self._wake_all()

    def set_surface(self, name: str, *, friction: float | None = None, restitution: float | None = None) -> None:
        """Change how a body rubs and rebounds [-] between frames, static ones included; no checkpoint knows of it.

        Raises:
            ValueError: there is no such body, or a number is out of range.
        """
        if name not in self.all_names:
            raise ValueError(f'no rigid body is named "{name}"')
        if friction is not None and not 0.0 <= friction < math.inf:
            raise ValueError(f'the friction of "{name}" must be finite and at least 0, got {friction:g}')
        if restitution is not None and not 0.0 <= restitution <= 1.0:
            raise ValueError(f'the restitution of "{name}" must lie between 0 and 1, got {restitution:g}')
        number = self.all_names.index(name)
        if friction is not None:
            self.surfaces.friction[number] = friction
        if restitution is not None:
            self.surfaces.restitution[number] = restitution
        self._wake_all()

    def set_gravity(self, gravity: Vector3) -> None:
        """Change gravity [m/s²] between frames, for contacts as well; no checkpoint knows of it."""
        self.gravity[:] = gravity
        self._wake_all()

    def _wake_all(self) -> None:
        self.bodies.wake(np.ones(len(self.bodies), dtype=bool))

    def _with_obstacles(self, motion: Array) -> Array:
        """Motion of the moving bodies, and none of all others."""
        return np.concatenate([motion, np.zeros((len(self._fixed_position), *motion.shape[1:]))])

    def _surface_motion_since(self, position: Array, orientation: Array) -> Array:
        """Upper bound of how far surface points got [m], (n,); a turn by an angle a moves quaternions by 2 sin(a/4)."""
        moved = lengths(self.bodies.position - position)
        return moved + 2.0 * lengths(self.bodies.orientation - orientation) * self._radius

    def _surface_speeds(self) -> Array:
        return self.bodies.surface_speeds(self._radius)

    def _place_kinematic_bodies(self, time_s: float) -> None:
        for number, path in self.paths.items():
            motion = path.at(time_s)
            arm = rotation.rotated(motion.orientation, self.solids[number].centre_of_mass)
            for bodies in self._both:
                bodies.position[number] = motion.position + arm
                bodies.orientation[number] = motion.orientation
                bodies.velocity[number] = motion.velocity + rotation.cross(motion.angular_velocity, arm)
                bodies.angular_velocity[number] = motion.angular_velocity
        for number, deformation in self.deforming.items():
            self.bodies.deforming[number] = deformation.speed(time_s)

    @property
    def _both(self) -> Iterator[MovingBodies]:
        """The bodies, and those that move on their own where some are glued."""
        yield self.bodies
        if self.glue is not None:
            yield self.glue.movers

    def _set_mean_velocities_of_kinematic_bodies(self, time_s: float, dt: float) -> None:
        """Contacts see how kinematic bodies will have moved by the end of the step of dt [s] from a time [s] on."""
        for number, path in self.paths.items():
            end = path.at(time_s + dt)
            arm = rotation.rotated(end.orientation, self.solids[number].centre_of_mass)
            self.bodies.velocity[number] = (end.position + arm - self.bodies.position[number]) / dt
            turn = rotation.product(end.orientation, rotation.conjugate(self.bodies.orientation[number]))
            self.bodies.angular_velocity[number] = rotation.logarithm(turn) / dt

    def _stop_lost_bodies(self) -> None:
        away = lengths(self.bodies.position - self._domain_centre)
        lost = self.bodies.is_free & (away > LOST_DISTANCE * self._domain_diagonal)
        if lost.any():
            if self.glue is not None:
                lost = np.bincount(self.glue.leader, weights=lost)[self.glue.leader] > 0.0
            self.surroundings.forget(lost)
            for bodies in self._both:
                bodies.is_lost |= lost
                bodies.velocity[lost] = bodies.angular_velocity[lost] = 0.0

    def snapshots(self) -> dict[str, Snapshot]:
        """The pose of each body's own mesh at rest, and the velocity of the mesh's origin; of one that a file animates
        the mesh as it is, too.
        """
        bodies = self.bodies
        turned = bodies.rotation()
        snapshots = {}
        for number, name in enumerate(bodies.names):
            arm = -turned[number] @ self._centres[number]
            arrays: dict[str, NDArray[np.generic]] = {
                "position": bodies.position[number] + arm,
                "orientation": bodies.orientation[number].copy(),
                "velocity": bodies.velocity[number] + rotation.cross(bodies.angular_velocity[number], arm),
                "angular_velocity": bodies.angular_velocity[number].copy(),
            }
            if number in self._animated:
                arrays |= self._mesh_of(number, arrays)
            snapshots[name] = Snapshot("rigid", arrays, {}, self._groups[number])
        return snapshots

    def _mesh_of(self, number: int, pose: Mapping[str, Array]) -> dict[str, NDArray[np.generic]]:
        """Vertices [m], (n, 3), how they move [m/s], and triangles, (m, 3), of a body with a pose."""
        mesh = self.solids[number].solid.rest_mesh()
        vertices, own_velocity = mesh.vertices, np.zeros_like(mesh.vertices)
        if number in self.deforming:
            vertices, own_velocity = self.deforming[number].vertices(self.time_s)
        arms = rotation.rotated(pose["orientation"], vertices)
        velocity = pose["velocity"] + rotation.cross(pose["angular_velocity"], arms)
        velocity += rotation.rotated(pose["orientation"], own_velocity)
        return {
            "vertices": (pose["position"] + arms).astype(np.float32),
            "vertex_velocities": velocity.astype(np.float32),
            "triangles": mesh.faces.astype(np.int32),
        }

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:
        """Pose and velocities of a body, and its mesh if a file animates it, as in its snapshot: copies."""
        return dict(self.snapshots()[body].arrays)

    def push(self, body: str, change: NDArray[np.floating]) -> None:
        """Change the velocity of a dynamic body's centre of mass by (3,) [m/s], as a force does that turns nothing.

        Raises:
            ValueError: the body is led by keyframes.
        """
        number = self.bodies.names.index(body)
        if not self.bodies.is_dynamic[number]:
            raise ValueError(f'"{body}" is kinematic: it goes where its keyframes lead it, and no force moves it')
        linear = np.zeros((len(self.bodies), 3))
        linear[number] = self.bodies.mass[number] * change
        self.apply_impulses(linear, np.zeros_like(linear))

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Poses, velocities, sleep, the clock, the contacts, and the forces that the next ones start from."""
        return {
            **{name: getattr(self.bodies, name).copy() for name in _STATE},
            **self._detector.checkpoint(),
            **({} if self.joints is None else self.joints.checkpoint()),
            **({} if self.glue is None else self.glue.checkpoint()),
            **self.surroundings.checkpoint(),
            "clock": np.array([self.time_s]),
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing or has another shape."""
        expected = {**{name: getattr(self.bodies, name).shape for name in _STATE}, "clock": (1,)}
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                found = f"shape {arrays[name].shape}" if name in arrays else "nothing"
                raise ValueError(f"checkpoint of the rigid bodies: {name} must have shape {shape}, got {found}")
        if self.joints is not None:
            self.joints.restore(arrays)
        for name in _STATE:
            setattr(self.bodies, name, np.array(arrays[name], dtype=getattr(self.bodies, name).dtype))
        if self.glue is not None:
            self.glue.restore(arrays)
        self.surroundings.restore(arrays)
        self._obey_links()
        self._detector.restore(arrays)
        self.time_s = float(arrays["clock"][0])

    def diagnostics(self) -> Diagnostics:
        """Totals over the dynamic bodies that are not lost, and the contacts of the frame.

        `angular_momentum_*` [kg m²/s] is about the world's origin, `potential_energy` [J] is zero there; `contacts`
        is their number in the last substep, of bodies that do not sleep, `max_penetration` [m] the worst of the frame,
        `iterations` their sum over the frame, `bodies_lost` the number of bodies stopped far outside of the domain.
        Of joints see `Joints.diagnostics`.
        """
        bodies, free = self.bodies, self.bodies.is_free
        mass = bodies.mass[free]
        momentum = mass[:, None] * bodies.velocity[free]
        spin = bodies.angular_momentum()[free]
        angular = spin + np.cross(bodies.position[free], momentum)
        kinetic = 0.5 * (np.sum(momentum * bodies.velocity[free]) + np.sum(spin * bodies.angular_velocity[free]))
        of_joints = {} if self.joints is None else self.joints.diagnostics()
        of_glue = {}
        if self.glue is not None:
            of_glue = {
                "faces_broken": float(np.count_nonzero(self.glue.is_broken)),
                "loads_not_shared": float(self.glue.not_shared),
            }
        return {
            "mass": float(mass.sum()),
            **_by_axis("momentum", momentum.sum(axis=0)),
            **_by_axis("angular_momentum", angular.sum(axis=0)),
            "kinetic_energy": float(kinetic),
            "potential_energy": -float(np.sum(mass[:, None] * self.gravity * bodies.position[free])),
            "max_speed": self.max_surface_speed(),
            "contacts": float(self._contact_count),
            "max_penetration": self._max_penetration,
            "iterations": float(self._iterations),
            "not_converged": float(self._not_converged),
            "bodies_lost": float(np.count_nonzero(bodies.is_lost)),
            **of_joints,
            **of_glue,
        }

    def remedies(self) -> Remedies:
        """Slower bodies: they choose their steps by how fast their surfaces move and how thick they are."""
        return Remedies(
            runaway="give bodies a lower velocity and angular_velocity, slower keyframes, or densities less far apart",
            short_steps="give bodies a lower velocity and angular_velocity or slower keyframes, or make small and thin "
            "ones larger",
        )

    def first_bad_quantity(self) -> str | None:
        """The first body with a value that is no number, or a velocity beyond all reason."""
        for quantity in _STATE[:4]:
            is_finite = np.isfinite(getattr(self.bodies, quantity))
            if not is_finite.all():
                return f'{quantity} of "{self.bodies.names[int(np.argmin(is_finite.all(axis=1)))]}" is not finite'
        speeds = self._surface_speeds()
        fastest = int(np.argmax(speeds))
        if speeds[fastest] > RUNAWAY_SPEED:
            return f'the speed of "{self.bodies.names[fastest]}" is {speeds[fastest]:.3g} m/s'
        return None


def largest_dt(parameters: Sequence[RigidBodyParameters]) -> float:
    """Largest step [s] of these bodies, however slow they are."""
    has_path = (body.kind == "dynamic" or body.keyframe or body.shape.type == "animation" for body in parameters)
    return LARGEST_DT if any(has_path) else math.inf


_STATE = ("position", "orientation", "velocity", "angular_velocity", "is_lost", "is_asleep", "rest_s")


def _by_axis(name: str, vector: Array) -> dict[str, float]:
    return {f"{name}_{axis}": float(value) for axis, value in zip("xyz", vector, strict=True)}


def _geometries_of(parameters: Sequence[RigidBodyParameters]) -> list[BodyGeometry]:
    """The geometry of each body; bodies of one shape, scale and centre of mass share it."""
    known: dict[tuple[object, ...], BodyGeometry] = {}
    geometries = []
    for body in parameters:
        key: tuple[object, ...] = (body.shape, body.scale)
        if body.ballast:
            key = (*key, body.density, body.ballast)
        if key not in known:
            known[key] = BodyGeometry(body)
        geometries.append(known[key])
    return geometries


def _starting_bodies(parameters: Sequence[RigidBodyParameters], geometries: Sequence[BodyGeometry]) -> MovingBodies:
    """The bodies at time zero; kinematic ones still at their placement."""
    mass, inertia = np.full(len(parameters), np.inf), np.tile(np.eye(3), (len(parameters), 1, 1))
    for number, (body, geometry) in enumerate(zip(parameters, geometries, strict=True)):
        if body.density is not None:
            properties = geometry.mass_properties(body.density)
            mass[number], inertia[number] = properties.mass, properties.inertia
    orientation = np.array([rotation.from_degrees(body.rotation_deg) for body in parameters])
    arms = rotation.rotated(orientation, np.array([geometry.centre_of_mass for geometry in geometries]))
    return MovingBodies(
        [body.name for body in parameters],
        mass,
        inertia,
        position=np.array([body.position for body in parameters]) + arms,
        orientation=orientation,
        velocity=np.array([body.velocity for body in parameters], dtype=np.float64),
        angular_velocity=np.array([body.angular_velocity for body in parameters], dtype=np.float64),
    )


def _poses_of_obstacles(
    obstacles: Sequence[RigidBodyParameters], geometries: Sequence[BodyGeometry]
) -> tuple[Array, Array]:
    """Centres of mass [m], (n + 1, 3), and rotations, (n + 1, 3, 3), of the static bodies and, last, of the domain."""
    positions, rotations = np.zeros((len(obstacles) + 1, 3)), np.tile(np.eye(3), (len(obstacles) + 1, 1, 1))
    for number, (body, geometry) in enumerate(zip(obstacles, geometries, strict=True)):
        rotations[number] = rotation.matrices(rotation.from_degrees(body.rotation_deg))
        positions[number] = np.asarray(body.position) + rotations[number] @ geometry.centre_of_mass
    return positions, rotations
