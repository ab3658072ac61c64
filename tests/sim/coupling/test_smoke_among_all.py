"""Smoke in a closed box beside water, cloth and bodies that move, coupled because they are there."""

from typing import Any

import numpy as np
import pytest
from thread_counts import digest_of, result_on_threads

from sim.build import build_world
from sim.scene import SceneParameters


def run_scene_of_all(checkpoint: str, resume: bool) -> dict[str, Any]:
    """Run five frames, and leave a checkpoint after the third, or go on from there."""
    block = {"shape": {"type": "box", "size": (0.3, 0.6, 0.3)}, "position": (-0.15, 0.0, 0.15)}
    ball = {"name": "ball", "kind": "dynamic", "density": 500.0, "shape": {"type": "sphere", "radius": 0.06}}
    ball |= {"position": (0.15, 0.0, 0.3), "angular_velocity": (3.0, 1.0, 0.0)}
    piston = {"name": "piston", "kind": "kinematic", "shape": {"type": "box", "size": (0.7, 0.7, 0.2)}}
    piston |= {"position": (0.0, 0.0, 0.66), "velocity": (0.0, 0.0, -0.6)}
    flag = {"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (9, 9)}, "material": "silk"}
    flag |= {"position": (0.15, 0.19, 0.4), "rotation_deg": (0.0, 90.0, 0.0), "pin": [{"edge": "x-"}]}
    source = {"shape": {"type": "sphere", "radius": 0.06}, "position": (0.05, 0.19, 0.35), "velocity": (2.0, 0.0, 0.0)}
    scene = {
        "domain": {"min": (-0.3, -0.3, 0.0), "max": (0.3, 0.3, 0.6)},
        "fluid": [{"name": "water", "particle_radius": 0.015, "block": [block]}],
        "rigid": [ball, piston],
        "cloth": [flag],
        "smoke": [{"name": "plume", "cell_size": 0.04, "source": [source], "open_faces": ()}],
    }
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=60)
    if resume:
        with np.load(checkpoint) as arrays:
            world.restore(3, dict(arrays))
    while world.frame < 5:
        report = world.advance_frame()
        if not resume and world.frame == 3:
            np.savez(checkpoint, **world.checkpoint())
    state = world.checkpoint()
    return {
        "digest": digest_of(state),
        "obstacles": int((state["plume/obstacles"][1:, 1:, 1:] <= 0.0).sum()),
        "swing": float(np.ptp(world.snapshots()["flag"].arrays["position"][:, 0])),
        "compression": report.diagnostics["plume"]["compression"],
        "smoke_steps": report.substeps["plume"],
        "water_steps": report.substeps["water"],
    }


@pytest.mark.slow
def test_all_that_moves_in_smoke_gives_the_same_bits_when_it_is_killed_and_resumed_on_more_threads(
    taichi_cpu, tmp_path
):
    checkpoint = str(tmp_path / "checkpoint.npz")
    whole = result_on_threads(1, run_scene_of_all, checkpoint, False)
    if taichi_cpu == "cpu":
        assert result_on_threads(2, run_scene_of_all, checkpoint, True) == whole  # as a run that was killed goes on
    # Corners in solids: of the water 8 x 15 x 8 cells, or one less along an edge, and a corner more along each; the
    # ball, 0.9 dm³, has 14; the piston, from 0.51 m upwards, two or three layers of 16² corners.
    assert 8 * 15 * 8 + 2 * 256 < whole["obstacles"] < 9 * 16 * 9 + 20 + 3 * 256
    # It presses the air together, at 0.6 m/s over half a metre or less.
    assert whole["compression"] > 1.0
    # The flag hung across x; the jet of smoke has moved it.
    assert whole["swing"] > 1.0e-3
    # Smoke takes steps of its own, with many of the others in each.
    assert 5 * whole["smoke_steps"] < whole["water_steps"]
