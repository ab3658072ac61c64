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
KEYS
world = build_world(SceneParameters.model_validate(parameters), frames_per_second=FRAMES_PER_SECOND)
contacts = 0.0
for frame in range(FRAMES):
    report = world.advance_frame()
    contacts = max(contacts, report.diagnostics["cloth"]["contacts"])
assert contacts > 0.0
assert ("push" in {name for _, name in compiled})
print([each for each in compiled if each[0] > 0])
"""


@pytest.mark.parametrize("pins", [(), ({"edge": "x-", "release_s": 0.05},)], ids=["free", "let go"])
def test_a_sheet_that_falls_on_a_ball_compiles_nothing_after_its_first_frame(pins):
    assert compiled_late(f'parameters["cloth"][0]["pin"] = {pins!r}', 40) == "[]"


def test_a_heap_that_gets_many_contacts_compiles_nothing():
    """Of two sheets, one lies on the other at last."""
    keys = """
parameters["cloth"] = [
    {"name": f"sheet{k}", "shape": {"type": "rectangle", "size": (0.3, 0.3), "counts": (12, 12)},
     "position": (0.0, 0.0, 1e-3 + 0.02 * k), "rotation_deg": (0.0, 0.0, 7.0 * k), "air_density": 0.0} for k in range(2)
]
parameters["rigid"] = ()
parameters["domain"] = {}
"""
    assert compiled_late(keys, 10) == "[]"


def compiled_late(keys: str, frames: int) -> str:
    """Kernels that are compiled after the first frame, with their frames."""
    script = DROP.replace("KEYS", keys).replace("FRAMES)", f"{frames})")
    return run_python(script).strip().splitlines()[-1]
