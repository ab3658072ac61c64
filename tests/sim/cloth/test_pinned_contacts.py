"""Contacts of cloth that pins hold in part: what is free moves as far as contacts ask, not as far as levers make it."""

import numpy as np
import pytest
from contact_scenes import SPACE, cloth_of, displace, world_of

pytestmark = pytest.mark.usefixtures("taichi_cpu")

THICKNESS = 0.01
GAP = 0.4 * THICKNESS


def triangle(folder, name, corners, pinned):
    """A cloth of one triangle, where its corners are [m]."""
    (folder / f"{name}.obj").write_text("".join("v {} {} {}\n".format(*corner) for corner in corners) + "f 1 2 3\n")
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return {
        "shape": {"type": "mesh", "file": str(folder / f"{name}.obj")},
        "position": tuple(0.5 * (low + high)),
        "thickness": THICKNESS,
        "pin": ({"index": pinned},),
    }


def free_corner_after_a_substep(folder, height: float) -> float:
    """How far the corner of a triangle of 1 m height, the other two being pinned, is pushed [m].

    The tip of a pinned triangle stands so high above their line, `GAP` over the sheet.
    """
    held = triangle(folder, "held", [(-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 1.0, 0.0)], (0, 1))
    tip = triangle(
        folder, "tip", [(0.0, height, GAP), (-0.05, height - 0.1, 0.3), (0.05, height - 0.1, 0.3)], (0, 1, 2)
    )
    world = world_of(held, tip, domain=SPACE, gravity=(0.0, 0.0, 0.0))
    solver = cloth_of(world)
    return float(np.linalg.norm(displace(solver, np.zeros((6, 3))), axis=1).max())


def test_a_free_corner_is_pushed_by_its_lever(tmp_path):
    """Half-way up the triangle, what the tip lacks is had by twice the motion of the corner."""
    # Layers go apart with a time constant of 10 ms, so in 1 ms 1/10 of 6 mm (exactly 1 - exp(-0.1), to first order);
    # the iteration comes within 5 % of that.
    assert free_corner_after_a_substep(tmp_path, 0.5) == pytest.approx(2.0 * 0.1 * (THICKNESS - GAP), rel=0.1)


def test_a_corner_with_a_tiny_share_in_a_contact_does_not_fly_off(tmp_path):
    """To lift the sheet under the tip, the corner would have to move 10,000 times as far."""
    assert free_corner_after_a_substep(tmp_path, 1.0e-4) <= THICKNESS
