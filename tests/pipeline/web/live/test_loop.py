"""The loop of live by a clock of its own: how often a scene is computed and shown."""

from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.web.live import running as loop


class Clock:
    """A session and its page: frames take so long [s], and one 5 s, of a time that passes nowhere else."""

    is_paused = False
    speed = 1.0
    dt = 1.0 / 60.0
    revision = 0

    def __init__(self, frame_s: float, *, slow_frame: int = -1) -> None:
        self.now, self._frame_s, self._slow_frame = 0.0, frame_s, slow_frame
        self.world = SimpleNamespace(frame=0)
        self.shown_at: list[float] = []
        self.freed: list[tuple[str, int]] = []

    def meet_requests(self, wait_s: float) -> None:
        self.now += wait_s

    def advance(self) -> None:
        self.now += 5.0 if self.world.frame == self._slow_frame else self._frame_s
        self.world.frame += 1

    def show(self) -> None:
        self.shown_at.append(self.now)

    def tell(self) -> None:
        pass

    def free_memory(self, trouble: str) -> None:
        self.freed.append((trouble, self.world.frame))
        self.world.frame = 0
        self.revision += 1


@pytest.mark.parametrize(
    ("frame_s", "computed", "shown"),
    [(0.004, 60.0, 30.0), (0.0193, 51.8, 30.0), (0.032, 31.2, 30.0), (0.05, 20.0, 20.0)],
)
def test_thirty_states_a_second_are_shown_where_as_many_are_computed(monkeypatch, frame_s, computed, shown):
    clock = Clock(frame_s)
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    loop.run(clock, clock, ends=lambda: clock.now > 20.0)
    assert clock.world.frame / clock.now == pytest.approx(computed, rel=0.02)
    assert len(clock.shown_at) / clock.now == pytest.approx(shown, rel=0.02)


def test_after_a_long_frame_no_pictures_are_made_up_for(monkeypatch):
    clock = Clock(0.01, slow_frame=60)
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    loop.run(clock, clock, ends=lambda: clock.now > 8.0)
    apart = [after - before for before, after in zip(clock.shown_at, clock.shown_at[1:], strict=False)]
    assert max(apart) > 5.0
    assert len(clock.shown_at) == pytest.approx(30.0 * (clock.now - 5.0), rel=0.05)


@pytest.mark.parametrize("what", ["meet_requests", "show", "tell"])
@pytest.mark.parametrize("error", [MemoryError("no 9 GiB"), RuntimeError("[cuda] out of memory")])
def test_without_memory_for_the_page_or_a_request_the_scene_goes_back_once_and_then_live_ends(monkeypatch, what, error):
    clock = Clock(0.01)
    met = getattr(clock, what)
    failures = [5]

    def fails(*arguments: Any) -> None:
        failures[0] -= 1
        if failures[0] in (0, -20, -21):  # once, later again, and then again at once
            raise error
        met(*arguments)

    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(clock, what, fails)
    with pytest.raises(type(error)):
        loop.run(clock, clock, ends=lambda: clock.now > 20.0)
    assert [trouble for trouble, _ in clock.freed] == [f"{type(error).__name__}: {error}"] * 2
    assert failures[0] == -21


def test_an_error_of_the_program_is_no_lack_of_memory(monkeypatch):
    clock = Clock(0.01)

    def show() -> None:
        raise RuntimeError("Event loop is closed")

    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(clock, "show", show)
    with pytest.raises(RuntimeError, match="Event loop"):
        loop.run(clock, clock, ends=lambda: clock.now > 20.0)
    assert clock.freed == []
