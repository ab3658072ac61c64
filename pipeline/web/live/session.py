"""A scene that runs and can be changed; knows nothing of pages. One thread owns it; others ask through its queue."""

import gc
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from pipeline.base.errors import PipelineError
from pipeline.kinds.live_parameters import Parameter, Value
from pipeline.model.job import Job
from pipeline.run.executors.failures import describe, is_out_of_memory
from pipeline.web.live.admission import told_changes
from pipeline.web.live.drags import Drags
from pipeline.web.live.parameters import parameters_of, set_parameter
from pipeline.web.live.requests import CannotGoOnError, Requests
from pipeline.web.live.soundness import (
    FRAMES_BETWEEN,
    LONGEST_FRAME_S,
    Checkpoint,
    Checkpoints,
    FrameTimer,
    require_sound,
)
from sim.core.snapshots import Snapshot
from sim.core.solver import SimulationDivergedError
from sim.core.world import FrameReport

MOST_SUBSTEPS = 2000
"""A frame that needs more counts as blown up, before it has taken long."""

FIRST = "The first frame compiles kernels: up to a minute, once on a machine."
NO_MEMORY = "No memory was left"
MORE_SUBSTEPS = " The job may need more substeps."
FASTER = " --anyway lets frames take as long as they do; fewer substeps or --preview makes them faster."
"""Remedies where nobody changed or dragged anything: against steps that are too long, and against slow frames."""


class _FrameLeftError(Exception):
    """Nobody wants the frame any more that is being computed."""


