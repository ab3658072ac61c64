"""Two-way coupling of cloths and the particle fluid that they are in, and the samples of cloths that it feels."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.sheet import RestSheet, build_sheet, triangle_areas
from sim.cloth.solver import ClothSolver
from sim.cloth.state import NodeLoad
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, reduced_tree
from sim.core.solver import Coupling
from sim.fluid.boundary import Samples, Sheets
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.fluid import SPHFluid
from sim.fluid.kernels import SUPPORT_IN_SPACINGS
from sim.fluid.sheets import SheetSamples, kept_away, sheet_depth, volume_per_area

MAXIMA = 3
TINY_AREA = 1.0e-20  # keeps the normal of a triangle without area finite [m²]
LONGEST_EDGE = 1.5  # of the part of a triangle that a sample stands for [spacings]

Corners = ti.types.ndarray(dtype=ti.math.ivec3, ndim=1)


@dataclass(frozen=True, eq=False)
class ClothSamples:
    """Samples of all cloths as fixed points of their triangles."""

    sheets: SheetSamples  # what the fluid takes
    nodes: NDArray[np.int32]  # corners of the triangle of each sample, numbered as the cloth solver does, (m, 3)
    weights: NDArray[np.float64]  # its barycentric coordinates there, at least 0, of sum 1, (m, 3)
    start: NDArray[np.float64]  # where the samples are at the start [m], (m, 3)
    normals: NDArray[np.float64]  # of their triangles then, of length 1, (m, 3)

    @classmethod
    def of(cls, cloth: ClothSolver, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS) -> "ClothSamples":
        """One sample for each triangle, or several where it is large against the spacing [m].

        Raises:
            ShapeError: a mesh file is missing or unreadable, or its mesh is no sheet.
        """
        margin = kept_away(support_in_spacings) * spacing
        rest, mass, missing, nodes, weights = [], [], [], [], []
        felt_per_area = volume_per_area(support_in_spacings) * spacing
        for each, first in zip(cloth.parameters, cloth.state.host.first_node[:-1], strict=True):
            sheet = build_sheet(each.shape)
            triangle, places = _points_of(sheet, spacing)
            share = 1.0 / np.bincount(triangle)[triangle]
            area = share * triangle_areas(sheet.vertices, sheet.triangles)[triangle]
            points = np.einsum("mc,mcx->mx", places, sheet.vertices[sheet.triangles[triangle]])
            rest.append(BoundarySamples.of_points(points, known=felt_per_area * area))
            mass.append(area * each.mass_per_area)
            missing.append(area * (2.0 * margin - each.thickness))
            nodes.append(sheet.triangles[triangle] + first)
            weights.append(places)
        sheets = SheetSamples(BoundarySamples.of_bodies(*rest), *map(np.concatenate, (mass, missing)))
        all_nodes, all_weights = np.concatenate(nodes).astype(np.int32), np.concatenate(weights)
        corners = cloth.state.host.position[all_nodes].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(sheets, all_nodes, all_weights, np.einsum("mc,mcx->mx", all_weights, corners), normals)


def _points_of(sheet: RestSheet, spacing: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Centres of equal parts of all triangles, small enough: triangle of each, (m,), and barycentric coordinates."""
    corners = sheet.vertices[sheet.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / (LONGEST_EDGE * spacing)), 1).astype(int)
    triangles, weights = [], []
    for count in np.unique(divisions).tolist():
        own = np.flatnonzero(divisions == count)
        parts = _parts(count)
        triangles.append(np.repeat(own, len(parts)))
        weights.append(np.tile(parts, (len(own), 1)))
    return np.concatenate(triangles), np.concatenate(weights)


