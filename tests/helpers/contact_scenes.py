"""Cloths, bodies and walls that touch, for the tests of contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from cloth_scenes import EARTH, FRAMES_PER_SECOND, VACUUM, cloth
from numpy.typing import NDArray

from sim.build import build_world
from sim.cloth.contacts import ContactList
from sim.cloth.continuous_contacts import ContinuousContacts
from sim.cloth.self_collision import SelfCollision
from sim.cloth.solver import ClothSolver
from sim.cloth.state import finish_step
from sim.core.world import World
from sim.rigid.solver import RigidSolver
from sim.scene import SceneParameters

EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")
ROOM = {"min": (-1.0, -1.0, 0.0), "max": (1.0, 1.0, 2.0)}
SPACE = {**ROOM, "min": (-1.0, -1.0, -1.0), "open_faces": EVERY_FACE}


def world_of(
    *cloths: dict[str, Any],
    bodies: Sequence[dict[str, Any]] = (),
    domain: dict[str, Any] = ROOM,
    gravity: tuple[float, float, float] = EARTH,
) -> World:
    """Cloths in a vacuum, named "cloth0" and so on, and bodies, named "body0" and so on."""
    scene = SceneParameters.model_validate(
        {
            "gravity": gravity,
            "domain": domain,
            "cloth": [cloth(f"cloth{k}", **{**VACUUM, **each}) for k, each in enumerate(cloths)],
            "rigid": [{"name": f"body{k}", **each} for k, each in enumerate(bodies)],
        }
    )
    return build_world(scene, frames_per_second=FRAMES_PER_SECOND)


def cloth_of(world: World) -> ClothSolver:
    solver = world.solvers["cloth"]
    assert isinstance(solver, ClothSolver)
    return solver


def rigid_of(world: World) -> RigidSolver:
    solver = world.solvers["rigid"]
    assert isinstance(solver, RigidSolver)
    return solver


def find(pairs: SelfCollision) -> ContactList:
    """List pairs, and find contacts of cloth with cloth, as a substep does."""
    contacts = ContactList(10**5)
    while True:
        contacts.found.counter.fill(0)
        pairs.find(contacts, 0.1)
        if not pairs.listed.reach_to(int(contacts.found.counter.to_numpy()[1])):
            return contacts


def contacts_of(solver: ClothSolver) -> ContinuousContacts:
    assert solver.contacts is not None
    return solver.contacts


def displace(solver: ClothSolver, displacement: NDArray[np.floating], dt: float = 1.0e-3) -> NDArray[np.float64]:
    """One substep that leads every node this far if contacts allow it [m]; the displacements that they allowed."""
    state = solver.state
    state.displacement.from_numpy(displacement.astype(np.float32))
    if solver.contacts is not None:
        solver.contacts.resolve(dt)
    allowed = state.displacement.to_numpy().astype(np.float64)
    finish_step(state.nodes, state.position, state.limit, dt, solver._no_reasons)
    return allowed


def momenta(world: World) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Linear [kg m/s] and angular momentum about the origin [kg m²/s] of the cloths and bodies that move, (3,) each."""
    solver = cloth_of(world)
    mass = solver.state.mass.to_numpy().astype(np.float64)[:, None]
    momentum = mass * solver.state.velocity.to_numpy().astype(np.float64)
    linear = momentum.sum(axis=0)
    angular = np.cross(solver.state.positions(), momentum).sum(axis=0)
    bodies = rigid_of(world).bodies
    of_bodies = bodies.mass[:, None] * bodies.velocity
    spin = bodies.angular_momentum()
    return linear + of_bodies.sum(axis=0), angular + (np.cross(bodies.position, of_bodies) + spin).sum(axis=0)


def distances_to_body(world: World, number: int) -> NDArray[np.float64]:
    """Exact distances of all nodes to a body's surface [m], negative inside."""
    rigid = rigid_of(world)
    poses = rigid.poses()
    relative = (cloth_of(world).state.positions() - poses.position[number]) @ poses.rotation[number]
    return rigid.all_geometries[number].signed_distance(relative)


def point_segment_distances(x: NDArray, p: NDArray, q: NDArray) -> NDArray[np.float64]:
    """Distances of points to segments p q [m], all (..., 3)."""
    along = q - p
    share = np.clip(np.einsum("...i,...i", x - p, along) / np.einsum("...i,...i", along, along), 0.0, 1.0)
    return np.linalg.norm(x - p - share[..., None] * along, axis=-1)


def segment_distances(p: NDArray, q: NDArray, a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Distances of segments p q and a b [m]: of their ends, and of their lines where these are nearest inside."""
    ends = [point_segment_distances(x, a, b) for x in (p, q)] + [point_segment_distances(x, p, q) for x in (a, b)]
    normal = np.cross(q - p, b - a)
    squared = np.einsum("...i,...i", normal, normal)
    s = np.einsum("...i,...i", np.cross(a - p, b - a), normal) / squared
    t = np.einsum("...i,...i", np.cross(a - p, q - p), normal) / squared
    lines = np.abs(np.einsum("...i,...i", a - p, normal)) / np.sqrt(squared)
    inside = (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    return np.min([*ends, np.where(inside, lines, np.inf)], axis=0)


def point_triangle_distances(x: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float64]:
    """Distances of points to triangles [m]: to their edges, and to their planes where the foot is inside."""
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    sides = [np.einsum("...i,...i", np.cross(q - p, x - p), normal) for p, q in ((a, b), (b, c), (c, a))]
    inside = np.min(sides, axis=0) > 0.0
    height = np.abs(np.einsum("...i,...i", x - a, normal))
    edges = [point_segment_distances(x, p, q) for p, q in ((a, b), (b, c), (c, a))]
    return np.min([*edges, np.where(inside, height, np.inf)], axis=0)


def listed_places(pairs: SelfCollision, are_edges: bool) -> NDArray[np.int64]:
    """Places of the list where a pair of edges, or of a vertex and a triangle, is, in the order of pairs of patches."""
    pieces = pairs.listed.on_device.pieces.to_numpy()[: 2 * pairs.met.count]
    first, _, found, _ = pieces[int(are_edges) :: 2].T
    return np.concatenate([np.arange(a, a + n) for a, n in zip(first, found, strict=True)])


def listed_pairs(pairs: SelfCollision) -> list[list[tuple[int, ...]]]:
    """The listed pairs of elements, vertices with triangles first, in an order of their own."""
    elements = pairs.listed.on_device.pairs.to_numpy()
    return [sorted(map(tuple, elements[listed_places(pairs, each)].tolist())) for each in (False, True)]
