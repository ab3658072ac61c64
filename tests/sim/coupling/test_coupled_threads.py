"""Coupled steps give the same bits whatever the number of threads."""

import pytest
from thread_counts import outputs_by_threads

STEP_AND_PRINT_DIGEST = """
import hashlib, sys
from sim.core.runtime import initialize
initialize("cpu", threads=int(sys.argv[1]))
from coupled_tanks import Tank
from sim.core.domain import DomainParameters
domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.36, 0.36, 0.6))
ball = {"kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 0.09}}
for solver in ("wcsph", "dfsph", "pcisph"):
    tank = Tank(
        [{**ball, "position": (0.15, 0.18, 0.28), "velocity": (0.0, 0.0, -1.0)}],
        domain=domain, water=((0.0, 0.0, 0.0), (0.36, 0.36, 0.2)), solver=solver, wall_friction=1.0,
    )
    for _ in range(40):
        tank.step()
    digest = hashlib.sha256()
    for name, array in sorted(tank.world.checkpoint().items()):
        digest.update(array.tobytes())
    print(digest.hexdigest(), float(abs(tank.coupling.force).max()) > 0.0)
"""


def test_fluid_and_bodies_do_not_depend_on_the_number_of_threads():
    one_thread, two_threads = outputs_by_threads(STEP_AND_PRINT_DIGEST, beside=__file__)
    assert one_thread.split()[1::2] == ["True"] * 3
    assert one_thread == two_threads


WITH_CLOTH = """
import hashlib, sys
from sim.core.runtime import initialize
initialize("cpu", threads=int(sys.argv[1]))
from cloth_tanks import EDGES, ClothTank, rectangle
tank = ClothTank(
    cloth={"shape": rectangle(0.16, 9), "position": (0.0, 0.0, 0.1), "mass_per_area": 0.2, "pin": EDGES},
    water=((-0.08, -0.08, 0.12), (0.08, 0.08, 0.2)), solver=sys.argv[2], wall_friction=1.0,
    domain={"min": (-0.08, -0.08, 0.0), "max": (0.08, 0.08, 0.3)},
)
tank.run(0.05)
digest = hashlib.sha256()
for name, array in sorted(tank.world.checkpoint().items()):
    digest.update(array.tobytes())
print(digest.hexdigest(), float(abs(tank.coupling.impulse()).max()) > 0.0)
"""


@pytest.mark.slow
def test_cloth_and_fluid_do_not_depend_on_the_number_of_threads():
    digests = outputs_by_threads(WITH_CLOTH, "dfsph", beside=__file__)
    assert digests[0].split()[1] == "True"
    assert digests[0] == digests[1]