def _parts(count: int) -> NDArray[np.float64]:
    """Barycentric coordinates of the centres of count² equal parts of a triangle, (count², 3)."""
    i, j = (each.ravel() for each in np.mgrid[0:count, 0:count])
    upright = np.stack([i, j], axis=1)[i + j < count] + 1.0 / 3.0
    inverted = np.stack([i, j], axis=1)[i + j < count - 1] + 2.0 / 3.0
    two = np.concatenate([upright, inverted]) / count
    return np.concatenate([two, 1.0 - two.sum(axis=1, keepdims=True)], axis=1)


@bundle
class SampleNodes(NamedTuple):
    """Samples as fixed points of triangles, (m,) each."""

    nodes: Corners  # corners of the triangle of each
    weights: Vectors  # its barycentric coordinates there


@bundle
class Nodes(NamedTuple):
    """Nodes of the cloths, (n,) each."""

    position: Vectors  # [m], without the carry
    carry: Vectors  # rounded off from the position [m]
    velocity: Vectors  # [m/s]


@bundle
class Entries(NamedTuple):
    """Samples that each node is a corner of: `sample_corner[start[n] : start[n + 1]]`."""

    start: Integers  # (n + 1,)
    sample_corner: Integers  # 3 b + c for corner c of sample b


@bundle
class Felt(NamedTuple):
    """What samples felt in the fluid's step, (m,) each."""

    mass: Floats  # of the fluid that touched [kg]
    impulse: Vectors  # of the fluid [N s]
    push: Vectors  # u_b - v_b [m/s]


class ClothFluidCoupling(Coupling):
    """The fluid pushes the cloths and is held by them, and moves along where it touches.

    A coupled step (`sim.fluid.sheets` says why): the fluid steps, its samples of the cloths answering as if they
    had the mass of the fluid that touches them; nodes take the impulses, and in their own step have the mass of the
    touching fluid m_b as well, of velocity u_b where their own is v_b = sum_n beta_bn v_n,

        (m_n + m_a,n) v_n += J_n + sum_b beta_bn m_b (u_b - v_b),   m_a,n = sum_b beta_bn m_b,

    with the barycentric coordinates beta of the samples; the touching fluid gets the difference between what became of
    the samples and u_b. With sum_n beta_bn = 1 linear momentum of fluid and free cloth is kept to rounding. Angular
    momentum is not quite: masses are lumped into nodes, and fluid takes part at some distance from the samples.

    """

    def __init__(self, fluid: SPHFluid, cloth: ClothSolver, samples: ClothSamples) -> None:
        """Couple the two; places the samples of the cloths, which the fluid was made with, where these are."""
        sheets = fluid.body_forces.sheets
        assert sheets is not None
        self.bodies = (fluid.name, cloth.name)
        self._fluid, self._cloth, self._sheets = fluid, cloth, sheets
        count, node_count = len(samples.nodes), cloth.state.vertex_count
        self._samples = SampleNodes(on_device(samples.nodes), on_device(samples.weights))
        d = fluid.discretization
        self._depth = sheet_depth(d.support_in_spacings) * d.spacing
        order = np.argsort(samples.nodes.ravel(), kind="stable")
        start = np.searchsorted(samples.nodes.ravel()[order], np.arange(node_count + 1))
        self._entries = Entries(on_device(start), on_device(order))
        self._change = ti.Vector.ndarray(3, ti.f32, count)
        self._reduction = LaneReduction(maxima=MAXIMA, sums=0)
        self._load = NodeLoad(node_count)
        cloth.loads.append(self._load)
        self.follow(0.0)

    def impulse(self) -> NDArray[np.float64]:
        """Of the fluid on all cloths in the last step, once `follow` was called [N s], (3,)."""
        pushed = self._sheets.impulse.to_numpy().sum(axis=0, dtype=np.float64)
        mass, change = (array.to_numpy().astype(np.float64) for array in (self._sheets.mass, self._change))
        total: NDArray[np.float64] = pushed - mass @ change
        return total

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Lay the fluid's impulses of its substep, and the fluid that touches, onto the nodes."""
        felt = Felt(self._sheets.mass, self._sheets.impulse, self._sheets.push)
        gather_loads(self._entries, self._samples.weights, felt, self._load.mass, self._load.impulse)

    def follow(self, dt: float) -> None:
        """Let the touching fluid move along, and put the samples where the cloths are; dt [s] is 0 at the start."""
        state, boundary = self._cloth.state, self._fluid.boundary
        nodes = Nodes(state.position, state.carry, state.velocity)
        share = self._reduction.over(boundary.sheet_count)
        results = measure_sheets(self._samples, nodes, boundary.samples, boundary.sheets, self._change, share)
        change, distance, speed = (math.sqrt(value) for value in self._reduction.unpack(results)[:MAXIMA].tolist())
        if dt > 0.0:
            self._fluid.tank.take_sheet_motion(self._change, change, dt)
        place_sheets(self._samples, nodes, boundary.samples, boundary.sheets, self._depth)
        self._fluid.tank.sheets_moved(distance, speed, elapsed_s=dt)


