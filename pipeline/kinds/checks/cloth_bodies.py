"""Checks of bodies that cloth meets: size, thickness, rods to be pinned to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.cloth_start import ClothStart
from pipeline.kinds.checks.joints import joined_to
from pipeline.kinds.checks.shapes import warn_of_thin_walls
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.cloth.parameters import PinParameters
from sim.cloth.start import path_of_pin
from sim.core.motion import rotation
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes.placement import PlacedSolid

# A body whose shortest side has fewer edges of the cloth may show between its nodes, and pass with less than half.
LEAST_EDGES = 2.0
# More of a rod's length than this is most of it.
MOST = 0.5
# Distances that differ by this share are the same.
ROUND_OFF = 1.0e-6
# Times of the film at which rods and pins are looked at, beside their keyframes.
TIMES = 64


def check_bodies_for_cloth(job: Job, solids: Solids, starts: Sequence[ClothStart], findings: Findings) -> None:
    """Warn of bodies that cloth may let through.

    A rod may be thin for a sheet that is pinned along it, and stays so: the sheet hangs from it, and does not have to
    find it. Of a group the thinnest body is named.
    """
    thin: dict[str, list[tuple[float, str, ClothStart]]] = {}
    told: set[str] = set()
    for path, solid in solids.items():
        if path[0] != "rigid":
            continue
        axes = np.eye(3)
        sides = solid.scale * (solid.shape.support(axes) + solid.shape.support(-axes))
        body, thickness = job.rigid[int(path[1])], float(sides.min())
        too_coarse = []
        for start in starts:
            if body.name in joined_to(start.cloth, job):
                continue
            rod, pins = _Rod(body, solid, sides, start.longest_edge), start.cloth.pin
            if thickness < LEAST_EDGES * start.longest_edge and not any(
                rod.stays_with(pins[pin], start.position[nodes], job.film_s) for pin, nodes in start.pinned.items()
            ):
                too_coarse.append(start)
        if too_coarse:
            coarsest = max(too_coarse, key=lambda start: start.longest_edge)
            thin.setdefault(body.group, []).append((thickness, body.name, coarsest))
        warn_of_thin_walls(int(path[1]), body, solid, findings, told, who="cloth", what="cloth")
    for bodies in thin.values():
        thickness, name, coarsest = min(bodies, key=lambda each: each[0])
        others = f", and {len(bodies) - 1} more of its group are thin" if len(bodies) > 1 else ""
        findings.warn(
            (*coarsest.path, "shape"),
            f'"{name}" is {thickness:.3g} m across, less than two of the longest edges, '
            f"{coarsest.longest_edge:.3g} m each{others}: it may show or pass between the nodes; divide the sheet "
            "more finely, or make the body larger",
        )


@dataclass(frozen=True, eq=False)
class _Rod:
    """A body beside a cloth; a rod if two of its sides [m], (3,), are thin for the longest edge of the cloth [m]."""

    body: RigidBodyParameters
    solid: PlacedSolid
    sides: NDArray[np.float64]
    longest_edge: float

    def stays_with(self, pin: PinParameters, nodes: NDArray[np.float64], film_s: float) -> bool:
        """Whether it is a rod along which a pin holds its nodes, [m], (n, 3) at the start, for as long as it holds."""
        if self.body.kind == "dynamic" or np.sort(self.sides)[1] >= LEAST_EDGES * self.longest_edge:
            return False
        of_body = path_of(self.body) if self.body.kind == "kinematic" else None
        of_pin = path_of_pin(pin) if pin.keyframe else None
        if of_body is None and of_pin is None:
            return self._is_along(nodes)
        end_s = min(film_s, np.inf if pin.release_s is None else pin.release_s)
        keyframes_s = [each.time_s for each in self.body.keyframe] + [each.time_s for each in pin.keyframe]
        centre = nodes.mean(axis=0)
        for time_s in np.minimum([*keyframes_s, *np.linspace(0.0, end_s, TIMES)], end_s).tolist():
            places = nodes
            if of_pin is not None:
                pose = of_pin.at(time_s)
                places = centre + pose.position + (nodes - centre) @ rotation.matrices(pose.orientation[None])[0].T
            if of_body is not None:
                # Where they would be if the body had stayed.
                pose = of_body.at(time_s)
                own = (places - pose.position) @ rotation.matrices(pose.orientation[None])[0]
                places = self.solid.position + own @ self.solid.rotation.T
            if not self._is_along(places):
                return False
        return True

    def _is_along(self, nodes: NDArray[np.float64]) -> bool:
        """Whether nodes (n, 3) [m] lie along most of its length without a gap, nearer to it than it is thick."""
        near = nodes[self.solid.signed_distance(nodes) < self.sides.min()]
        axis = int(self.sides.argmax())
        along = np.sort((near - self.solid.position) @ self.solid.rotation[:, axis])
        if len(along) < 2:
            return False
        has_gap = np.diff(along).max() > (1.0 + ROUND_OFF) * self.longest_edge
        return bool(not has_gap and np.ptp(along) > MOST * self.sides[axis])
