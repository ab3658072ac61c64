"""What helps where a solver fails is said in keys that its bodies have."""

import re

import pytest

from sim.build import build_world
from sim.cloth.parameters import ClothParameters
from sim.fluid.parameters import FluidParameters
from sim.rigid.parameters import RigidBodyParameters
from sim.scene import SceneParameters
from sim.smoke.parameters import SmokeParameters

CLOTH = {"shape": {"type": "rectangle", "size": (0.4, 0.4), "counts": (5, 5)}, "position": (0.0, 0.0, 0.6)}
BODIES = {
    "fluid": {"block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "position": (0.0, 0.0, 0.3)}]},
    "smoke": {"cell_size": 0.2, "source": [{"shape": {"type": "sphere", "radius": 0.2}, "position": (0.0, 0.0, 0.5)}]},
    "rigid": {
        "kind": "dynamic",
        "density": 500.0,
        "shape": {"type": "sphere", "radius": 0.1},
        "position": (0.0, 0.0, 0.3),
    },
    "cloth": CLOTH,
}
KEYS = {
    "fluid": FluidParameters.model_fields,
    "smoke": SmokeParameters.model_fields,
    "rigid": RigidBodyParameters.model_fields,
    "cloth": ClothParameters.model_fields,
}


def world_of(kind: str, **keys):
    return build_world(
        SceneParameters.model_validate({kind: [{"name": "body", **BODIES[kind], **keys}]}), frames_per_second=60
    )


@pytest.mark.usefixtures("taichi_cpu")
@pytest.mark.parametrize(
    ("kind", "keys", "named"),
    [
        ("fluid", {}, {"dt", "cfl", "particle_radius"}),
        ("smoke", {}, {"cfl", "cell_size"}),
        ("rigid", {}, {"velocity", "angular_velocity"}),
        ("cloth", {}, {"substeps", "stretch_stiffness", "wind"}),
        (
            "cloth",
            {"integrator": "explicit", "stretch_stiffness": 10.0},
            {"substeps", "stretch_stiffness", "integrator"},
        ),
    ],
    ids=["fluid", "smoke", "rigid", "cloth", "explicit cloth"],
)
def test_remedies_name_keys_of_the_body(kind, keys, named):
    (solver,) = world_of(kind, **keys).solvers.values()
    remedies = solver.remedies()
    words = set(re.findall(r"\w+", f"{remedies.runaway} {remedies.short_steps}"))
    assert named == words & set(KEYS[kind])
    # Words with an underscore are keys, and those of others would be of no use.
    assert {word for word in words if "_" in word} <= set(KEYS[kind])