@func
def mixed(samples: SampleNodes, s: ti.i32, of_nodes: Vectors) -> ti.math.vec3:
    """Value at a sample of what nodes have."""
    n, beta = samples.nodes[s], samples.weights[s]
    return beta[0] * of_nodes[n[0]] + beta[1] * of_nodes[n[1]] + beta[2] * of_nodes[n[2]]


@kernel
def gather_loads(entries: Entries, weights: Vectors, felt: Felt, mass: Floats, impulse: Vectors):
    """m_a,n = sum_b beta_bn m_b, and sum_b beta_bn (J_b + m_b (u_b - v_b))."""
    for n in range(mass.shape[0]):
        total_mass = 0.0
        total = ti.math.vec3(0.0)
        for k in range(entries.start[n], entries.start[n + 1]):
            b = entries.sample_corner[k] // 3
            beta = weights[b][entries.sample_corner[k] % 3]
            total_mass += beta * felt.mass[b]
            total += beta * (felt.impulse[b] + felt.mass[b] * felt.push[b])
        mass[n] = total_mass
        impulse[n] = total


@kernel
def measure_sheets(
    sample_nodes: SampleNodes, nodes: Nodes, samples: Samples, sheets: Sheets, change: Vectors, share: Share
) -> Results:
    """Change of each sample's velocity; the largest squares of that, of its displacement, and of its speed."""
    for lane in range(share.tree.lanes):
        largest = ti.math.vec3(0.0)
        for k in range(share.items):
            s = lane * share.lane_step + k * share.item_step
            if s < sheets.count:
                v_b = mixed(sample_nodes, s, nodes.velocity)
                x_b = mixed(sample_nodes, s, nodes.position) + mixed(sample_nodes, s, nodes.carry)
                dv_b = v_b - samples.velocity[sheets.first + s]
                change[s] = dv_b
                moved = (x_b - samples.position[sheets.first + s]).norm_sqr()
                largest = ti.max(largest, ti.math.vec3(dv_b.norm_sqr(), moved, v_b.norm_sqr()))
        for q in ti.static(range(3)):
            share.tree.partial[q * share.tree.lanes + lane] = largest[q]
    return reduced_tree(share.tree)


@kernel
def place_sheets(sample_nodes: SampleNodes, nodes: Nodes, samples: Samples, sheets: Sheets, depth: ti.f32):
    """Samples where their nodes are, as fast as these, felt at a depth behind their triangles."""
    for s in range(sheets.count):
        x_b = mixed(sample_nodes, s, nodes.position) + mixed(sample_nodes, s, nodes.carry)
        samples.position[sheets.first + s] = x_b
        samples.velocity[sheets.first + s] = mixed(sample_nodes, s, nodes.velocity)
        n = sample_nodes.nodes[s]
        first = nodes.position[n[0]]
        normal = (nodes.position[n[1]] - first).cross(nodes.position[n[2]] - first)
        samples.behind[sheets.first + s] = depth * normal.normalized(TINY_AREA)
