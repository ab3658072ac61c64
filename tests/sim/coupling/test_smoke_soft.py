"""Soft matter is an obstacle for the air."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from thread_counts import digest_of

from sim.build import build_world
from sim.scene import SceneParameters

SCENE = {
    "domain": {"min": (-0.2, -0.2, 0.0), "max": (0.2, 0.2, 0.6)},
    "soft": [
        {
            "name": "jelly",
            "material": "jelly",
            "cell_size": 0.04,
            "block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.16)}, "position": (0.0, 0.0, 0.4)}],
        }
    ],
    "smoke": [
        {
            "name": "fog",
            "cell_size": 0.02,
            "buoyancy_temperature": 0.0,
            "buoyancy_density": 0.0,
            "source": [{"shape": {"type": "box", "size": (0.3, 0.3, 0.1)}, "position": (0.0, 0.0, 0.1)}],
        }
    ],
}


def falling() -> Any:
    """A block of jelly that falls into fog."""
    return build_world(SceneParameters.model_validate(SCENE), frames_per_second=60)


@pytest.mark.slow
def test_falling_jelly_takes_the_room_of_air_that_moves_along_and_goes_on_to_the_bit(taichi_cpu):
    world = falling()
    for _ in range(8):
        world.advance_frame()
    smoke, place = world.solvers["fog"], world.solvers["soft"].view("jelly")["position"]
    taken = (1.0 - smoke.obstacles.open_volume().astype(np.float64)) * smoke.parameters.cell_size**3
    assert taken.sum() == pytest.approx(0.2 * 0.2 * 0.16, rel=0.08)  # without its edges, as water has none
    heights = smoke.grid.cell_centres().reshape(*smoke.grid.cells, 3)[..., 2]
    assert np.average(heights, weights=taken) == pytest.approx(place[:, 2].mean(), abs=0.5 * smoke.parameters.cell_size)
    checkpoint = world.checkpoint()
    world.advance_frame()
    again = falling()
    again.restore(8, checkpoint)
    again.advance_frame()
    assert digest_of(again.checkpoint()) == digest_of(world.checkpoint())


def test_a_window_of_smoke_is_refused_beside_it():
    smoke = [SCENE["smoke"][0] | {"grid": "window"}]
    with pytest.raises(ValidationError, match='"window" is of a smoke in a job with soft matter'):
        SceneParameters.model_validate(SCENE | {"smoke": smoke})
