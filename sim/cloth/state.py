"""The state of all cloths of a scene on the device, one after the other in the same arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import Nodes, Surface
from sim.cloth.parameters import ClothParameters
from sim.cloth.sheet import Edges, RestSheet, edges_of, pieces_of
from sim.cloth.start import quantum_of, start_positions
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import with_room
from sim.core.host_access import copied, viewed
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.reductions import is_finite


@dataclass(frozen=True, eq=False)
class HostCloths:
    """What the cloths of a scene start with, concatenated, on the host.

    Attributes:
        names: of the cloths, (b,).
        first_node: number of the first node of each cloth, and of all nodes, (b + 1,).
        first_triangle: likewise.
        position: at the start [m], (n, 3) float64.
        velocity: at the start [m/s], (n, 3).
        node_area: share of the area of each node [m²], (n,).
        uv: coordinates on the sheet at rest [m], (n, 2).
        triangles: (k, 3) int32.
        edges: of the triangles (`sheet.Edges`).
        body: cloth of each node, (n,) int32.
        is_connected: of each cloth, whether it is one piece.
    """

    names: tuple[str, ...]
    first_node: NDArray[np.int64]
    first_triangle: NDArray[np.int64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    node_area: NDArray[np.float64]
    uv: NDArray[np.float64]
    triangles: NDArray[np.int32]
    edges: Edges
    body: NDArray[np.int32]
    is_connected: tuple[bool, ...]

    @classmethod
    def of(cls, cloths: Sequence[ClothParameters], sheets: Sequence[RestSheet]) -> "HostCloths":
        """Place the sheets in the world."""
        counts = [len(sheet.vertices) for sheet in sheets]
        first_node, first_triangle = (
            np.cumsum([0, *each]) for each in (counts, [len(sheet.triangles) for sheet in sheets])
        )
        triangles = np.concatenate(
            [sheet.triangles + first for sheet, first in zip(sheets, first_node[:-1], strict=True)]
        ).astype(np.int32)
        placed = [start_positions(cloth, sheet) for cloth, sheet in zip(cloths, sheets, strict=True)]
        return cls(
            names=tuple(cloth.name for cloth in cloths),
            first_node=first_node,
            first_triangle=first_triangle,
            position=np.concatenate(placed),
            velocity=np.concatenate([np.tile(cloth.velocity, (n, 1)) for cloth, n in zip(cloths, counts, strict=True)]),
            node_area=np.concatenate([sheet.node_area for sheet in sheets]),
            uv=np.concatenate([sheet.uv for sheet in sheets]),
            triangles=triangles,
            edges=edges_of(triangles),
            body=np.repeat(np.arange(len(cloths), dtype=np.int32), counts),
            is_connected=tuple(not pieces_of(sheet.triangles).any() for sheet in sheets),
        )

    def of_nodes(self, values: Sequence[float]) -> NDArray[np.float64]:
        """A number of each cloth for each of its nodes, (n,)."""
        return np.asarray(values, dtype=np.float64)[self.body]

    def of_triangles(self, values: Sequence[float | Sequence[float]]) -> NDArray[np.float64]:
        """A number of each cloth, or a row of them, for each of its triangles, (k,) or (k, c)."""
        return np.repeat(np.asarray(values, dtype=np.float64), np.diff(self.first_triangle), axis=0)


class ClothState:
    """Nodes, triangles and edges; n nodes, k triangles, e edges, b cloths.

    A substep starts at `lattice` times `quantum`, and `displacement` leads to where it ends; springs and contacts
    change only that. What the lattice cannot hold of a displacement waits in `carry` and is part of the next one: so
    neither velocities nor lengths of springs feel the rounding of positions.

    Attributes:
        host: what they started with, on the host.
        nodes, surface: arrays for kernels; each also an attribute of its own.
        elastic: by how much triangles of meshes displaced nodes in the last step [m], (n,) vec3; 0 elsewhere.
        mass: of a node [kg], (n,), pinned or not.
        carried: what moves along with a node in a substep without weighing on it [kg], (n,).
        body: cloth of a node, (n,) int32.
        triangles: (k,) ivec3.
        names: of the cloths.
        self_collision: of each cloth: whether it collides with itself.
        is_free: of each cloth: whether it is one piece, and no pin holds any of its nodes.
        eyelets: what nodes weigh besides their share of the sheet [kg], (n,).
        quantum: unit of the lattice [m].
        limit: end of the lattice on each axis, in quanta; nodes that come there are stopped.
    """

    def __init__(self, host: HostCloths, *, reach: float) -> None:
        """Place the cloths; masses and surfaces are set by `set_material`.

        Args:
            host: what they start with.
            reach: how far from the origin, along an axis, cloth may come [m].
        """
        n = len(host.position)
        self.host = host
        self.quantum = quantum_of(reach)
        self.limit = int(reach / self.quantum)
        self.nodes: Nodes = with_room(Nodes, n, quantum=self.quantum)
        self.surface: Surface = with_room(Surface, n, displacement=self.nodes.displacement)
        self.lattice, _, self.inverse_mass, self.displacement, self.carry, self.velocity = self.nodes
        self.position, _, self.thickness, self.friction = self.surface
        self.elastic = ti.Vector.ndarray(3, ti.f32, n)
        self.mass, self.carried = ti.ndarray(ti.f32, n), ti.ndarray(ti.f32, n)
        self.body, self.triangles = on_device(host.body), on_device(host.triangles)
        self.eyelets = np.zeros(n)
        self.self_collision: tuple[bool, ...] = ()
        self.is_free: tuple[bool, ...] = ()
        self.set_positions(host.position)
        self.velocity.from_numpy(host.velocity.astype(np.float32))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cloths."""
        return self.host.names

    @property
    def vertex_count(self) -> int:
        """Number of nodes."""
        return len(self.host.position)

    @property
    def triangle_count(self) -> int:
        """Number of triangles."""
        return len(self.host.triangles)

    def set_positions(self, positions: NDArray[np.floating]) -> None:
        """Put all nodes at world positions [m], (n, 3)."""
        exact = np.asarray(positions, dtype=np.float64)
        lattice = np.round(exact / self.quantum)
        self.lattice.from_numpy(lattice.astype(np.int32))
        self.carry.from_numpy((exact - lattice * self.quantum).astype(np.float32))
        self.place_displaced()

    def positions(self) -> NDArray[np.float64]:
        """World positions [m], (n, 3) float64."""
        positions: NDArray[np.float64] = copied(self.lattice) * self.quantum + copied(self.carry)
        return positions

    def positions_of(self, nodes: NDArray[np.int64]) -> NDArray[np.float64]:
        """World positions of some nodes [m], (h, 3) float64."""
        positions: NDArray[np.float64] = viewed(self.lattice)[nodes] * self.quantum + viewed(self.carry)[nodes]
        return positions

    def place_displaced(self) -> None:
        """Follow the lattice with what is derived from it: float32 positions, and displacements of nothing yet."""
        round_positions(self.nodes, self.position)

    def set_material(self, cloths: Sequence[ClothParameters]) -> None:
        """Take mass, thickness, friction and whether they collide with themselves from the cloths' parameters."""
        of_nodes = self.host.of_nodes
        mass = self.host.node_area * of_nodes([cloth.mass_per_area for cloth in cloths]) + self.eyelets
        self.mass.from_numpy(mass.astype(np.float32))
        self.thickness.from_numpy(of_nodes([cloth.thickness for cloth in cloths]).astype(np.float32))
        self.friction.from_numpy(of_nodes([cloth.friction for cloth in cloths]).astype(np.float32))
        self.self_collision = tuple(cloth.self_collision for cloth in cloths)

    def set_pinned(self, is_pinned: NDArray[np.bool_]) -> None:
        """Hold these nodes, (n,), and no others."""
        held = np.bincount(self.host.body, weights=is_pinned, minlength=len(self.names))
        self.is_free = tuple(
            bool(count == 0) and whole for count, whole in zip(held, self.host.is_connected, strict=True)
        )
        mass = self.mass.to_numpy()
        self.inverse_mass.from_numpy(np.where(is_pinned, 0.0, 1.0 / mass).astype(np.float32))


