"""Whether bodies can start where the job puts them: dynamic ones overlap neither others nor walls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.rigid.broad_phase import overlapping_pairs
from sim.rigid.collision import CollisionDetector
from sim.rigid.solver import RigidSolver

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
    pairs = solver.touching(*overlapping_pairs(*CollisionDetector(geometries, ()).boxes(poses), is_dynamic))
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
        smaller = min(solver.all_geometries[number].shortest_edge for number in (first, second))
        if depth > START_OVERLAP * smaller:
            names = solver.all_names[first], solver.all_names[second]
            sentence = (
                f'rigid bodies "{names[0]}" and "{names[1]}" start {depth:.3g} m deep in each other; move them apart '
                f"by that much: they are deepest at ({', '.join(f'{value:.3g}' for value in place)}) m"
            )
            problems.append(StartProblem(names[0], sentence))
    return problems


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
