"""Mass, centre of mass and inertia of a sphere, a box, and a mesh that is off its centre."""

import numpy as np

from validation.cases import Case, Found
from validation.checks import Check
from validation.scenes import body, make_bodies

DENSITY = 700.0


def find(_: str) -> Found:
    """What the equations of motion use, against closed forms."""
    radius, edges = 0.25, np.array([0.3, 0.2, 0.1])
    ball = make_bodies(body("ball", {"type": "sphere", "radius": radius}, position=(0.0, 0.0, 1.0)))
    box = make_bodies(body("box", {"type": "box", "size": tuple(edges)}, position=(0.0, 0.0, 1.0)))
    cone = make_bodies(body("cone", {"type": "cone", "radius": 0.2, "height": 0.4}, position=(0.0, 0.0, 1.0)))
    ball_mass = DENSITY * 4.0 / 3.0 * np.pi * radius**3
    box_mass = DENSITY * edges.prod()
    box_inertia = box_mass / 12.0 * ((edges**2).sum() - edges**2)
    cone_mass = DENSITY * np.pi * 0.2**2 * 0.4 / 3.0
    of_ball = np.linalg.inv(ball.bodies.inverse_inertia()[0])
    of_box = np.linalg.inv(box.bodies.inverse_inertia()[0])
    of_cone = np.linalg.inv(cone.bodies.inverse_inertia()[0])
    round_reason = "the mesh is a polyhedron inside of the round body: 0.05 % of volume for the sphere"
    checks = [
        Check("mass of the sphere over theory", float(ball.bodies.mass[0]) / ball_mass, 1.0, 2e-3, round_reason),
        Check("inertia of the sphere over 2/5 m r²", float(np.trace(of_ball)) / 3.0 / (0.4 * ball_mass * radius**2),
              1.0, 3e-3, round_reason + ", five thirds of it for the inertia"),
        Check("mass of the box over theory", float(box.bodies.mass[0]) / box_mass, 1.0, 1e-9, "exact integrals"),
        Check("largest error of the box's inertia",
              float(np.abs(of_box - np.diag(box_inertia)).max() / box_inertia.max()), 0.0, 1e-9, "exact integrals"),
        Check("mass of the cone over theory", float(cone.bodies.mass[0]) / cone_mass, 1.0, 5e-3, "it is a polyhedron"),
        Check("centre of mass of the cone above its base, over h/4",
              (float(cone.bodies.position[0, 2]) - 0.8) / 0.1, 1.0, 2e-3, "the apex and the base are exact"),
        Check("inertia of the cone about its axis over 3/10 m r²", float(of_cone[2, 2]) / (0.3 * cone_mass * 0.2**2),
              1.0, 1e-2, "it is a polyhedron: twice the error of the volume"),
        Check("inertia of the cone across its axis over 3/80 m (4 r² + h²)",
              float(of_cone[0, 0]) / (3.0 / 80.0 * cone_mass * (4.0 * 0.2**2 + 0.4**2)), 1.0, 1e-2, "likewise"),
    ]  # fmt: skip
    return checks, {}


CASE = Case(find, solvers=("rigid",))
