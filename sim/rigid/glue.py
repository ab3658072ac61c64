"""Pieces that are glued together: they move as one body until the stress on a face between them is too large.

Stresses are those of a rigid body spring model (Kawai 1978, "New discrete models and their application to seismic
response analysis of structure"; on Voronoi cells Bolander & Saito 1998, "Fracture analyses using spring networks with
random geometry"): pieces are rigid, and each face between two is an elastic layer as thick as their centres are apart.
In every step the layers carry the difference between what acts on each piece, and what moves it with the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from sim.core.motion import rotation
from sim.core.solver import Arrays
from sim.rigid.contacts import Array, Contacts, Indices
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.states import MovingBodies
from sim.rigid.steps import groups_of
from sim.rigid.supports import Supports, friction_pyramid, least_shares
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.cutting import cut_of
from sim.shapes.parameters import PieceShape
from sim.shapes.placement import PlacedSolid

POISSON_RATIO = 0.2
"""Of brittle solids [-], about; Young's modulus does not change how loads are shared."""
LEAST_THICKNESS = 0.1  # of a layer, in distances of its pieces' centres
TOGETHER = 0.9
"""Share of the largest stress of a body from which on faces break together: those that symmetry makes alike."""
IMPACT_SPEED = 0.1
"""Approach from which on a contact is a blow, which lasts for a time of its own [m/s]: five steps of gravity."""
CENTRIFUGAL_SHARE = 0.01  # of the strength: what turning must stress at least to be looked at without any contact
TOUCHING = 1.0e-5  # gap of what may carry a body, in its sizes
MOST_ROUNDS = 30  # in which a step is taken again because bodies broke in it


@dataclass(frozen=True, eq=False)
class Faces:
    """All faces between pieces, in the axes of their wholes, about the whole's own origin."""

    first: Indices  # numbers of the two bodies, (f,)
    second: Indices
    strength: Array  # [Pa], (f,)
    normal: Array  # out of the first, (f, 3)
    corner_face: Indices  # of all corners of the triangles: number of the face, (c,)
    corner: Array  # [m], (c, 3)
    share: Array  # of the area of its face that a corner stands for [m²], (c,)


class Whole(NamedTuple):
    """A body that was cut into pieces."""

    shape: PieceShape  # of one of them
    scale: float  # [-]
    pieces: Indices  # numbers of their bodies, (p,)

    def solid(self) -> PlacedSolid:
        """What it is in one piece, in the axes of its pieces, about its own origin."""
        return PlacedSolid(cut_of(self.shape).whole, self.scale, np.eye(3), np.zeros(3))


class _Component(NamedTuple):
    """Pieces that hold together: how loads on them stress the faces between them."""

    pieces: Indices  # (m,)
    faces: Indices  # that hold, (f,)
    corners: Indices  # of these faces, (c,)
    size: float  # unit of length in the stiffness [m]
    stiffness: Any  # factors of it, without the first piece
    traction: csc_matrix  # on corners, of motions of the pieces but the first, (3 c, 6 (m - 1))


class _Touching(NamedTuple):
    """The contacts of a step, and what they do."""

    contacts: Contacts  # in numbers of movers
    pieces: tuple[Indices, Indices]  # the two bodies of each, (k,) each
    friction: Array  # [-], (k,)
    impulses: Array  # on their first bodies [N s], (k, 3)
    load: Array  # impulses and their moments on all bodies, of what is no contact as well [N s], (n, 6)


