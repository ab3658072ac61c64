"""A scene that runs and is played with; knows nothing of pages. One thread owns it; others ask through its queue."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.live.hands import FreeBody, Hand, LedBody, Nodes
from pipeline.live.knobs import Knob, Value, knobs_of, turn
from pipeline.live.pace import told_pace
from sim.snapshots import Snapshot
from sim.solver import SimulationDivergedError

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.world import FrameReport

MOST_SUBSTEPS = 2000
"""A frame that needs more counts as blown up: the page is not to wait for minutes."""

FASTEST = 200.0
"""What moves faster [m/s] has blown up: nothing of a tabletop does, and a jet's water comes with half of that."""

FRAMES_BETWEEN_MOMENTS = 30
"""How often the state is kept that a blow-up goes back to."""

FRAMES_TO_TRUST = 60
"""A moment that is younger than this at a blow-up may carry its cause."""

FIRST = "The first frame compiles kernels: up to a minute, once on a machine."

GRABBED_SPACINGS = 1.5
"""A hand takes cloth by the nodes within so many spacings: a single node would be drawn into a spike."""


@dataclass(frozen=True)
class Status:
    """How it goes.

    Attributes:
        frame, time_s: where the scene is.
        frame_ms: wall time of the last frame's computation [ms].
        substeps: of the last frame, by solver.
        substeps_asked: of that frame, by its cloth, where contacts and bodies may want more; None without a frame or
            without cloth in fixed steps.
        real_time: simulated over wall time in the last second or so; 0 while it is paused.
        is_paused: whether it stands still.
        message: the last thing that has to be known, "" if there is none.
    """

    frame: int
    time_s: float
    frame_ms: float
    substeps: Mapping[str, int]
    substeps_asked: Value | None
    real_time: float
    is_paused: bool
    message: str


@dataclass(frozen=True)
class _Moment:
    """What a blow-up goes back to."""

    frame: int
    arrays: dict[str, NDArray[np.generic]]
    paths: dict[int, Any]
    values: dict[str, Value]


