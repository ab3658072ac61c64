"""Smoke beside water, cloth and a body that moves, all in one scene and coupled because they are there."""

import pytest
from thread_counts import outputs_by_threads

SCENE_OF_ALL = """
# 1 thread runs all frames and leaves a checkpoint, from which 2 threads go on.
import hashlib, sys
import numpy as np
from sim.core.runtime import initialize
initialize("cpu", threads=int(sys.argv[1]))
from sim.build import build_world
from sim.scene import SceneParameters
block = {"shape": {"type": "box", "size": (0.3, 0.6, 0.3)}, "position": (-0.15, 0.0, 0.15)}
ball = {"name": "ball", "kind": "dynamic", "density": 500.0, "shape": {"type": "sphere", "radius": 0.06}}
flag = {"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (9, 9)}, "material": "silk"}
source = {"shape": {"type": "sphere", "radius": 0.06}, "position": (0.05, 0.19, 0.35), "velocity": (2.0, 0.0, 0.0)}
scene = SceneParameters.model_validate({
    "domain": {"min": (-0.3, -0.3, 0.0), "max": (0.3, 0.3, 0.6)},
    "fluid": [{"name": "water", "particle_radius": 0.015, "block": [block]}],
    "rigid": [{**ball, "position": (0.15, 0.0, 0.3)}],
    "cloth": [{**flag, "position": (0.15, 0.19, 0.4), "rotation_deg": (0.0, 90.0, 0.0), "pin": [{"edge": "x-"}]}],
    "smoke": [{"name": "plume", "cell_size": 0.04, "source": [source]}],
})
world = build_world(scene, frames_per_second=60)
checkpoint = sys.argv[2]
if sys.argv[1] == "2":
    with np.load(checkpoint) as arrays:
        world.restore(3, dict(arrays))
while world.frame < 5:
    report = world.advance_frame()
    if sys.argv[1] == "1" and world.frame == 3:
        np.savez(checkpoint, **world.checkpoint())
digest = hashlib.sha256()
for _, array in sorted(world.checkpoint().items()):
    digest.update(np.ascontiguousarray(array).tobytes())
obstacles = world.checkpoint()["plume/obstacles"].sum()
swing = np.ptp(world.snapshots()["flag"].arrays["position"][:, 0])
print(digest.hexdigest(), obstacles, swing, report.substeps["plume"], report.substeps["water"])
"""


@pytest.mark.slow
def test_all_that_moves_in_smoke_gives_the_same_bits_when_it_is_killed_and_resumed_on_more_threads(tmp_path):
    outputs = outputs_by_threads(SCENE_OF_ALL, str(tmp_path / "checkpoint.npz"), beside=__file__)
    _, obstacles, swing, smoke_steps, water_steps = outputs[0].split()
    assert outputs[0] == outputs[1]
    # The water alone has 0.3 x 0.6 x 0.3 m / (0.04 m)³ = 844 cells; the ball, 0.9 dm³, has 14.
    assert 700 < int(obstacles) < 950
    # The flag hung across x; the jet of smoke has moved it.
    assert float(swing) > 1.0e-3
    # Smoke takes steps of its own, with many of the others in each.
    assert 5 * int(smoke_steps) < int(water_steps)