@kernel
def round_positions(nodes: Nodes, position: Vectors):
    """float32 positions from the lattice; displacements that hold what it lacks."""
    for i in range(nodes.lattice.shape[0]):
        position[i] = ti.cast(nodes.lattice[i], ti.f32) * nodes.quantum
        nodes.displacement[i] = nodes.carry[i]


LARGEST_MOVE = 2.0**29  # most quanta in a step: a quarter of the lattice, so that integers do not overflow


@kernel
def move_pinned(
    nodes: Integers,
    arm: Vectors,
    carry: Vectors,
    shift: ti.math.vec3,
    turn_x: ti.math.vec3,
    turn_y: ti.math.vec3,
    turn_z: ti.math.vec3,
    displacement: Vectors,
):
    """Displace pinned nodes by a shift, and by the change of a rotation, given by rows, times their arms."""
    for k in range(nodes.shape[0]):
        turned = ti.math.vec3(turn_x.dot(arm[k]), turn_y.dot(arm[k]), turn_z.dot(arm[k]))
        displacement[nodes[k]] = carry[nodes[k]] + shift + turned


@kernel
def finish_step(nodes: Nodes, position: Vectors, limit: ti.i32, dt: ti.f32, reasons: Integers):
    """Velocities from displacements; the whole quanta of these onto the lattice, the rest is carried on.

    A velocity changes by what the displacement differs from dt times itself, as the rounding of 1/dt would make all
    velocities grow or shrink alike. Nodes stop at the ends of the lattice. Where a displacement is not finite, the
    velocity shows it. Nothing is done unless the three `reasons` why the substep may not be over are 0.
    """
    end = ti.select(reasons[0] + reasons[1] + reasons[2] == 0, position.shape[0], 0)
    for i in range(end):
        u_i = nodes.displacement[i]
        v_i = nodes.velocity[i] + (u_i - (nodes.carry[i] + dt * nodes.velocity[i])) / dt
        for axis in ti.static(range(3)):
            if is_finite(u_i[axis]):
                quanta = ti.round(u_i[axis] / nodes.quantum)
                rest = u_i[axis] - quanta * nodes.quantum
                whole = ti.cast(ti.max(-LARGEST_MOVE, ti.min(quanta, LARGEST_MOVE)), ti.i32)
                place = nodes.lattice[i][axis] + whole
                if ti.abs(place) >= limit:
                    place = ti.max(-limit, ti.min(place, limit))
                    rest = 0.0
                    v_i[axis] = 0.0
                nodes.lattice[i][axis] = place
                position[i][axis] = ti.cast(place, ti.f32) * nodes.quantum
                nodes.carry[i][axis] = rest
        nodes.velocity[i] = v_i
        nodes.displacement[i] = nodes.carry[i]


