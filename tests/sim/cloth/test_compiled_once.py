"""Kernels are compiled in the first frame: no later one stands still for seconds."""

import pytest
from fresh_python import run_python

DROP = """
from benchmarks.cloth import FRAMES_PER_SECOND, scene
from sim.build import build_world
from sim.core import launch
from sim.core.runtime import initialize
from sim.scene import SceneParameters

initialize("cpu")
compiled, frame = [], 0
first_call = launch.FastKernel._first_call

def noted(kernel, program, args):
    compiled.append((frame, kernel.__name__))
    return first_call(kernel, program, args)

launch.FastKernel._first_call = noted
parameters = scene(25, substeps=10, self_collision=True, mass_per_area=0.3).model_dump(exclude_unset=True)
parameters["cloth"][0]["pin"] = PINS
world = build_world(SceneParameters.model_validate(parameters), frames_per_second=FRAMES_PER_SECOND)
contacts = 0.0
for frame in range(40):
    report = world.advance_frame()
    contacts = max(contacts, report.diagnostics["cloth"]["contacts"])
assert contacts > 0.0
assert ("begin_push" in {name for _, name in compiled})
print([each for each in compiled if each[0] > 0])
"""


@pytest.mark.parametrize("pins", [(), ({"edge": "x-", "release_s": 0.05},)], ids=["free", "let go"])
def test_a_sheet_that_falls_on_a_ball_compiles_nothing_after_its_first_frame(pins):
    assert run_python(DROP.replace("PINS", repr(pins))).strip().splitlines()[-1] == "[]"
