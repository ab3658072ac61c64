"""A scene that runs and is played with; knows nothing of pages. One thread owns it; others ask through its queue."""

from __future__ import annotations

import gc
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.executors.failures import describe, is_out_of_memory
from pipeline.live.frame_watch import PATIENCE_S, FrameWatch
from pipeline.live.hands import FreeBody, Hand, LedBody, Nodes
from pipeline.live.knobs import Knob, Value, knobs_of, turn
from pipeline.live.pace import told_pace
from sim.snapshots import Snapshot
from sim.solver import SimulationDivergedError

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.world import FrameReport

MOST_SUBSTEPS = 2000
"""A frame that needs more counts as blown up, before it has taken long."""

FASTEST = 200.0
"""What moves faster [m/s] has blown up: nothing of a tabletop does, and a jet's water comes with half of that."""

FRAMES_BETWEEN_MOMENTS = 30
"""How often the state is kept that a blow-up goes back to."""

FRAMES_TO_TRUST = 60
"""A moment that is younger than this at a blow-up may carry its cause."""

FIRST = "The first frame compiles kernels: up to a minute, once on a machine."

NO_MEMORY = "No memory was left"

MORE_SUBSTEPS = " The job may need more substeps."
FASTER = " --anyway lets frames take as long as they do; fewer substeps or --preview makes them faster."
"""What may help where nobody turned or held anything: against steps that are too long, and against slow frames."""

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


class _Held(NamedTuple):
    """Something in a hand: a body, a pin by its number, or a place of a cloth, of which each browser may hold one."""

    kind: str
    name: str
    holder: int


class _JobPin(NamedTuple):
    """A pin as the job has it: its cloth, its nodes there, and when it lets go [s]."""

    cloth: str
    nodes: NDArray[np.int64]
    release_s: float


class CannotGoOnError(PipelineError):
    """A scene is gone, and cannot be built again, or cannot be shown: there is no memory for it, say."""


class _FrameLeftError(Exception):
    """Nobody wants the frame any more that is being computed."""


