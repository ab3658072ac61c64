"""Checks of pins: times, speeds and loads."""

import math

import numpy as np

from pipeline.kinds.checks.cloth_start import ClothStart
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import ClothParameters, substeps_of
from sim.cloth.start import path_of_pin

SOFTEST, FIRM = 1.0, 0.5
"""How far a sheet falls in a substep, times the nodes that each pinned one holds, over the spacing of nodes: springs at
the pin are some fifth too long at 1, many times at 7, and look right at a half."""


def check_pin_times(path: KeyPath, cloth: ClothParameters, film_s: float, findings: Findings) -> None:
    """Warn of pins whose path or release the film does not reach."""
    for number, pin in enumerate(cloth.pin):
        place: KeyPath = (*path, "pin", number)
        if pin.release_s is not None and pin.release_s >= film_s:
            findings.warn(
                (*place, "release_s"),
                f"lets go at {pin.release_s:g} s, after the film's end at {film_s:g} s, so it holds all through; "
                "make it earlier, or remove it",
            )
        if pin.keyframe and pin.keyframe[0].time_s >= film_s:
            findings.warn(
                (*place, "keyframe"),
                f"starts to move at {pin.keyframe[0].time_s:g} s, after the film's end at {film_s:g} s; "
                "make its times earlier",
            )
        if pin.keyframe and not any(any((*each.offset, *each.rotation_deg)) for each in pin.keyframe):
            findings.warn(
                (*place, "keyframe"), "never moves: all keyframes are where it starts; give one offset, or remove it"
            )


def check_pin_speeds(start: ClothStart, job: Job, findings: Findings) -> None:
    """Warn of a pin that pulls its nodes further in a substep than the next node is away.

    Explicit springs whose substeps are omitted take as many as their stiffness asks for, which are not known here.
    """
    cloth = start.cloth
    if cloth.integrator == "explicit" and cloth.substeps is None:
        return
    for number, nodes in start.pinned.items():
        pin, position = cloth.pin[number], start.position[nodes]
        if not pin.keyframe:
            continue
        reach = float(np.linalg.norm(position - position.mean(axis=0), axis=1).max())
        speed = path_of_pin(pin).largest_speed(reach)
        moved = speed / (job.fps * substeps_of(job.cloth))
        if moved > start.longest_edge:
            findings.warn(
                (*start.path, "pin", number, "keyframe"),
                f"moves at up to {speed:.3g} m/s, {moved:.3g} m in a substep, further than the "
                f"{start.longest_edge:.3g} m between neighbouring nodes: the cloth is torn along; give it more time, "
                "or the cloth more substeps",
            )


def check_pin_load(start: ClothStart, job: Job, fluid_mass: float, findings: Findings) -> None:
    """Warn of pins that hold so many nodes each that compliant springs have no time to pass the weight on.

    Dry nodes at the pins are as light as without the fluid [kg] that falls onto the cloth, and have more to pass on.
    """
    cloth, nodes, pinned = start.cloth, len(start.position), int(start.held_for_ever.sum())
    if cloth.integrator != "xpbd" or not pinned:
        return
    fluid_share = fluid_mass / (float(start.sheet.node_area.sum()) * cloth.mass_per_area)
    substeps = substeps_of(job.cloth)
    fall = math.hypot(*job.gravity) / (job.fps * substeps) ** 2
    softness = (1.0 + fluid_share) * nodes / pinned * fall / (cloth.iterations or 1) / start.shortest_edge
    if softness > SOFTEST:
        load = f" and fluid of {fluid_share:.2g} times their mass" if fluid_share else ""
        enough = math.ceil(substeps * math.sqrt(softness / FIRM))
        findings.warn(
            (*start.path, "pin"),
            f"{pinned} pinned nodes hold {nodes}{load}, and {substeps} substeps a frame are too few to pass on their "
            f"weight: springs at the pins get much too long; pin regions of more nodes, as eyelets do, or give more "
            f"iterations, or substeps = {enough}",
        )