class Session:
    """A scene, its knobs, what is held, and its clock.

    Requests come from any thread (`ask`) and are met between frames (`meet_requests`) by the thread that owns the
    session; all other methods are that thread's.

    Attributes:
        job: as it is simulated.
        knobs: what can be turned, by name.
        values: where knobs are now, by name.
        is_paused: whether time stands still.
        speed: simulated over wall time that is wanted, 1 for real time.
        message: the last thing that has to be known.
        report: of the last frame; None before the first.
        revision: grows when the scene or its knobs change otherwise than by time and by what was asked for.
        on_frame: called after each frame with its report, as a recording does; None: nobody.
        on_jump: called before time goes back, as a recording cannot; None: nobody.

    Args:
        job: cloth, bodies and fluid; `sim.runtime.initialize` must have run.
        written: the job as it was read, if it is simulated in other substeps, say: after a blow-up that is named.
        gave_up: whether it was live that changed it for the sake of speed, which --as-written prevents.

    Raises:
        ShapeError, ValueError: as `sim.build.build_world`.
    """

    def __init__(self, job: Job, *, written: Job | None = None, gave_up: bool = False) -> None:
        self.job, self._written, self._gave_up = job, written or job, gave_up
        self.knobs: dict[str, Knob] = {knob.name: knob for knob in knobs_of(job, written=written)}
        self.values: dict[str, Value] = {name: knob.start for name, knob in self.knobs.items()}
        self.is_paused = False
        self.speed = 1.0
        self.message = FIRST
        self.revision = 0
        self.on_frame: Callable[[FrameReport, Mapping[str, Snapshot]], None] | None = None
        self.on_jump: Callable[[], None] | None = None
        self.dt = 1.0 / job.fps
        self._requests: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._hands: dict[tuple[str, str], tuple[Hand, int]] = {}  # by what is held: and by which browser
        self._begins: deque[float] = deque(maxlen=max(10, job.fps))
        self._build()

    def _build(self) -> None:
        from sim.build import build_world

        self.world = build_world(self.job, frames_per_second=self.job.fps)
        self.world.max_substeps_per_frame = MOST_SUBSTEPS
        self._solvers: Mapping[str, Any] = self.world.solvers
        self.pins = self._pins()
        self._changes: list[tuple[int, str]] = []
        self._moments: deque[_Moment] = deque(maxlen=3)
        self.report: FrameReport | None = None
        self._frame_ms = 0.0
        self._substeps_asked: Value | None = None

    # --- from any thread --------------------------------------------------------------------------------------------

    def ask(self, request: Callable[..., object], *arguments: Any) -> None:
        """Have a method called between two frames; an error that is meant for people becomes the message."""
        self._requests.put(lambda: request(*arguments))

    # --- the owner's: the loop --------------------------------------------------------------------------------------

    def meet_requests(self, wait_s: float = 0.0) -> None:
        """Do all that was asked for; wait for the first request for so long at most [s]."""
        try:
            request = self._requests.get(timeout=wait_s) if wait_s > 0.0 else self._requests.get_nowait()
            while True:
                try:
                    request()
                except (ValueError, PipelineError, OSError) as error:
                    self.message = str(error)
                    self.revision += 1
                request = self._requests.get_nowait()
        except Empty:
            return

    def advance(self) -> None:
        """Compute a frame; after a blow-up, go back to where the scene was sound."""
        began = time.perf_counter()
        self._begins.append(began)
        try:
            for hand, _ in self._hands.values():
                hand.move(self.dt)
            if self._hands:
                self.world.tell_couplings()
            report = self.world.advance_frame()
            _require_sound(report)
        except SimulationDivergedError as error:
            self._go_back(error.finding)  # its hint is about keys of a job that no knob turns
            return
        except (FloatingPointError, np.linalg.LinAlgError) as error:
            self._go_back(str(error))
            return
        self.report = report
        if self.message == FIRST:
            self.message = ""
        self._frame_ms = 1e3 * (time.perf_counter() - began)
        self._substeps_asked = self.values.get("cloth.substeps")
        if self.on_frame is not None:
            self.on_frame(report, self.world.snapshots())
        if report.frame % FRAMES_BETWEEN_MOMENTS == 0:
            self._moments.append(self._moment())

    def status(self) -> Status:
        """How it goes."""
        span = time.perf_counter() - self._begins[0] if len(self._begins) > 1 else 0.0
        rate = 0.0 if self.is_paused or span <= 0.0 else (len(self._begins) - 1) * self.dt / span
        substeps = {} if self.report is None else self.report.substeps
        return Status(
            self.world.frame, self.world.time_s, self._frame_ms, substeps, self._substeps_asked, rate, self.is_paused,
            self.message,
        )  # fmt: skip

    def bodies(self) -> dict[str, Snapshot]:
        """What there is to see now; arrays that no later frame changes."""
        return self.world.snapshots()

    # --- the owner's: requests --------------------------------------------------------------------------------------

    def pause(self, is_paused: bool) -> None:
        """Stop time, or let it go on."""
        self.is_paused = is_paused
        self._begins.clear()

    def step(self) -> None:
        """Compute one frame and stand still."""
        self.pause(True)
        self.advance()

    def set_speed(self, speed: float) -> None:
        """Let time go so many times as fast as on the wall, 1 at most."""
        if not 0.0 < speed <= 1.0:
            raise ValueError(f"the speed must lie above 0 and be 1 at most, got {speed:g}")
        self.speed = speed

    def reset(self) -> None:
        """Begin anew, with the knobs where they are."""
        self.message = ""
        self._begin_anew(dict(self.values))

    def turn(self, name: str, value: object) -> None:
        """Turn a knob.

        Raises:
            ValueError: there is no such knob, or it cannot be turned to that.
        """
        if name not in self.knobs:
            raise ValueError(f'nothing is named "{name}"')
        knob = self.knobs[name]
        wanted, before = knob.checked(value), self.values[name]
        if wanted == before:
            return
        turn(self.world, self.job, knob, wanted, before=before)
        self.values[name] = wanted
        self._changes.append((self.world.frame, f"{name} = {wanted}"))

    def grab_body(self, name: str, point: tuple[float, float, float], holder: int = 0) -> None:
        """Take a body in hand at a point of the world [m].

        Raises:
            ValueError: there is none of this name that moves.
        """
        rigid = self._solvers.get("rigid")
        if rigid is None or name not in rigid.bodies.names:
            raise ValueError(f'"{name}" cannot be moved')
        number = rigid.bodies.names.index(name)
        at = np.asarray(point, dtype=np.float64)
        if rigid.bodies.is_dynamic[number]:
            hand: Hand = FreeBody(rigid, number, arm=at - rigid.bodies.position[number])
        else:
            hand = LedBody(rigid, number, arm=at - rigid.paths[number].at(rigid.time_s).position)
        self._take(("body", name), hand, holder)

    def grab_cloth(self, name: str, point: tuple[float, float, float], holder: int = 0) -> None:
        """Take a cloth in hand at its node nearest to a point [m], or its pin, if a pin holds that."""
        cloth = self._solvers["cloth"]
        position, first = self._nodes_of(name)
        distance = np.linalg.norm(position - np.asarray(point), axis=1)
        nearest = int(np.argmin(distance))
        for number, (of_cloth, nodes) in enumerate(self.pins):
            if of_cloth == name and nearest in nodes:
                self.grab_pin(number, holder)
                return
        area = cloth.state.host.node_area[first + nearest]
        around = np.linalg.norm(position - position[nearest], axis=1) <= GRABBED_SPACINGS * np.sqrt(area)
        held = [nodes for of_cloth, nodes in self.pins if of_cloth == name]
        free = np.setdiff1d(np.flatnonzero(around), np.concatenate([np.empty(0, np.int64), *held]))
        self._take(("cloth", name), Nodes(cloth, name, free, stays=False), holder)

    def grab_pin(self, number: int, holder: int = 0) -> None:
        """Take the nodes of a pin in hand.

        Raises:
            ValueError: there is no such pin, or it follows a path of its own.
        """
        if not 0 <= number < len(self.pins):
            raise ValueError(f"there is no pin {number}")
        name, nodes = self.pins[number]
        self._take(("pin", str(number)), Nodes(self._solvers["cloth"], name, nodes, stays=True), holder)

    def drag(self, kind: str, name: str, target: tuple[float, float, float], holder: int = 0) -> None:
        """Lead what a browser holds to a place [m]; nothing if it holds it no more."""
        place = np.asarray(target, dtype=np.float64)
        if not np.isfinite(place).all():
            return
        for key in self._held_by(holder, kind, name):
            self._hands[key][0].target = place

    def let_go(self, kind: str, name: str, holder: int = 0) -> None:
        """Let go what a browser holds."""
        for key in self._held_by(holder, kind, name):
            self._hands.pop(key)[0].release()

    def let_go_all(self, holder: int | None = None) -> None:
        """Let go all that a browser holds, such as one that is gone; all there is if omitted."""
        for key, (hand, whose) in list(self._hands.items()):
            if holder is None or whose == holder:
                del self._hands[key]
                hand.release()

    @property
    def is_holding(self) -> bool:
        """Whether anything is held."""
        return bool(self._hands)

    # --- inside -----------------------------------------------------------------------------------------------------

    def _held_by(self, holder: int, kind: str, name: str) -> list[tuple[str, str]]:
        """What a browser means by a thing: of a cloth, it may be a pin that its mouse got hold of."""
        mine = [key for key, (_, whose) in self._hands.items() if whose == holder]
        if (kind, name) in mine or kind != "cloth":
            return [key for key in mine if key == (kind, name)]
        return [key for key in mine if key[0] == "pin" and self.pins[int(key[1])][0] == name]

    def _take(self, key: tuple[str, str], hand: Hand, holder: int) -> None:
        if key in self._hands:
            self._hands.pop(key)[0].release()
        self._hands[key] = (hand, holder)

    def _nodes_of(self, name: str) -> tuple[NDArray[np.float64], int]:
        """Positions of a cloth's nodes [m], (n, 3), and the number of the first among all nodes."""
        state = self._solvers["cloth"].state
        number = state.names.index(name)
        first, last = state.host.first_node[number : number + 2]
        return state.positions()[first:last], int(first)

    def _pins(self) -> list[tuple[str, NDArray[np.int64]]]:
        """Cloth and nodes, in its own numbers, of every pin."""
        from sim.cloth.start import pins_of

        return [(cloth.name, nodes) for cloth in self.job.cloth for nodes in pins_of(cloth)]

    def _moment(self) -> _Moment:
        paths = dict(self._solvers["rigid"].paths) if "rigid" in self._solvers else {}
        return _Moment(self.world.frame, self.world.checkpoint(), paths, dict(self.values))

    def _begin_anew(self, values: Mapping[str, Value]) -> None:
        """Build the scene again, with these values of its knobs, and nothing held; a value that is refused is told."""
        self.revision += 1
        self._hands.clear()
        if self.on_jump is not None:
            self.on_jump()
        self.values = {name: knob.start for name, knob in self.knobs.items()}
        self._build()
        refused = self._turn_all(values)
        if refused:
            self.message = f"{self.message} Not taken over: {'; '.join(refused)}.".lstrip()
        self._begins.clear()

    def _turn_all(self, values: Mapping[str, Value]) -> list[str]:
        """Turn knobs; returns what was refused, and why.

        What explicit springs bear hangs on several knobs together, so that one may have to wait for another.
        """
        left, count = dict(values), len(values) + 1
        refused: dict[str, str] = {}
        while left and len(left) < count:
            count, refused = len(left), {}
            for name, value in list(left.items()):
                try:
                    self.turn(name, value)
                    del left[name]
                except ValueError as error:
                    refused[name] = f"{name} = {value} ({error})"
        return list(refused.values())

    def _go_back(self, what: str) -> None:
        """Go back to the newest moment that can be trusted; else to the start with the values of then, and stop."""
        now = self.world.frame
        moment = next((each for each in reversed(self._moments) if now - each.frame >= FRAMES_TO_TRUST), None)
        turned = [change for frame, change in self._changes if moment is None or frame >= moment.frame]
        held = [f'"{name}" of the {kind}' if kind == "pin" else f'"{name}"' for kind, name in self._hands]
        if turned:
            cause = f"Turned last: {turned[-1]}."
        elif held:
            cause = f"In hand: {', '.join(held)}."
        else:
            cause = "Nothing had been turned."
        self.message = ""
        self._begin_anew({} if moment is None else moment.values)
        if moment is None:
            self.is_paused = True
        else:
            if "rigid" in self._solvers:
                self._solvers["rigid"].paths.update(moment.paths)
            self.world.restore(moment.frame, moment.arrays)
            self._moments.append(moment)
        began_with = {name: value for name, value in self.values.items() if value == self.knobs[name].start}
        if pace := told_pace(self._written, began_with):
            cause += f" {pace} Knobs bring that back{', and so does --as-written' if self._gave_up else ''}."
        elif not (turned or held):
            cause += " The job may need more substeps."
        place = "the start, with the values that it had there" if moment is None else f"{self.world.time_s:.2f} s"
        self.message = f"It blew up: {what}. {cause} Back at {place}. {self.message}".rstrip()


def _require_sound(report: FrameReport) -> None:
    """Blow-ups show as speeds long before they show as values that are no numbers.

    Raises:
        SimulationDivergedError: something is absurdly fast.
    """
    for name, numbers in report.diagnostics.items():
        speed = float(numbers.get("max_speed", 0.0))
        if not speed <= FASTEST:
            raise SimulationDivergedError(name, report.frame, report.time_s, f"something moves at {speed:.3g} m/s")
