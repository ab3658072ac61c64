"""Whether bodies can start where the job puts them: dynamic ones overlap neither others nor walls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.paths import Poses
from sim.rigid.broad_phase import overlapping_on_host
from sim.rigid.collision import CollisionDetector
from sim.rigid.solver import RigidSolver
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere

CONVEX = (Box, Sphere, Cylinder, Capsule, Cone)
"""Shapes of which two overlap as deep as one must go to be out of the other."""
START_OVERLAP = 0.01  # allowed, in shortest edges of the smaller body: positions in a job file are rounded


class StartProblem(NamedTuple):
    """Why a body cannot start where it is, by how much, and what to do."""

    body: str
    sentence: str


def check_start(solver: RigidSolver) -> None:
    """Raises ValueError, which tells of every dynamic body that starts in another one or behind a wall."""
    if problems := start_problems(solver):
        raise ValueError("; ".join(problem.sentence for problem in problems))


def start_problems(solver: RigidSolver) -> list[StartProblem]:
    """Dynamic bodies that start in other bodies or behind walls; of a pair, one that moves."""
    return [*_overlaps(solver), *_behind_walls(solver)]


def _overlaps(solver: RigidSolver) -> list[StartProblem]:
    """Pairs of bodies of which one is dynamic, with the exact distance of the balls found to overlap."""
    poses, geometries = solver.poses(), solver.all_geometries
    is_dynamic = np.append(solver.bodies.is_dynamic, np.zeros(len(geometries) - len(solver.bodies), dtype=bool))
    pairs = solver.touching(*overlapping_on_host(*CollisionDetector(geometries, (), 0).boxes(poses), is_dynamic))
    deepest: dict[tuple[int, int], tuple[float, NDArray[np.float64]]] = {}
    for first, second in zip(*(numbers.tolist() for numbers in pairs), strict=True):
        for owner, other in ((first, second), (second, first)):
            balls = geometries[owner].balls
            centres = poses.position[owner] + balls.centres.T @ poses.rotation[owner].T
            in_other = (centres - poses.position[other]) @ poses.rotation[other]
            low, high = geometries[other].bounds
            near = np.all((in_other > low - balls.radii[:, None]) & (in_other < high + balls.radii[:, None]), axis=1)
            if not near.any():
                continue
            depths = balls.radii[near] - geometries[other].signed_distance(in_other[near])
            most = int(np.argmax(depths))
            if (first, second) not in deepest or depths[most] > deepest[first, second][0]:
                deepest[first, second] = float(depths[most]), centres[near][most]
    problems = []
    for (first, second), (depth, place) in deepest.items():
        pair = geometries[first], geometries[second]
        if depth <= START_OVERLAP * min(geometry.shortest_edge for geometry in pair):
            continue
        # The first of a pair moves, as those that move come first.
        mover, stays = (second, first) if is_dynamic[second] else (first, second)
        way, direction = _way_out(poses, geometries, mover, stays)
        is_convex = all(isinstance(geometry.solid.shape, CONVEX) for geometry in pair)
        names = solver.all_names[first], solver.all_names[second]
        sentence = (
            f'rigid bodies "{names[0]}" and "{names[1]}" start {way if is_convex else depth:.3g} m deep in each other, '
            f'around {_triple(place)} m; move "{solver.all_names[mover]}" by {_rounded_up(way * direction)} m'
        )
        problems.append(StartProblem(solver.all_names[mover], sentence))
    return problems


def _way_out(
    poses: Poses, geometries: Sequence[BodyGeometry], mover: int, stays: int
) -> tuple[float, NDArray[np.float64]]:
    """How far one body has to go to be out of another's convex hull [m], and where to, (3,): the best of some ways."""
    ways = np.concatenate([np.eye(3), poses.rotation[mover].T, poses.rotation[stays].T])
    between = poses.position[mover] - poses.position[stays]
    if (distance := float(np.linalg.norm(between))) > 0.0:
        ways = np.concatenate([ways, between[None] / distance])
    ways = np.concatenate([ways, -ways])
    far = _reach(poses, geometries, stays, ways) + _reach(poses, geometries, mover, -ways)
    best = int(np.argmin(np.round(far, 9)))
    return float(far[best]), ways[best]


def _reach(
    poses: Poses, geometries: Sequence[BodyGeometry], number: int, ways: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far a body reaches along unit vectors (k, 3) [m], (k,)."""
    geometry, in_body = geometries[number], ways @ poses.rotation[number]
    solid = geometry.solid
    own = solid.scale * solid.shape.support(in_body) - in_body @ geometry.centre_of_mass
    result: NDArray[np.float64] = ways @ poses.position[number] + own
    return result


def _triple(values: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{value + 0.0:.3g}' for value in values)})"


def _rounded_up(way: NDArray[np.float64]) -> str:
    """A way [m] with three digits of its length, none shorter than it is."""
    digit = 10.0 ** (np.floor(np.log10(np.abs(way).max())) - 2)
    away = np.where(np.abs(way) < 0.01 * digit, 0.0, np.sign(way) * np.ceil(np.abs(way) / digit - 1e-6) * digit)
    return _triple(away)


def _behind_walls(solver: RigidSolver) -> list[StartProblem]:
    poses = solver.poses()
    problems = []
    for number in np.flatnonzero(solver.bodies.is_dynamic):
        geometry = solver.all_geometries[number]
        centres = poses.position[number][:, None] + poses.rotation[number] @ geometry.balls.centres
        for wall in solver.walls:
            height = wall.side * (centres[wall.axis] - wall.offset) - geometry.balls.radii
            depth = -float(np.min(height, initial=0.0, where=wall.is_beside(centres)))
            if depth > START_OVERLAP * geometry.shortest_edge:
                name = solver.all_names[number]
                sentence = (
                    f'rigid body "{name}" starts {depth:.3g} m behind the wall {wall.name} of the domain; '
                    "move it inward by that much, or add the face to domain.open_faces"
                )
                problems.append(StartProblem(name, sentence))
    return problems
