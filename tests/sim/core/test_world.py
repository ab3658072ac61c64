"""The world lands on frames exactly, restores, and names what diverged."""

import math

import numpy as np
import pytest

from sim.core.solver import Remedies, SimulationDivergedError
from sim.core.world import World


class Oscillator:
    """A harmonic oscillator: a whole solver in ten lines, with an exact solution to compare to."""

    def __init__(self, name: str, dt: float, omega: float = 3.0) -> None:
        self.name, self._dt, self._omega = name, dt, omega
        self.x, self.v, self.time_s = 1.0, 0.0, 0.0

    def stable_dt(self) -> float:
        return self._dt

    def remedies(self) -> Remedies:
        return Remedies(runaway=f"slow {self.name} down", short_steps=f"soften {self.name}")

    def substep(self, dt: float) -> None:
        self.v -= dt * self._omega**2 * self.x
        self.x += dt * self.v
        self.time_s += dt

    def snapshots(self):
        return {}

    def checkpoint(self):
        return {"state": np.array([self.x, self.v, self.time_s])}

    def restore(self, arrays) -> None:
        self.x, self.v, self.time_s = (float(value) for value in arrays["state"])

    def diagnostics(self):
        return {"energy": 0.5 * (self.v**2 + (self._omega * self.x) ** 2)}

    def begin_frame(self, time_s: float) -> None:
        assert math.isclose(time_s, self.time_s, rel_tol=1e-12, abs_tol=1e-12)

    def first_bad_quantity(self) -> str | None:
        return None if math.isfinite(self.x) else f"x is {self.x}"


def test_a_watch_is_asked_after_every_substep_and_may_end_a_frame():
    asked = []
    world = World([Oscillator("a", 1 / 240), Oscillator("b", 1 / 120)], frames_per_second=60)
    world.watch = lambda: asked.append(1)
    world.advance_frame()
    assert len(asked) == 4 + 2
    world.watch = lambda: asked.append(1) or ("it takes too long" if len(asked) == 9 else None)
    with pytest.raises(SimulationDivergedError, match=r'"a" diverged at frame 2, t = 0\.0292 s: it takes too long'):
        world.advance_frame()


class Spring:
    """Counts the exchanges, to show that coupled solvers share their substeps."""

    def __init__(self, *bodies: str, is_loose: bool = False) -> None:
        self.bodies, self.is_loose, self.pushes_first = bodies, is_loose, False
        self.exchanged: list[float] = []
        self.followed: list[float] = []

    def exchange(self, dt: float) -> None:
        self.exchanged.append(dt)

    def follow(self, dt: float) -> None:
        self.followed.append(dt)

    def resume(self) -> None:
        self.followed.clear()


def test_what_comes_before_a_substep_knows_whose_it_is_and_how_long():
    world = World([Oscillator("a", 1 / 240), Oscillator("b", 1 / 120)], frames_per_second=60)
    told = []
    world.before_substep = lambda name, dt: told.append((name, dt, world.solvers[name].time_s))
    world.advance_frame()
    assert [name for name, _, _ in told] == ["a"] * 4 + ["b"] * 2
    assert [dt for _, dt, _ in told] == pytest.approx([1 / 240] * 4 + [1 / 120] * 2)
    assert [time_s for *_, time_s in told] == pytest.approx([0, 1 / 240, 2 / 240, 3 / 240, 0, 1 / 120])


@pytest.mark.parametrize("dt", [1.0, 1 / 60, 0.0166, 1.0e-3, 7.7e-4])
def test_frames_land_exactly_whatever_the_step(dt):
    oscillator = Oscillator("a", dt)
    world = World([oscillator], frames_per_second=60)
    for _ in range(60):
        report = world.advance_frame()
        assert report.smallest_dt_s["a"] <= dt * (1 + 1e-9)
    # Sixty frames of up to 22 float64 additions each: rounding only.
    assert oscillator.time_s == pytest.approx(1.0, abs=1e-12)
    assert world.time_s == 1.0


def test_coupled_solvers_share_substeps_and_others_keep_their_own():
    spring = Spring("fine", "coarse")
    solvers = [Oscillator("alone", 1 / 60), Oscillator("fine", 1 / 600), Oscillator("coarse", 1 / 120)]
    report = World(solvers, frames_per_second=60, couplings=[spring]).advance_frame()
    assert report.substeps == {"alone": 1, "fine": 10, "coarse": 10}
    # Ten steps of a tenth of a frame: rounding only.
    assert len(spring.exchanged) == 10
    assert sum(spring.exchanged) == pytest.approx(1 / 60, rel=1e-12)
    assert spring.followed == spring.exchanged


