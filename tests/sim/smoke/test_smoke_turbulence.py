"""Gusts: as strong as they are said to be, free of divergence, and the same in every run."""

import numpy as np
import pytest
from smoke_scenes import air_in, get_faces

from sim.core.domain import DomainParameters
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import SmokeParameters, TurbulenceParameters
from sim.smoke.turbulence import Turbulence

pytestmark = pytest.mark.usefixtures("taichi_cpu")

CELL = 0.05
DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(2.0, 1.9, 1.85))
SOURCE = {"shape": {"type": "sphere", "radius": 0.2}, "position": (1.0, 1.0, 1.0)}
ALL_OPEN = ("x-", "x+", "y-", "y+", "z-", "z+")


class Gusts:
    """Turbulence in a box whose sides are open, without the solver around it."""

    def __init__(self, *, low_x: float = 0.0, wind: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes) -> None:
        box = SmokeParameters(name="air", cell_size=CELL, source=[SOURCE], open_faces=ALL_OPEN, min=(low_x, 0.0, 0.0))
        self.grid = SmokeGrid.build(box, DOMAIN)
        self.air = air_in(self.grid)
        parameters = TurbulenceParameters(**{"strength": 2.0, "size": 0.2, "rate": 4.0, **changes})
        self.turbulence = Turbulence(self.grid, parameters, wind)

    def at(self, time_s: float) -> list[np.ndarray]:
        """The acceleration by axis [m/s²], in the shape of the faces."""
        for array in self.air.state.velocity:
            array.fill(0.0)
        self.turbulence.accelerate(self.air, time_s, 1.0)
        return [face.astype(np.float64) for face in get_faces(self.grid, self.air.state.velocity)]


def test_its_acceleration_is_as_strong_as_asked_for_and_has_no_divergence():
    strength = 2.0
    gusts = Gusts(strength=strength)
    squares, means = [], []
    for time_s in np.arange(0.0, 3.0, 0.31):
        a_x, a_y, a_z = gusts.at(time_s)
        squares.append(sum(np.square(a).mean() for a in (a_x, a_y, a_z)))
        means.append([a.mean() for a in (a_x, a_y, a_z)])
        divergence = np.diff(a_x, axis=0) + np.diff(a_y, axis=1) + np.diff(a_z, axis=2)
        # Rounding: sums of 64 products in single precision of terms some times as large as the result.
        assert np.abs(divergence).max() < 1.0e-5 * strength
    # Differences over a cell, a quarter of the width, take 1 - (pi/2 h/L)²/6 or so: 2 %; ten boxes of 10³ eddies leave
    # a standard error of 1 %.
    assert np.sqrt(np.mean(squares)) == pytest.approx(strength, rel=0.05)
    assert np.abs(means).max() < 0.1 * strength
    assert gusts.turbulence.acceleration >= 0.9 * strength


def test_eddies_are_as_large_as_asked_for_and_change_at_the_rate():
    def correlation(a: np.ndarray, b: np.ndarray) -> float:
        return float((a * b).mean() / np.sqrt(np.square(a).mean() * np.square(b).mean()))

    gusts = Gusts(size=0.4, rate=2.0)
    a_x = gusts.at(0.5)[0]
    cells = round(0.4 / CELL)
    # Along its own direction a quarter of an eddy changes little, and three eddies away the splines do not overlap.
    assert correlation(a_x[:-2], a_x[2:]) > 0.85
    assert abs(correlation(a_x[: -3 * cells], a_x[3 * cells :])) < 0.25
    # Half of 1/rate later half of the variance is in new numbers: cos 45° = 0.71; after 1/rate all of it is.
    assert correlation(a_x, gusts.at(0.75)[0]) == pytest.approx(np.cos(0.25 * np.pi), abs=0.1)
    assert abs(correlation(a_x, gusts.at(1.0)[0])) < 0.25
    still = Gusts(rate=0.0)
    assert np.array_equal(still.at(0.0)[1], still.at(7.0)[1])


def test_it_is_a_function_of_place_time_and_seed():
    first, again, other = Gusts(), Gusts(), Gusts(seed=1)
    assert all(map(np.array_equal, first.at(0.3), again.at(0.3)))
    assert not any(map(np.array_equal, first.at(0.3), other.at(0.3)))
    # The smoke's own box, 0.4 m along x, cuts the same gusts out of the world.
    part = Gusts(low_x=0.4)
    whole = first.at(0.3)[2]
    # Places differ by rounding, 1e-16 of a metre; weights in single precision by 1e-7.
    assert part.at(0.3)[2] == pytest.approx(whole[8:], abs=1.0e-5)


def test_it_drifts_with_the_wind():
    gusts = Gusts(wind=(1.0, 0.0, 0.0), rate=0.0)
    before, after = gusts.at(0.0)[1], gusts.at(0.25)[1]
    # 0.25 m are five cells.
    assert after[6:] == pytest.approx(before[1:-5], abs=1.0e-4)


def test_eddies_that_cells_cannot_carry_are_refused():
    with pytest.raises(ValueError, match=r"turbulence.size: 0.08 m is less than two cells of 0.05 m"):
        Gusts(size=0.08)