class Load(Protocol):
    """What changes masses and velocities of nodes for a substep."""

    def put_on(self, state: ClothState, gravity: Vector3, dt: float) -> None:
        """Right before a substep of dt [s] under gravity [m/s²]."""

    def take_off(self, state: ClothState) -> None:
        """Right after it."""


class NodeLoad:
    """Mass that moves along with the nodes in a substep without weighing on them, and impulses.

    Attributes:
        mass: of each node's load [kg], (n,).
        impulse: on each node together with its load [N s], (n,) vec3.
    """

    def __init__(self, count: int) -> None:
        self.mass, self._own_inverse = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        self.impulse = ti.Vector.ndarray(3, ti.f32, count)

    def put_on(self, state: ClothState, gravity: Vector3, dt: float) -> None:
        """Let the nodes take their impulses and carry their loads; gravity [m/s²] is what they will feel in dt [s]."""
        own = self._own_inverse, state.carried
        put_on_load(self.mass, self.impulse, *own, ti.math.vec3(*gravity), dt, state.nodes)

    def take_off(self, state: ClothState) -> None:
        """Give the nodes their own masses back."""
        take_off_load(self._own_inverse, state.inverse_mass, state.carried)


@kernel
def put_on_load(
    mass: Floats, impulse: Vectors, own: Floats, carried: Floats, gravity: ti.math.vec3, dt: ti.f32, nodes: Nodes
):
    """v_n += J_n/(m_n + m_load), less what gravity would do to the load, with the mass of both from then on; `own`
    inverse masses are kept.
    """
    for n in range(mass.shape[0]):
        w_n = nodes.inverse_mass[n]
        own[n] = w_n
        if w_n > 0.0:
            with_load = w_n / (1.0 + mass[n] * w_n)
            nodes.velocity[n] += with_load * (impulse[n] - dt * mass[n] * gravity)
            nodes.inverse_mass[n] = with_load
            carried[n] += mass[n]


@kernel
def take_off_load(own_inverse: Floats, inverse_mass: Floats, carried: Floats):
    """The masses that nodes had before."""
    for n in range(inverse_mass.shape[0]):
        inverse_mass[n] = own_inverse[n]
        carried[n] = 0.0
