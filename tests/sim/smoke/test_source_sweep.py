"""The cells and faces that a source passes over in a step."""

import pytest

from sim.core.domain import DomainParameters
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import SmokeParameters
from sim.smoke.source_motion import CELLS, PARTS, SweptShape, motion_of

DOMAIN = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
CELL = 1.0 / 48.0
GRID = SmokeGrid.of_cells(DOMAIN.min, CELL, (48, 48, 48), frozenset())
WAY = [
    {"time_s": 0.0, "position": (-0.3, 0.0, 0.2)},
    {"time_s": 1.0, "position": (0.5, 0.1, 0.4), "rotation_deg": (0.0, 70.0, 160.0)},
]


def swept_shape(shape: dict, **changes) -> tuple[SweptShape, list]:
    """A shape that turns on its way out of a box, and poses of a step of a frame and a half."""
    source = {"shape": shape, "keyframe": WAY, **changes}
    smoke = SmokeParameters(name="plume", source=[source], cell_size=CELL)
    swept = SweptShape(smoke.source[0], CELL)
    return swept, motion_of(smoke.source[0], swept.reach).poses(0.5, 0.55, spacing=CELL / 4.0)


@pytest.mark.parametrize("axis", [CELLS, 0, 2])
@pytest.mark.parametrize(
    ("shape", "changes"),
    [
        ({"type": "sphere", "radius": 0.1}, {}),
        ({"type": "box", "size": (0.3, 0.04, 0.1)}, {}),
        ({"type": "torus", "major_radius": 0.12, "minor_radius": 0.03}, {}),
        ({"type": "duck"}, {"scale": 2.0}),
    ],
)
def test_a_step_covers_what_its_poses_do_and_the_last_of_them_counts(shape, changes, axis):
    swept, poses = swept_shape(shape, **changes)
    expected: dict[int, int] = {}
    for number, pose in enumerate(poses):
        expected |= dict.fromkeys(swept.covered(GRID, [pose], axis).indices.tolist(), number)
    found = swept.covered(GRID, poses, axis)
    assert len(poses) > 5
    assert len(found.indices) > 50
    assert dict(zip(found.indices.tolist(), found.poses.tolist(), strict=True)) == expected


def test_a_place_is_looked_at_again_only_where_it_may_have_been_covered():
    swept, poses = swept_shape({"type": "sphere", "radius": 0.1})
    asked: list[int] = []
    distance = swept._distance

    def counted(points):
        asked.append(len(points))
        return distance(points)

    swept._distance = counted
    swept.covered(GRID, poses[-1:], CELLS)
    in_box = asked[0]
    asked.clear()
    swept.covered(GRID, poses, CELLS)
    # For one pose all cells of its box, and all points of those near its surface; for each of the others layers of both
    # that are a quarter of a cell thick, in front and at corners that the turning might have reached.
    assert sum(asked) < 0.16 * len(poses) * in_box * (1 + PARTS**3)
