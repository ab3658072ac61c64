"""Checks of pins: times, speeds and loads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import DEFAULT_SUBSTEPS

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.cloth.parameters import ClothParameters


def check_pin_times(job: Job, findings: Findings) -> None:
    """Warn of pins whose path or release the film does not reach."""
    film_s = job.frame_count / job.fps
    for index, cloth in enumerate(job.cloth):
        for number, pin in enumerate(cloth.pin):
            path: KeyPath = ("cloth", index, "pin", number)
            if pin.release_s is not None and pin.release_s >= film_s:
                findings.warn(
                    (*path, "release_s"),
                    f"lets go at {pin.release_s:g} s, after the film's end at {film_s:g} s, so it holds all through; "
                    "make it earlier, or remove it",
                )
            if pin.keyframe and pin.keyframe[0].time_s >= film_s:
                findings.warn(
                    (*path, "keyframe"),
                    f"starts to move at {pin.keyframe[0].time_s:g} s, after the film's end at {film_s:g} s; "
                    "make its times earlier",
                )
            if pin.keyframe and not any(any((*each.offset, *each.rotation_deg)) for each in pin.keyframe):
                findings.warn(
                    (*path, "keyframe"), "never moves: all keyframes are where it starts; give one offset, or remove it"
                )


def check_pin_speed(
    path: KeyPath, cloth: ClothParameters, *, reach: float, longest_edge: float, fps: int, findings: Findings
) -> None:
    """Warn of a pin that pulls its nodes further in a substep than the next node is away.

    Explicit springs whose substeps are omitted take as many as their stiffness asks for, which are not known here.

    Args:
        path: of the pin's table.
        cloth: whose pin it is.
        reach: largest distance of the pinned nodes from their centre [m].
        longest_edge: longest distance of neighbouring nodes of the cloth [m].
        fps: frames of the film per second.
        findings: where warnings go.
    """
    from sim.cloth.pin_paths import path_of_pin

    pin = cloth.pin[int(path[-1])]
    if not pin.keyframe or (cloth.integrator == "explicit" and cloth.substeps is None):
        return
    speed = path_of_pin(pin).largest_speed(reach)
    way = speed / (fps * (cloth.substeps or DEFAULT_SUBSTEPS))
    if way > longest_edge:
        findings.warn(
            (*path, "keyframe"),
            f"moves at up to {speed:.3g} m/s, {way:.3g} m in a substep, further than the {longest_edge:.3g} m between "
            "neighbouring nodes: the cloth is torn along; give it more time, or the cloth more substeps",
        )


SOFTEST = 1.0
"""Way that a sheet falls in a substep, times the nodes that each pinned one holds, over the spacing of nodes. Springs
at the pin are some fifth too long at this: 18 % at 0.88 (64 x 64 nodes of cotton at two corners), many times at 7."""

FIRM = 0.5
"""A value of it at which they look right."""


def check_pin_load(
    path: KeyPath, cloth: ClothParameters, *, nodes: int, pinned: int, edge: float, fluid_share: float, gravity: float,
    fps: int, findings: Findings,
) -> None:  # fmt: skip
    """Warn of pins that hold so many nodes each that compliant springs have no time to pass the weight on.

    Args:
        path: of the cloth's table.
        cloth: which one.
        nodes: of the cloth.
        pinned: those of them that pins hold for ever; none say nothing, as it falls then.
        edge: shortest distance of neighbouring nodes [m].
        fluid_share: mass of the fluid that falls onto the cloth over its own: dry nodes at the pins are as light as
            without it, and have so much more to pass on.
        gravity: [m/s²].
        fps: frames of the film per second.
        findings: where warnings go.
    """
    if cloth.integrator != "xpbd" or not pinned:
        return
    substeps = cloth.substeps or DEFAULT_SUBSTEPS
    softness = (1.0 + fluid_share) * nodes / pinned * gravity / (fps * substeps) ** 2 / cloth.iterations / edge
    if softness > SOFTEST:
        load = f" and fluid of {fluid_share:.2g} times their mass" if fluid_share else ""
        enough = math.ceil(substeps * math.sqrt(softness / FIRM))
        findings.warn(
            (*path, "pin"),
            f"{pinned} pinned nodes hold {nodes}{load}, and {substeps} substeps a frame are too few to pass on their "
            f"weight: springs at the pins get much too long; pin regions of more nodes, as eyelets do, or give more "
            f"iterations, or substeps = {enough}",
        )