class Session:
    """A scene, its knobs, what is held, and its clock.

    Requests come from any thread (`ask`, `ask_reset`) and are met between frames (`meet_requests`) by the thread that
    owns the session; all other methods are that thread's.

    Attributes:
        job: as it is simulated.
        knobs: what can be turned, by name.
        values: where knobs are now, by name.
        is_paused: whether time stands still.
        speed: simulated over wall time that is wanted, 1 for real time.
        message: the last thing that has to be known: what was refused last, until another request is met; else the last
            result.
        report: of the last frame; None before the first.
        revision: grows when the scene or its knobs change otherwise than by time and by what was asked for.
        on_frame: called after each frame with its report, as a recording does; None: nobody.
        on_jump: called before time goes back, as a recording cannot; None: nobody.
        ends: asked within frames whether all is over, so that the frame need not be computed to its end.

    Args:
        job: cloth, bodies and fluid; `sim.runtime.initialize` must have run.
        written: the job as it was read, if it is simulated in other substeps, say: after a blow-up that is named.
        gave_up: whether it was live that changed it for the sake of speed, which --as-written prevents.
        patience_s: a frame that takes longer counts as blown up [s]; infinite where slow frames were asked for.
        clock: tells the time [s].

    Raises:
        ShapeError, ValueError: as `sim.build.build_world`.
    """

    def __init__(
        self,
        job: Job,
        *,
        written: Job | None = None,
        gave_up: bool = False,
        patience_s: float = PATIENCE_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.job, self._written, self._gave_up = job, written or job, gave_up
        self._clock, self._watch = clock, FrameWatch(patience_s, clock=clock)
        self.knobs: dict[str, Knob] = {knob.name: knob for knob in knobs_of(job, written=written)}
        self.values: dict[str, Value] = {name: knob.start for name, knob in self.knobs.items()}
        self.is_paused = False
        self.speed = 1.0
        self._result, self._refusal = FIRST, ""
        self.revision = 0
        self.on_frame: Callable[[FrameReport, Mapping[str, Snapshot]], None] | None = None
        self.on_jump: Callable[[], None] | None = None
        self.ends: Callable[[], bool] = lambda: False
        self.dt = 1.0 / job.fps
        self._requests: SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]]] = SimpleQueue()
        self._is_reset_asked = threading.Event()
        self._hands: dict[_Held, Hand] = {}
        self._begins: deque[float] = deque(maxlen=max(10, job.fps))
        self._build()

    def _build(self) -> None:
        from sim.build import build_world

        self.world = build_world(self.job, frames_per_second=self.job.fps)
        self.world.max_substeps_per_frame = MOST_SUBSTEPS
        self.world.watch = self._after_substep
        self._solvers: Mapping[str, Any] = self.world.solvers
        self._pins = self._job_pins()
        self._led_pins: set[int] = set()
        self._changes: list[tuple[int, str]] = []
        self._moments: deque[_Moment] = deque(maxlen=3)
        self.report: FrameReport | None = None
        self._frame_ms = 0.0
        self._substeps_asked: Value | None = None

    # --- from any thread --------------------------------------------------------------------------------------------

    def ask(self, request: Callable[..., object], *arguments: Any) -> None:
        """Have a method called between two frames; an error that is meant for people becomes the message."""
        self._requests.put((request, arguments))

    def ask_reset(self) -> None:
        """Have all begin anew; a frame that is being computed is left for it."""
        self._is_reset_asked.set()
        self.ask(self.reset)

    # --- the owner's: the loop --------------------------------------------------------------------------------------

    def meet_requests(self, wait_s: float = 0.0) -> None:
        """Do all that was asked for; wait for the first request for so long at most [s].

        Raises:
            CannotGoOnError: a scene that had to begin anew has no memory.
        """
        try:
            asked = self._requests.get(timeout=wait_s) if wait_s > 0.0 else self._requests.get_nowait()
            while True:
                request, arguments = asked
                try:
                    request(*arguments)
                except CannotGoOnError:
                    raise
                except (ValueError, PipelineError, OSError) as error:
                    self._refusal = str(error)
                    self.revision += 1
                else:
                    # A grab that is refused is followed by what the mouse does with nothing in hand.
                    if request not in (self.drag, self.let_go, self.let_go_all):
                        self._refusal = ""
                asked = self._requests.get_nowait()
        except Empty:
            return

    def advance(self) -> None:
        """Compute a frame; after a blow-up, go back to where the scene was sound.

        Raises:
            CannotGoOnError: there is no memory for that either.
        """
        began = self._clock()
        self._begins.append(began)
        what = remedy = ""
        try:
            self._move_hands()
            self._watch.begin_frame()
            report = self.world.advance_frame()
            _require_sound(report)
            took_s = self._clock() - began
            bodies = None if self.on_frame is None else self.world.snapshots()
            moment = None if report.frame % FRAMES_BETWEEN_MOMENTS else self._moment()
        except _FrameLeftError:
            return
        except SimulationDivergedError as error:
            # Its hint is about keys of a job that no knob turns.
            remedy = FASTER if self._watch.is_too_slow else MORE_SUBSTEPS
            what = f"It blew up: {error.finding}"
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            # Too many contacts or neighbours say themselves what leaves fewer.
            remedy = "" if isinstance(error, OverflowError) else MORE_SUBSTEPS
            what = f"It blew up: {error}"
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            what = f"{NO_MEMORY}: {describe(error)}"
        if what:  # not within the handlers: an error's traceback would keep the old world
            self._go_back(what, remedy=remedy)
            return
        self.report = report
        if self._result == FIRST:
            self._result = ""
        self._frame_ms = 1e3 * took_s
        self._substeps_asked = self.values.get("cloth.substeps")
        if self.on_frame is not None and bodies is not None:
            self.on_frame(report, bodies)
        if moment is not None:
            self._moments.append(moment)

    def free_memory(self, trouble: str) -> None:
        """Go back to where the scene was sound, as there was no memory for something else than a frame.

        Args:
            trouble: what was told of that.

        Raises:
            CannotGoOnError: there is no memory for it either.
        """
        self._go_back(f"{NO_MEMORY}: {trouble}", remedy="")

    def status(self) -> Status:
        """How it goes."""
        span = self._clock() - self._begins[0] if len(self._begins) > 1 else 0.0
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
        """Begin anew, with the knobs where they are.

        Raises:
            CannotGoOnError: there is no memory for it.
        """
        self._is_reset_asked.clear()
        self.message = ""
        values, has_room = dict(self.values), True
        try:
            self._begin_anew(values)  # the old world goes on if the new one is refused, as where a mesh is gone
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            has_room = False
        if not has_room:  # for both
            self._drop()
            with self._or_ended():
                self._begin_anew(values)

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
            ValueError: there is none of this name that moves, or another browser holds it.
        """
        rigid = self._solvers.get("rigid")
        if rigid is None or name not in rigid.bodies.names:
            raise ValueError(f'"{name}" cannot be moved')
        number = rigid.bodies.names.index(name)
        at = np.asarray(point, dtype=np.float64)
        key = self._freed(_Held("body", name, holder), called=f'"{name}"')
        if rigid.bodies.is_dynamic[number]:
            self._hands[key] = FreeBody(rigid, number, arm=at - rigid.bodies.position[number])
        else:
            self._hands[key] = LedBody(rigid, number, arm=at - rigid.paths[number].at(rigid.time_s).position)

    def grab_cloth(self, name: str, point: tuple[float, float, float], holder: int = 0) -> None:
        """Take a cloth in hand at its node nearest to a point [m], or its pin, if a pin holds that.

        Raises:
            ValueError: another browser holds that.
        """
        cloth = self._solvers["cloth"]
        position, first = self._nodes_of(name)
        distance = np.linalg.norm(position - np.asarray(point), axis=1)
        nearest = int(np.argmin(distance))
        pins = {number: nodes for number, (of_cloth, nodes) in self.pins.items() if of_cloth == name}
        for number, nodes in pins.items():
            if nearest in nodes:
                self.grab_pin(number, holder)
                return
        key = _Held("cloth", name, holder)
        theirs = [
            hand.nodes
            for (kind, of_cloth, whose), hand in self._hands.items()
            if isinstance(hand, Nodes) and (kind, of_cloth) == key[:2] and whose != holder
        ]
        if any(nearest in nodes for nodes in theirs):
            raise ValueError(f'another browser holds "{name}" there')
        area = cloth.state.host.node_area[first + nearest]
        around = np.linalg.norm(position - position[nearest], axis=1) <= GRABBED_SPACINGS * np.sqrt(area)
        free = np.setdiff1d(np.flatnonzero(around), np.concatenate([np.empty(0, np.int64), *pins.values(), *theirs]))
        self._release(key)
        self._hands[key] = Nodes(cloth, name, free, stays=False)

    def grab_pin(self, number: int, holder: int = 0) -> None:
        """Take the nodes of a pin in hand: its keyframes and its release are not for them any more.

        Raises:
            ValueError: there is no such pin, it has let go, or another browser holds it.
        """
        if not 0 <= number < len(self._pins):
            raise ValueError(f"there is no pin {number}")
        if number not in self.pins:
            raise ValueError(f"pin {number} has let go")
        name, nodes = self.pins[number]
        key = self._freed(_Held("pin", str(number), holder), called=f'pin {number} of "{name}"')
        self._hands[key] = Nodes(self._solvers["cloth"], name, nodes, stays=True)
        self._led_pins.add(number)

    def drag(self, kind: str, name: str, target: tuple[float, float, float], holder: int = 0) -> None:
        """Lead what a browser holds to a place [m]; nothing if it holds it no more."""
        place = np.asarray(target, dtype=np.float64)
        if not np.isfinite(place).all():
            return
        for key in self._held_by(holder, kind, name):
            self._hands[key].target = place

    def let_go(self, kind: str, name: str, holder: int = 0) -> None:
        """Let go what a browser holds."""
        for key in self._held_by(holder, kind, name):
            self._release(key)

    def let_go_all(self, holder: int | None = None) -> None:
        """Let go all that a browser holds, such as one that is gone; all there is if omitted."""
        for key in list(self._hands):
            if holder is None or key.holder == holder:
                self._release(key)

    @property
    def is_holding(self) -> bool:
        """Whether anything is held."""
        return bool(self._hands)

    @property
    def pins(self) -> dict[int, tuple[str, NDArray[np.int64]]]:
        """Cloth and nodes, in its own numbers, of every pin that holds now, by the pin's number."""
        from sim.cloth.pins import holds

        return {
            number: (pin.cloth, pin.nodes)
            for number, pin in enumerate(self._pins)
            if number in self._led_pins or holds(pin.release_s, self.world.time_s)
        }

    @property
    def message(self) -> str:
        """What was refused last, until another request is met; else the last result."""
        return self._refusal or self._result

    @message.setter
    def message(self, result: str) -> None:
        self._result, self._refusal = result, ""

    # --- inside -----------------------------------------------------------------------------------------------------

    def _after_substep(self) -> str | None:
        """What is wrong with the frame that is being computed.

        Raises:
            _FrameLeftError: nobody waits for it.
        """
        if self.ends() or self._is_reset_asked.is_set():
            raise _FrameLeftError
        return self._watch.after_substep()

    def _held_by(self, holder: int, kind: str, name: str) -> list[_Held]:
        """What a browser means by a thing: of a cloth, it may be a pin that its mouse got hold of."""
        key = _Held(kind, name, holder)
        if key in self._hands:
            return [key]
        mine = [held for held in self._hands if held.holder == holder and held.kind == "pin"]
        return [held for held in mine if self._pins[int(held.name)].cloth == name] if kind == "cloth" else []

    def _freed(self, key: _Held, *, called: str) -> _Held:
        """The key of a thing that only one browser can hold, after its own hand has let it go.

        Raises:
            ValueError: another browser holds it.
        """
        if any(held[:2] == key[:2] and held.holder != key.holder for held in self._hands):
            raise ValueError(f"another browser holds {called}")
        self._release(key)
        return key

    def _move_hands(self) -> None:
        for hand in self._hands.values():
            hand.move(self.dt)
        if self._hands:
            self.world.tell_couplings()

    def _release(self, key: _Held) -> None:
        if (hand := self._hands.pop(key, None)) is not None:
            hand.release()

    def _nodes_of(self, name: str) -> tuple[NDArray[np.float64], int]:
        """Positions of a cloth's nodes [m], (n, 3), and the number of the first among all nodes."""
        state = self._solvers["cloth"].state
        number = state.names.index(name)
        first, last = state.host.first_node[number : number + 2]
        return state.positions()[first:last], int(first)

    def _job_pins(self) -> list[_JobPin]:
        """All pins, as the job has them."""
        from sim.cloth.start import pins_of

        return [
            _JobPin(cloth.name, nodes, math.inf if pin.release_s is None else pin.release_s)
            for cloth in self.job.cloth
            for pin, nodes in zip(cloth.pin, pins_of(cloth), strict=True)
        ]

    def _moment(self) -> _Moment:
        paths = dict(self._solvers["rigid"].paths) if "rigid" in self._solvers else {}
        return _Moment(self.world.frame, self.world.checkpoint(), paths, dict(self.values))

    def _begin_anew(self, values: Mapping[str, Value]) -> None:
        """Build the scene again, with these values of its knobs, and nothing held; a value that is refused is told.

        Raises:
            ShapeError, ValueError: as `sim.build.build_world`; the world that there was stays as it is.
        """
        self.revision += 1
        if self.on_jump is not None:
            self.on_jump()
        self._build()
        self._hands.clear()  # of the world that was
        self.values = {name: knob.start for name, knob in self.knobs.items()}
        refused = self._turn_all(values)
        if refused:
            self.message = f"{self.message} Not taken over: {'; '.join(refused)}.".lstrip()
        self._begins.clear()

    def _drop(self) -> None:
        """Let the world and all that is of it go, before another is built where there may be no memory for two."""
        del self.world
        self._solvers = {}
        self._hands.clear()
        self._moments.clear()
        gc.collect()

    @contextmanager
    def _or_ended(self) -> Iterator[None]:
        """What is done after `_drop`: there is no scene if it fails. Raises CannotGoOnError then."""
        try:
            yield
        except (MemoryError, RuntimeError, ValueError, OSError, PipelineError) as error:
            if isinstance(error, RuntimeError) and not is_out_of_memory(error):
                raise
            raise CannotGoOnError(f"{self.job.name} cannot begin anew: {describe(error)}") from error

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

    def _go_back(self, what: str, *, remedy: str) -> None:
        """Go back to the newest moment that can be trusted; else to the start with the values of then, and stop.

        Args:
            what: happened, a sentence without its stop.
            remedy: a sentence that follows a space: what may help if nobody turned or held anything; beside `FASTER`,
                what live gave up is not told, as to have it back makes no frame faster.
        """
        now = self.world.frame
        moment = next((each for each in reversed(self._moments) if now - each.frame >= FRAMES_TO_TRUST), None)
        turned = [change for frame, change in self._changes if moment is None or frame >= moment.frame]
        held = dict.fromkeys(f"pin {name}" if kind == "pin" else f'"{name}"' for kind, name, _ in self._hands)
        if turned:
            cause = f"Turned last: {turned[-1]}."
        elif held:
            cause = f"In hand: {', '.join(held)}."
        else:
            cause = "Nothing had been turned."
        self.message = ""
        self._drop()
        with self._or_ended():
            self._begin_anew({} if moment is None else moment.values)
            if moment is not None:
                if "rigid" in self._solvers:
                    self._solvers["rigid"].paths.update(moment.paths)
                self.world.restore(moment.frame, moment.arrays)
                self._moments.append(moment)
        self.is_paused = self.is_paused or moment is None
        began_with = {name: value for name, value in self.values.items() if value == self.knobs[name].start}
        if remedy != FASTER and (pace := told_pace(self._written, began_with)):
            cause += f" {pace} Knobs bring that back{', and so does --as-written' if self._gave_up else ''}."
        elif not (turned or held):
            cause += remedy
        place = "the start, with the values that it had there" if moment is None else f"{self.world.time_s:.2f} s"
        self.message = f"{what}. {cause} Back at {place}. {self.message}".rstrip()


def _require_sound(report: FrameReport) -> None:
    """Blow-ups show as speeds long before they show as values that are no numbers.

    Raises:
        SimulationDivergedError: something is absurdly fast.
    """
    for name, numbers in report.diagnostics.items():
        speed = float(numbers.get("max_speed", 0.0))
        if not speed <= FASTEST:
            raise SimulationDivergedError(name, report.frame, report.time_s, f"something moves at {speed:.3g} m/s")