class Glue:
    """Which pieces hold together, and what they do as one.

    Attributes:
        leader: number of the body that stands for all that a body is glued to, its own if for none, (n,).
        arm: from its leader's centre of mass to that of each body, in its own axes [m], (n, 3).
        movers: bodies that move on their own, at the numbers of their leaders; others mean nothing.
        wholes: what the pieces are of.
        centre: centre of mass of each body, in the axes and about the origin of its whole [m], (n, 3).
        faces: all faces between pieces, (f,).
        is_broken: of these, (f,) bool.
        not_shared: how often in a frame no better share of a load was found than the contacts' own.
    """

    def __init__(
        self, parameters: Sequence[RigidBodyParameters], geometries: Sequence[BodyGeometry], bodies: MovingBodies
    ) -> None:
        """Take all moving bodies, with pieces where their wholes place them; sets the velocities of the pieces."""
        self._bodies, n = bodies, len(bodies)
        self.centre = np.array([geometry.centre_of_mass for geometry in geometries])
        self._is_piece = np.array([body.whole is not None for body in parameters])
        self._impact_s = np.array([1.0 if body.breaks is None else body.breaks.impact_s for body in parameters])
        self.wholes = tuple(_wholes_of(parameters))
        self.faces = _faces_of(parameters, self.wholes)
        self.is_broken: NDArray[np.bool_] = np.zeros(len(self.faces.first), dtype=bool)
        self.leader, self.arm = np.arange(n), np.zeros((n, 3))
        self._known: dict[int, _Component] = {}
        self._rest, self._blow = np.zeros((n, 6)), np.zeros((n, 6))  # force [N] and last blow [N s] on each piece
        self.not_shared = 0
        self._was_hit = np.zeros(n, dtype=bool)  # whether a blow began in the last step
        self._next: tuple[Array, Array, Array, NDArray[np.bool_]] | None = None
        self._pushes = np.zeros((n, 6))  # impulses of what is no contact since the last step [N s]
        self.movers = MovingBodies(
            bodies.names,
            bodies.mass.copy(),
            bodies.tensors.copy(),
            position=bodies.position.copy(),
            orientation=bodies.orientation.copy(),
            velocity=bodies.velocity.copy(),
            angular_velocity=bodies.angular_velocity.copy(),
        )
        self.weigh()
        led = self._is_piece & self.is_leader
        arms = np.einsum("nij,nj->ni", bodies.rotation(), self.arm)
        self.movers.position = np.where(led[:, None], bodies.position - arms, bodies.position)
        self.scatter()

    @property
    def is_glued(self) -> NDArray[np.bool_]:
        """Whether a body is glued to others, (n,)."""
        result: NDArray[np.bool_] = np.bincount(self.leader, minlength=len(self.leader))[self.leader] > 1
        return result

    @property
    def is_leader(self) -> NDArray[np.bool_]:
        """Whether a body moves on its own, or for others, (n,)."""
        result: NDArray[np.bool_] = self.leader == np.arange(len(self.leader))
        return result

    def links(self) -> tuple[Indices, Indices]:
        """Pairs of bodies that are glued, each to its leader, (l,) each."""
        led = np.flatnonzero(~self.is_leader)
        return led, self.leader[led]

    def weigh(self) -> None:
        """Find what holds together by what is not broken, and its masses by those of the bodies."""
        holds, n = ~self.is_broken, len(self.leader)
        groups = groups_of(self.faces.first[holds], self.faces.second[holds], n)
        lowest = np.full(n, n)
        np.minimum.at(lowest, groups, np.arange(n))
        self.leader, self._known = lowest[groups], {}
        mass, tensors = self._bodies.mass, self._bodies.tensors
        alone = self._bodies.is_dynamic & ~self._is_piece
        for body in np.flatnonzero(alone & (self.movers.mass != mass)):
            self.movers.set_inertia(int(body), float(mass[body]), tensors[body])
        pieces = np.flatnonzero(self._is_piece)
        for leader in np.unique(self.leader[pieces]):
            mine = pieces[self.leader[pieces] == leader]
            total = mass[mine].sum()
            centre = mass[mine] @ self.centre[mine] / total
            self.arm[mine] = self.centre[mine] - centre
            arms = self.arm[mine]
            squares = np.einsum("ni,ni->n", arms, arms)[:, None, None] * np.eye(3)
            spread = mass[mine, None, None] * (squares - arms[:, :, None] * arms[:, None, :])
            self.movers.set_inertia(int(leader), float(total), (tensors[mine] + spread).sum(axis=0))

    def split(self, faces: Indices) -> None:
        """Break faces: what comes apart goes on as it moved, which changes no momentum."""
        self.is_broken[faces] = True
        self.weigh()
        bodies, movers, at = self._bodies, self.movers, np.flatnonzero(self._is_piece & self.is_leader)
        arms = np.einsum("nij,nj->ni", rotation.matrices(bodies.orientation[at]), self.arm[at])
        movers.position[at] = bodies.position[at] - arms
        movers.orientation[at] = bodies.orientation[at]
        movers.velocity[at] = bodies.velocity[at] - rotation.cross(bodies.angular_velocity[at], arms)
        movers.angular_velocity[at] = bodies.angular_velocity[at]
        movers.is_lost[at] = bodies.is_lost[at]
        self.scatter()

    def gather(self) -> None:
        """Take what happened to the bodies since `scatter`: pushes, which act on all that a piece is glued to."""
        bodies, movers, glued = self._bodies, self.movers, self.is_glued
        movers.is_pushed = bodies.is_pushed.copy()
        for name in ("position", "orientation"):
            held = glued[:, None]
            setattr(movers, name, np.where(held, getattr(movers, name), getattr(bodies, name)))
        change = bodies.velocity - self._velocities()
        turn = bodies.angular_velocity - movers.angular_velocity[self.leader]
        for name in ("velocity", "angular_velocity"):
            setattr(movers, name, np.where(glued[:, None], getattr(movers, name), getattr(bodies, name)))
        changed = np.flatnonzero(glued & (change.any(axis=1) | turn.any(axis=1)))
        if not len(changed):
            return
        linear = bodies.mass[changed, None] * change[changed]
        turned = bodies.rotation()[changed]
        angular = np.einsum("nij,njk,nlk,nl->ni", turned, bodies.tensors[changed], turned, turn[changed])
        self._pushes[changed] += np.concatenate([linear, angular], axis=1)
        arms = np.einsum("nij,nj->ni", turned, self.arm[changed])
        sums = np.zeros((2, len(bodies), 3))
        np.add.at(sums[0], self.leader[changed], linear)
        np.add.at(sums[1], self.leader[changed], angular + rotation.cross(arms, linear))
        np.logical_or.at(movers.is_pushed, self.leader[changed], bodies.is_pushed[changed])
        movers.velocity = movers.velocity + movers.inverse_mass[:, None] * sums[0]
        movers.angular_velocity = movers.angular_velocity + np.einsum("nij,nj->ni", movers.inverse_inertia(), sums[1])
        asleep = glued & self.is_leader & bodies.is_asleep
        movers.velocity[asleep] = movers.angular_velocity[asleep] = 0.0

    def share(self) -> None:
        """Let all that a body is glued to take part in pushes that it got, at once."""
        bodies = self._bodies
        beside = np.bincount(self.leader, weights=~bodies.is_asleep)[self.leader] > 0.0
        bodies.wake(bodies.is_asleep & beside)
        self.gather()
        self.scatter()

    def _velocities(self) -> Array:
        """Velocities of all bodies as their leaders move them [m/s], (n, 3)."""
        movers, leader = self.movers, self.leader
        arms = np.einsum("nij,nj->ni", movers.rotation()[leader], self.arm)
        result: Array = movers.velocity[leader] + rotation.cross(movers.angular_velocity[leader], arms)
        return result

    def scatter(self) -> None:
        """Put all bodies where their leaders have them."""
        bodies, movers, leader = self._bodies, self.movers, self.leader
        arms = np.einsum("nij,nj->ni", movers.rotation()[leader], self.arm)
        bodies.position = movers.position[leader] + arms
        bodies.orientation = movers.orientation[leader]
        bodies.velocity = self._velocities()
        bodies.angular_velocity = movers.angular_velocity[leader]
        bodies.is_lost, bodies.is_pushed = movers.is_lost[leader], movers.is_pushed[leader]

    def overloaded(
        self,
        contacts: Contacts,
        pieces: tuple[Indices, Indices],
        friction: Array,
        impulses: Array,
        velocity: tuple[Array, Array],
        dt: float,
        is_active: NDArray[np.bool_],
    ) -> Indices:
        """Faces that do not hold in a step of dt [s] of active bodies, (n,).

        Args:
            contacts: of the step, in numbers of movers.
            pieces: the two bodies of each contact, (k,) each.
            friction: of the contacts [-], (k,).
            impulses: of the contacts on their first bodies [N s], (k, 3).
            velocity: of the movers before the contacts, [m/s] and [rad/s], (n, 3) each.
            dt: the step [s].
            is_active: the bodies that take it, (n,).
        """
        n, load = len(self.leader), self._pushes.copy()
        for sign, own in ((1.0, pieces[0]), (-1.0, pieces[1])):
            rows = np.flatnonzero(own < n)
            arms = contacts.point[rows] - self._bodies.position[own[rows]]
            wrench = sign * np.concatenate([impulses[rows], rotation.cross(arms, impulses[rows])], axis=1)
            np.add.at(load, own[rows], wrench)
        is_hit = self._struck(contacts, impulses, velocity)[self.leader]
        # A blow is what is more than the force of before; it may be in two steps, as gaps close in the first.
        is_struck = (is_hit | self._was_hit)[:, None]
        more, blow_s = load - dt * self._rest, self._impact_s[:, None]
        blow = np.where(is_struck, more, 0.0)
        force = self._rest + np.where(is_struck, (blow + self._blow) / blow_s, more / np.maximum(blow_s, dt))
        active = is_active & self._is_piece
        rest = np.where(active[:, None] & ~is_struck, force, self._rest)
        self._next = (
            rest,
            np.where(active[:, None], blow, self._blow),
            np.where(active[:, None], 0.0, self._pushes),
            np.where(active, is_hit, self._was_hit),
        )
        broken = [np.zeros(0, dtype=np.int64)]
        touching = _Touching(contacts, pieces, friction, impulses, load)
        for leader in map(int, np.unique(self.leader[active & self.is_glued])):
            broken.append(self._overloaded_of(leader, force, touching))
        return np.concatenate(broken)

    def settle(self) -> None:
        """Keep the loads of the step just taken."""
        assert self._next is not None, "loads are looked at before a step ends"
        self._rest, self._blow, self._pushes, self._was_hit = self._next

    def _struck(self, contacts: Contacts, impulses: Array, velocity: tuple[Array, Array]) -> NDArray[np.bool_]:
        """Movers that a blow goes through, (n,), wherever it came from."""
        n = len(self.leader)
        rows = np.flatnonzero(impulses.any(axis=1))
        sides = []
        for mover in (contacts.first[rows], contacts.second[rows]):
            inside = np.minimum(mover, n - 1)
            arms = contacts.point[rows] - self.movers.position[inside]
            at = velocity[0][inside] + rotation.cross(velocity[1][inside], arms)
            sides.append(np.where((mover < n)[:, None], at, 0.0))
        speed = -np.einsum("ki,ki->k", contacts.normal[rows], sides[0] - sides[1])
        first, second = (np.minimum(each[rows], n) for each in (contacts.first, contacts.second))
        is_link = (np.append(self.movers.is_free, False)[first]) & (np.append(self.movers.is_free, False)[second])
        groups = np.append(groups_of(first[is_link], second[is_link], n), n)
        struck = np.zeros(n + 1, dtype=bool)
        fast = speed > IMPACT_SPEED
        struck[groups[first[fast]]] = struck[groups[second[fast]]] = True
        struck[n] = False
        result: NDArray[np.bool_] = struck[groups[:n]]
        return result

    def _overloaded_of(self, leader: int, force: Array, touching: _Touching) -> Indices:
        """Faces of one body that do not hold under forces [N] and torques [N m] on its pieces, (n, 6).

        Where some would not, what it stands on may share the load in another way.
        """
        if leader not in self._known:
            self._known[leader] = self._component(leader)
        found, movers = self._known[leader], self.movers
        turned = rotation.matrices(movers.orientation[leader])
        spin = turned.T @ movers.angular_velocity[leader]
        farthest = float(np.square(self.arm[found.pieces]).sum(axis=1).max())
        density = self._bodies.mass[found.pieces].sum() / found.size**3
        least = CENTRIFUGAL_SHARE * self.faces.strength[found.faces].min()
        if not force[found.pieces].any() and density * (spin @ spin) * farthest < least:
            return np.zeros(0, dtype=np.int64)
        load = self._unbalanced(found, leader, force, turned, spin)
        use = self._use(found, load)
        if use.max(initial=0.0) > 1.0:
            supports = self._supports(found, leader, force, touching, turned)
            try:
                use = self._use(found, load + _relief(found, supports, load)) if len(supports.piece) else use
            except RuntimeError:  # what the solver of contacts found is a share as good for how the body moves
                self.not_shared += 1
        return found.faces[(use > 1.0) & (use >= TOGETHER * use.max())]

    def _unbalanced(self, found: _Component, leader: int, force: Array, turned: Array, spin: Array) -> Array:
        """What acts on pieces less what their part of the acceleration takes [N], (m, 6), in the body's axes.

        Moments are divided by the size.
        """
        pieces, movers, bodies = found.pieces, self.movers, self._bodies
        arms, mass, tensors = self.arm[pieces], bodies.mass[pieces], bodies.tensors[pieces]
        own_force, torque = force[pieces, :3] @ turned, force[pieces, 3:] @ turned
        inertia = movers.tensors[leader]
        total = (torque + np.cross(arms, own_force)).sum(axis=0)
        spin_up = np.linalg.solve(inertia, total - np.cross(spin, inertia @ spin))
        acceleration = own_force.sum(axis=0) / movers.mass[leader]
        acceleration = acceleration + np.cross(spin_up, arms) + np.cross(spin, np.cross(spin, arms))
        own_force = own_force - mass[:, None] * acceleration
        torque = torque - (tensors @ spin_up + np.cross(spin, tensors @ spin))
        return np.concatenate([own_force, torque / found.size], axis=1)

    def _use(self, found: _Component, load: Array) -> Array:
        """Largest stress on each face that holds, of loads on pieces [N], (m, 6), over its strength [-], (f,)."""
        motion = found.stiffness.solve(load[1:].ravel())
        traction = (found.traction @ motion).reshape(-1, 3) / found.size**2
        faces = self.faces
        normal = faces.normal[faces.corner_face[found.corners]]
        pull = np.einsum("ci,ci->c", traction, normal)
        shear = np.square(traction - pull[:, None] * normal).sum(axis=1)
        stress = 0.5 * pull + np.sqrt(0.25 * pull * pull + shear)
        largest = np.zeros(len(self.is_broken))
        np.maximum.at(largest, faces.corner_face[found.corners], stress)
        use: Array = largest[found.faces] / faces.strength[found.faces]
        return use

    def _supports(self, found: _Component, leader: int, force: Array, touching: _Touching, turned: Array) -> Supports:
        """What carries a body that forces [N], (n, 6), act on: all that touches it, whatever it carries now."""
        contacts, n = touching.contacts, len(self.leader)
        is_free = np.append(self.movers.is_free, False)
        pushes, loads = force[found.pieces, :3], touching.load[found.pieces, :3]
        per_impulse = float((pushes * loads).sum() / max(float(np.square(loads).sum()), np.finfo(float).tiny))
        carried, parts = per_impulse * touching.impulses, []
        for sign, own, others, of_piece in (
            (1.0, contacts.first, contacts.second, touching.pieces[0]),
            (-1.0, contacts.second, contacts.first, touching.pieces[1]),
        ):
            near = carried.any(axis=1) | (contacts.gap <= TOUCHING * found.size)
            rows = np.flatnonzero((own == leader) & near)
            normal, pushed = sign * contacts.normal[rows] @ turned, sign * carried[rows] @ turned
            forces, shares = friction_pyramid(normal, pushed, touching.friction[rows])
            piece = np.searchsorted(found.pieces, of_piece[rows])
            place = (contacts.point[rows] - self._bodies.position[of_piece[rows]]) @ turned
            other = np.minimum(others[rows], n)
            other = np.where(is_free[other], other, n)  # what stands or is led is one support
            arm = place + self.arm[found.pieces[piece]]
            for unit, share in zip(forces, shares, strict=True):
                parts.append(Supports(piece, unit, np.cross(place, unit), arm, other, share))
        return Supports(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _component(self, leader: int) -> _Component:
        """The stiffness of what a leader leads."""
        faces = self.faces
        pieces = np.flatnonzero(self.leader == leader)
        holds = ~self.is_broken & (self.leader[faces.first] == leader)
        corners = np.flatnonzero(holds[faces.corner_face])
        of_face = faces.corner_face[corners]
        place, normal = faces.corner[corners], faces.normal[of_face]
        size = float(np.ptp(place, axis=0).max())
        apart = self.centre[faces.second] - self.centre[faces.first]
        along = np.abs(np.einsum("fi,fi->f", apart, faces.normal))
        thickness = np.maximum(along, LEAST_THICKNESS * np.linalg.norm(apart, axis=1))[of_face] / size
        outer = normal[:, :, None] * normal[:, None, :]
        slide = 0.5 / (1.0 + POISSON_RATIO)  # shear modulus over Young's
        layer = (outer + slide * (np.eye(3) - outer)) / thickness[:, None, None]
        # How far a layer opens at its corners, of motions and turns of the pieces on both sides.
        rows, columns, values = [], [], []
        row = np.arange(3 * len(corners)).reshape(-1, 3)
        for sign, bodies in ((-1.0, faces.first[of_face]), (1.0, faces.second[of_face])):
            arm = (place - self.centre[bodies]) / size
            number = np.searchsorted(pieces, bodies)
            block = np.zeros((len(corners), 3, 6))
            block[:, :, :3] = np.eye(3)
            for axis in range(3):
                block[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
            rows.append(np.broadcast_to(row[:, :, None], block.shape).ravel())
            at = (6 * number[:, None] + np.arange(6))[:, None, :]
            columns.append(np.broadcast_to(at, block.shape).ravel())
            values.append(sign * block.ravel())
        shape = (3 * len(corners), 6 * len(pieces))
        index = np.concatenate(rows), np.concatenate(columns)
        opening = csc_matrix(coo_matrix((np.concatenate(values), index), shape))[:, 6:]
        blocks = (np.repeat(row, 3, axis=1).ravel(), np.tile(row, (1, 3)).ravel())
        elastic = csc_matrix(coo_matrix((layer.ravel(), blocks), (shape[0], shape[0])))
        # Of a linear field over a triangle, the mean of squares is that of midpoints of its edges.
        third = np.arange(len(corners)).reshape(-1, 3)
        middle = csc_matrix(
            coo_matrix(
                (
                    np.full(2 * len(corners), 0.5),
                    (np.repeat(third.ravel(), 2), np.stack([third, np.roll(third, -1, axis=1)], axis=2).ravel()),
                ),
                (len(corners), len(corners)),
            )
        )
        spread = csc_matrix(_kron3(middle))
        weight = np.repeat(faces.share[corners] / size**2, 3)
        midpoints = spread @ opening
        stiffness = midpoints.T @ (elastic.multiply(weight[:, None]) @ midpoints)
        return _Component(pieces, np.flatnonzero(holds), corners, size, splu(csc_matrix(stiffness)), elastic @ opening)

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """What is broken, how what holds together moves, and the loads of the last step."""
        return {
            "glue_broken": self.is_broken.copy(),
            "glue_hit": self._was_hit.copy(),
            "glue_loads": np.stack([self._rest, self._blow, self._pushes]),
            **{f"glue_{name}": getattr(self.movers, name).copy() for name in _STATE},
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing or has another shape."""
        expected = {"glue_broken": self.is_broken.shape, "glue_hit": self._was_hit.shape}
        expected |= {"glue_loads": (3, *self._rest.shape)}
        expected |= {f"glue_{name}": getattr(self.movers, name).shape for name in _STATE}
        for name, shape in expected.items():
            if name not in arrays or arrays[name].shape != shape:
                raise ValueError(f"checkpoint of the rigid bodies: {name} must have shape {shape}")
        self.is_broken = np.array(arrays["glue_broken"], dtype=bool)
        self._was_hit = np.array(arrays["glue_hit"], dtype=bool)
        self._rest, self._blow, self._pushes = np.array(arrays["glue_loads"], dtype=np.float64)
        self.weigh()
        for name in _STATE:
            setattr(self.movers, name, np.array(arrays[f"glue_{name}"], dtype=getattr(self.movers, name).dtype))


_STATE = ("position", "orientation", "velocity", "angular_velocity", "is_lost", "is_pushed")


def _relief(found: _Component, supports: Supports, load: Array) -> Array:
    """How loads on pieces [N], (m, 6), change as supports share what they carry with the least energy."""
    k, rows = len(supports.piece), np.arange(len(supports.piece))
    of_each = np.zeros((k, *load.shape))
    of_each[rows, supports.piece, :3], of_each[rows, supports.piece, 3:] = supports.force, supports.moment / found.size
    columns = of_each[:, 1:].reshape(k, -1)
    unsupported = load - np.tensordot(supports.carried, of_each, axes=1)
    motions = found.stiffness.solve(np.ascontiguousarray(columns.T))
    shares = least_shares(supports, columns @ motions, motions.T @ unsupported[1:].ravel(), found.size)
    change: Array = np.tensordot(shares - supports.carried, of_each, axes=1)
    return change


def _kron3(matrix: csc_matrix) -> Any:
    """A matrix of numbers as one of vectors of three."""
    from scipy.sparse import identity, kron

    return kron(matrix, identity(3))


def _wholes_of(parameters: Sequence[RigidBodyParameters]) -> Iterator[Whole]:
    """What all pieces are of."""
    numbers: dict[str, list[int]] = {}
    for number, body in enumerate(parameters):
        if body.whole is not None:
            numbers.setdefault(body.whole, []).append(number)
    for pieces in numbers.values():
        shape, scale = parameters[pieces[0]].shape, parameters[pieces[0]].scale
        assert isinstance(shape, PieceShape), "pieces are made by what breaks"
        yield Whole(shape, scale, np.array(pieces))


def _faces_of(parameters: Sequence[RigidBodyParameters], wholes: Sequence[Whole]) -> Faces:
    """The faces between all pieces of bodies."""
    first, second, strength, normal, triangles = [], [], [], [], []
    for whole in wholes:
        numbers = whole.pieces
        breaks = parameters[numbers[0]].breaks
        assert breaks is not None, "pieces are made by what breaks"
        for face in cut_of(whole.shape).faces:
            first.append(numbers[face.first])
            second.append(numbers[face.second])
            strength.append(breaks.strength)
            normal.append(face.normal)
            triangles.append(whole.scale * face.triangles)
    counts = [3 * len(each) for each in triangles]
    corners = np.concatenate([np.zeros((0, 3, 3)), *triangles])
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(*sides), axis=1)
    return Faces(
        np.array(first, dtype=np.int64),
        np.array(second, dtype=np.int64),
        np.array(strength),
        np.array(normal).reshape(-1, 3),
        np.repeat(np.arange(len(counts)), counts),
        corners.reshape(-1, 3),
        np.repeat(area / 3.0, 3),
    )