class Witness(Spring):
    """Notes at every exchange how far the two solvers have got."""

    def __init__(self, first: Oscillator, second: Oscillator) -> None:
        super().__init__(first.name, second.name, is_loose=True)
        self.solvers = first, second
        self.seen: list[tuple[float, float]] = []

    def exchange(self, dt: float) -> None:
        super().exchange(dt)
        self.seen.append(tuple(solver.time_s for solver in self.solvers))


def test_a_loose_coupling_lets_the_second_solver_keep_its_longer_steps():
    fine, coarse = Oscillator("fine", 1 / 1000), Oscillator("coarse", 1 / 180)
    witness = Witness(fine, coarse)
    report = World([fine, coarse], frames_per_second=60, couplings=[witness]).advance_frame()
    # 1/180 s takes six steps of at most 1/1000 s.
    assert report.substeps == {"fine": 18, "coarse": 3}
    assert report.smallest_dt_s["fine"] == pytest.approx(1 / 1080, rel=1e-12)
    # The first is at the end of the step, the second at its start; sums of up to 18 steps: rounding only.
    assert witness.seen == [pytest.approx((k / 180, (k - 1) / 180), abs=1e-12) for k in (1, 2, 3)]
    assert witness.exchanged == witness.followed == pytest.approx([1 / 180] * 3, rel=1e-12)


def test_a_solver_with_steps_of_its_own_cannot_share_those_of_others_too():
    solvers = [Oscillator(name, 1.0) for name in ("water", "flag", "air")]
    couplings = [Spring("water", "air", is_loose=True), Spring("flag", "air")]
    with pytest.raises(ValueError, match='"air" has steps of its own and cannot share those of "flag" and "air"'):
        World(solvers, frames_per_second=60, couplings=couplings)


def test_ten_frames_equal_five_then_restore_then_five():
    straight = World([Oscillator("a", 7.7e-4)], frames_per_second=60)
    for _ in range(10):
        straight.advance_frame()
    first = World([Oscillator("a", 7.7e-4)], frames_per_second=60)
    for _ in range(5):
        first.advance_frame()
    second = World([Oscillator("a", 7.7e-4)], frames_per_second=60)
    second.restore(first.frame, first.checkpoint())
    for _ in range(5):
        second.advance_frame()
    assert second.frame == straight.frame == 10
    np.testing.assert_array_equal(second.checkpoint()["a/state"], straight.checkpoint()["a/state"])


def test_a_checkpoint_of_another_scene_is_refused():
    with pytest.raises(ValueError, match='nothing for "b"'):
        World([Oscillator("b", 1.0)], frames_per_second=60).restore(3, {"a/state": np.zeros(3)})


def test_divergence_names_body_frame_time_and_quantity():
    # omega dt = 50: explicit integration grows about 2500-fold a step and overflows within the third frame.
    world = World([Oscillator("spring", 1 / 6000, omega=3.0e5)], frames_per_second=60)
    with pytest.raises(SimulationDivergedError, match=r'"spring" diverged at frame 1.*x is .*; slow spring') as caught:
        for _ in range(10):
            world.advance_frame()
    assert caught.value.body == "spring"
    assert caught.value.frame == 1
    assert 0 < caught.value.time_s <= 1 / 60


def test_a_collapsing_step_ends_instead_of_running_for_ever():
    with pytest.raises(SimulationDivergedError, match=r"stable time step fell to .*; soften a$"):
        World([Oscillator("a", 1.0e-12)], frames_per_second=60).advance_frame()


def test_of_coupled_solvers_the_one_with_the_shortest_steps_says_what_helps():
    pair = [Oscillator("a", 1.0e-2), Oscillator("b", 1.0e-12)]
    with pytest.raises(SimulationDivergedError, match=r'"a \+ b" .* fell to .*; soften b$'):
        World(pair, frames_per_second=60, couplings=[Spring("a", "b")]).advance_frame()


def test_a_coupling_needs_its_first_solver_first():
    solvers = [Oscillator("second", 1.0), Oscillator("first", 1.0)]
    with pytest.raises(ValueError, match='"first" must stand before "second"'):
        World(solvers, frames_per_second=60, couplings=[Spring("first", "second")])