class Session(Requests):
    """A scene, its parameters, its drags, and its clock.

    All methods but `ask` and `ask_reset` are for the thread that owns the session.

    Attributes:
        revision: grows when the scene or its parameters change in another way than by time and on request.
        job: as it is simulated.
        parameters, values: what can be changed, and its present values, by name.
        drags: everything that browsers hold.
        speed: simulated over wall time that is wanted, 1 for real time.
        report: of the last frame; None before the first.
        frame_ms: wall time of that frame's computation [ms].
        substeps_asked: of that frame, by its cloth, where contacts and bodies may want more; None without a frame or
            without cloth in fixed steps.
        on_frame: called after each frame with its report, as a recording does; None: nobody.
        on_jump: called before time goes back, as a recording cannot; None: nobody.
        ends: asked within frames whether all is over, so that the frame need not be computed to its end.

    Args:
        job: as `live_job` makes it; `sim.core.runtime.initialize` must have run.
        written: the job as it was read, if that differs: after a blow-up it is told how.
        gave_up: whether it was live that changed it for the sake of speed, which --as-written prevents.
        longest_frame_s: a frame that takes longer counts as blown up [s]; infinite where slow frames were asked for.
        clock: tells the time [s].

    Raises ShapeError, ValueError: as `sim.build.build_world`.
    """

    def __init__(
        self,
        job: Job,
        *,
        written: Job | None = None,
        gave_up: bool = False,
        longest_frame_s: float = LONGEST_FRAME_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        super().__init__(FIRST)
        self.job, self._written, self._gave_up = job, written or job, gave_up
        self._clock, self._timer = clock, FrameTimer(longest_frame_s, clock=clock)
        self.parameters: dict[str, Parameter] = {each.name: each for each in parameters_of(job, written=written)}
        self.values: dict[str, Value] = {name: each.start for name, each in self.parameters.items()}
        self.drags = Drags(job)
        self.is_paused = False
        self.speed = 1.0
        self.on_frame: Callable[[FrameReport, Mapping[str, Snapshot]], None] | None = None
        self.on_jump: Callable[[], None] | None = None
        self.ends: Callable[[], bool] = lambda: False
        self.dt = 1.0 / job.fps
        # A grab that is refused is followed by what the mouse does with nothing in hand.
        self.silent = (self.drags.move, self.drags.release, self.drags.release_all)
        self._is_reset_asked = threading.Event()
        self._begins: deque[float] = deque(maxlen=max(10, job.fps))
        self._build()

    def _build(self) -> None:
        from sim.build import build_world

        self.world = build_world(self.job, frames_per_second=self.job.fps)
        self.world.max_substeps_per_frame = MOST_SUBSTEPS
        self.world.watch = self._after_substep
        self.drags.bind(self.world)
        self._changes: list[tuple[int, str]] = []
        self._checkpoints = Checkpoints()
        self.report: FrameReport | None = None
        self.frame_ms = 0.0
        self.substeps_asked: Value | None = None

    def ask_reset(self) -> None:
        """Have all begin anew; a frame that is being computed is left for it."""
        self._is_reset_asked.set()
        self.ask(self.reset)

    # --- the loop ---

    def advance(self) -> None:
        """Compute a frame; after a blow-up, go back to where the scene was sound. Raises CannotGoOnError: no memory."""
        began = self._clock()
        self._begins.append(began)
        what = remedy = ""
        try:
            self.drags.advance(self.dt)
            self._timer.begin_frame()
            report = self.world.advance_frame()
            require_sound(report)
            took_s = self._clock() - began
            bodies = None if self.on_frame is None else self.world.snapshots()
            checkpoint = None if report.frame % FRAMES_BETWEEN else Checkpoint.of(self.world, self.values)
        except _FrameLeftError:
            return
        except SimulationDivergedError as error:
            # Its hint is about keys of a job that are no live parameters.
            remedy = FASTER if self._timer.is_too_slow else MORE_SUBSTEPS
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
        self.clear(FIRST)
        self.frame_ms = 1e3 * took_s
        self.substeps_asked = self.values.get("cloth.substeps")
        if self.on_frame is not None and bodies is not None:
            self.on_frame(report, bodies)
        if checkpoint is not None:
            self._checkpoints.append(checkpoint)

    def free_memory(self, trouble: str) -> None:
        """Go back to where the scene was sound, as there was no memory for something else. Raises CannotGoOnError."""
        self._go_back(f"{NO_MEMORY}: {trouble}", remedy="")

    @property
    def substeps(self) -> Mapping[str, int]:
        """Substeps of the last frame, by solver."""
        return {} if self.report is None else self.report.substeps

    @property
    def real_time(self) -> float:
        """Simulated over wall time in the last second or so; 0 while it is paused."""
        span = self._clock() - self._begins[0] if len(self._begins) > 1 else 0.0
        return 0.0 if self.is_paused or span <= 0.0 else (len(self._begins) - 1) * self.dt / span

    def bodies(self) -> dict[str, Snapshot]:
        """All bodies now; arrays that no later frame changes."""
        return self.world.snapshots()

    # --- requests ---

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
        """Begin anew, with the parameters as they are. Raises CannotGoOnError: there is no memory for it."""
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

    def set(self, name: str, value: object) -> None:
        """Give a parameter another value. Raises ValueError: there is no such parameter, or it cannot have that."""
        if name not in self.parameters:
            raise ValueError(f'nothing is named "{name}"')
        parameter = self.parameters[name]
        wanted, before = parameter.checked(value), self.values[name]
        if wanted == before:
            return
        set_parameter(self.world, self.job, parameter, wanted, before=before)
        self.values[name] = wanted
        self._changes.append((self.world.frame, f"{name} = {wanted}"))

    # --- inside ---

    def _after_substep(self) -> str | None:
        """Fault of the frame that is being computed, if it has any. Raises _FrameLeftError: nobody waits for it."""
        if self.ends() or self._is_reset_asked.is_set():
            raise _FrameLeftError
        return self._timer.after_substep()

    def _begin_anew(self, values: Mapping[str, Value]) -> None:
        """Build the scene again, with nothing held; refused values are told. What cannot be built leaves the old."""
        self.revision += 1
        if self.on_jump is not None:
            self.on_jump()
        self._build()
        self.values = {name: each.start for name, each in self.parameters.items()}
        refused = self._set_all(values)
        if refused:
            self.message = f"{self.message} Not taken over: {'; '.join(refused)}.".lstrip()
        self._begins.clear()

    def _drop(self) -> None:
        """Let the world and all that is of it go, before another is built where there may be no memory for two."""
        del self.world
        self.drags.unbind()
        self._checkpoints.clear()
        gc.collect()

    @contextmanager
    def _or_ended(self) -> Iterator[None]:
        """For building after `_drop`: there is no scene if it fails. Raises CannotGoOnError then."""
        try:
            yield
        except (MemoryError, RuntimeError, ValueError, OSError, PipelineError) as error:
            if isinstance(error, RuntimeError) and not is_out_of_memory(error):
                raise
            raise CannotGoOnError(f"{self.job.name} cannot begin anew: {describe(error)}") from error

    def _set_all(self, values: Mapping[str, Value]) -> list[str]:
        """Set parameters; returns those that were refused, and why.

        Explicit springs bear some values only together, so that one may have to wait for another.
        """
        left, count = dict(values), len(values) + 1
        refused: dict[str, str] = {}
        while left and len(left) < count:
            count, refused = len(left), {}
            for name, value in list(left.items()):
                try:
                    self.set(name, value)
                    del left[name]
                except ValueError as error:
                    refused[name] = f"{name} = {value} ({error})"
        return list(refused.values())

    def _go_back(self, what: str, *, remedy: str) -> None:
        """Go back to the newest checkpoint that can be trusted; else to the start with the values of then, and stop.

        The message tells `what` happened; where nobody changed or dragged anything, it adds the `remedy`. Beside
        `FASTER`, the changes of live are not told, as to take them back makes no frame faster.
        """
        now = self.world.frame
        checkpoint = self._checkpoints.trusted(now)
        changed = [change for frame, change in self._changes if checkpoint is None or frame >= checkpoint.frame]
        held = self.drags.names
        if changed:
            cause = f"Changed last: {changed[-1]}."
        elif held:
            cause = f"In hand: {', '.join(held)}."
        else:
            cause = "Nothing had been changed."
        self.message = ""
        self._drop()
        with self._or_ended():
            self._begin_anew({} if checkpoint is None else checkpoint.values)
            if checkpoint is not None:
                checkpoint.restore(self.world)
                self._checkpoints.append(checkpoint)
        self.is_paused = self.is_paused or checkpoint is None
        began_with = {name: value for name, value in self.values.items() if value == self.parameters[name].start}
        if remedy != FASTER and (told := told_changes(self._written, began_with)):
            cause += f" {told} The controls take that back{', and so does --as-written' if self._gave_up else ''}."
        elif not (changed or held):
            cause += remedy
        place = "the start, with its values" if checkpoint is None else f"{self.world.time_s:.2f} s"
        self.message = f"{what}. {cause} Back at {place}. {self.message}".rstrip()
