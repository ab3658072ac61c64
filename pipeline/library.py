"""The program as a library: jobs made in Python, scenes stepped in this process, jobs submitted and waited for.

`import pipeline` has these names without loading anything; docs/guide/library.md shows them at work.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import LoadedJob, make_job
from pipeline.kinds.table import world_of
from pipeline.model.problems import unknown_name
from pipeline.queue.submitting import QueueOptions
from pipeline.queue.submitting import submit as submit_to_queue
from pipeline.run.checked_job import read_own_job
from pipeline.store.cache import CachedFrame, read_frame, write_frame
from sim.core.runtime import initialize
from sim.core.snapshots import Snapshot
from sim.core.solver import HasViews, Solver, TakesPushes
from sim.core.world import FrameReport

__all__ = ["Scene", "Submission", "make_job", "read_frame", "read_job", "submit"]

Acting = Callable[[Mapping[str, NDArray[Any]], float], ArrayLike]
Force = Acting | ArrayLike
"""Force per mass [m/s²] on a body: (3,), or a function of its arrays and the time [s] that returns (3,), or (n, 3) in
the order of the arrays."""


def read_job(path: Path | str, *changes: str, preview: bool = False) -> LoadedJob:
    """The job in a file.

    Args:
        path: the job file.
        changes: keys with other values, as after `--set`: `"fluid.water.viscosity=0.1"`.
        preview: whether it becomes the fast, small version of the job.

    Raises:
        JobFileError: carries every problem found; also where the file names a program to be run and `changes` do not.
    """
    return read_own_job(path, changes, preview=preview)


class Scene:
    """A job's bodies, simulated in this process, frame by frame; as `pipeline submit` would, to the bit.

    A process has one device: scenes after the first one share it.

    Attributes:
        job: what is simulated.
        device: where: `"cpu"`, `"cuda"`, ...
        world: the loop over the solvers (`sim.core.world.World`): checkpoints, `watch` after each substep.
        report: numbers of the frame that was reached last (`FrameReport`): substeps, and each solver's diagnostics.

    Args:
        job: of `make_job` or `read_job`.
        threads: of a CPU; all that there are if omitted.

    Raises:
        DeviceUnavailableError: the job's device does not work here.
        ShapeError, ValueError: a body cannot be built, or cannot start as described.
    """

    def __init__(self, job: LoadedJob, *, threads: int | None = None) -> None:
        self.job = job.job
        self.device = initialize(self.job.device, threads=threads)
        self.world = world_of(self.job)
        self.report = FrameReport(0, 0.0, {}, {}, self.world.diagnostics())
        self._forces: list[tuple[str, str, Acting]] = []  # the solver's name, the body's, the force

    @property
    def frame(self) -> int:
        """The frame that was reached last; 0 is the start."""
        return self.world.frame

    @property
    def time_s(self) -> float:
        """Simulated time [s]."""
        return self.world.time_s

    def step(self) -> FrameReport:
        """Advance to the next frame.

        Raises:
            SimulationDivergedError: the state became unphysical.
        """
        self.report = self.world.advance_frame()
        return self.report

    def frames(self, count: int | None = None) -> Iterator[FrameReport]:
        """Step so many times, or to the job's last frame if omitted, and stop at each frame."""
        for _ in range(self.job.frame_count - 1 - self.frame if count is None else count):
            yield self.step()

    def bodies(self) -> dict[str, Snapshot]:
        """Every body now, by name: its arrays as the cache keeps them, copied, and good for ever."""
        return self.world.snapshots()

    def view(self, body: str) -> Mapping[str, NDArray[Any]]:
        """Arrays of a body now, good until the next step, not copied where that can be.

        On a CPU they are the solver's own memory, but for rigid bodies, which are a few numbers, and fluids that share
        a tank. On a GPU they are copies. They cannot be written to: forces change a scene.

        - fluid: `position` [m], `velocity` [m/s], (n, 3); `particle_id` (n,); in the solver's order, which changes
        - cloth: `position` [m], `velocity` [m/s], (n, 3), in the order of the snapshot
        - rigid: `position`, `orientation`, `velocity`, `angular_velocity`, as in the snapshot; of a group, by its name,
          those of all its bodies, (n, 3) and (n, 4); of one that a file animates its mesh, too
        - smoke: `density` [-], `excess_temperature` [K], (nx, ny, nz)

        Raises:
            ValueError: there is no such body, or its solver lets nobody look.
        """
        if names := self._names_in(body):
            there = self.bodies()
            return {key: np.stack([there[name].arrays[key] for name in names]) for key in there[names[0]].arrays}
        solver = self._solver_of(body)
        if solver is None:
            return self.bodies()[body].arrays
        if isinstance(solver, HasViews):
            arrays = solver.view(body)
            for array in arrays.values():
                array.flags.writeable = False
            return arrays
        raise ValueError(f'the solver of "{body}" has no views; bodies() has its arrays, copied')

    def add_force(self, body: str, force: Force) -> None:
        """Let a force act on a fluid, a cloth or a dynamic rigid body from now on, beside all that act already.

        Before each substep of dt [s] velocities change by dt times the force per mass at that moment, to first order in
        dt. Forces of several calls add up. Steps are chosen without it: one that accelerates far beyond gravity wants a
        smaller `cfl` or more `substeps`. What pins and keyframes lead, no force moves. Rigid bodies are pushed at their
        centre of mass. No checkpoint and no submitted job knows of it.

        Args:
            body: its name, or that of a group, on each body of which it acts.
            force: force per mass [m/s²], (3,), or a function of the body's arrays (`view`) and the time at which the
                frame starts [s] that returns it, (3,) or (n, 3) in the order of the arrays.

        Raises:
            ValueError: there is no such body, nothing can push it (it is static, kinematic, or smoke), or a force that
                is no function has another shape.
        """
        if names := self._names_in(body):
            for name in names:
                self.add_force(name, force)
            return
        solver = self._solver_of(body)
        if isinstance(solver, TakesPushes):
            solver.push(body, np.zeros(3))  # refuses what keyframes lead
            if not callable(force):
                constant = np.broadcast_to(np.asarray(force, dtype=np.float64), (3,))
                self._forces.append((solver.name, body, lambda _arrays, _time: constant))
            else:
                self._forces.append((solver.name, body, force))
            self.world.before_substep = self._push
            return
        why = "it stands still" if solver is None else "its solver takes no forces from outside"
        raise ValueError(f'no force can act on "{body}": {why}')

    def write(self, path: Path | str) -> None:
        """Write the present frame to a file of the cache format (docs/guide/cache-format.md), as the simulation does.

        Raises:
            OSError: it cannot be written.
        """
        write_frame(Path(path), self.bodies(), self.report, device=self.device, longest_shutter_s=1.0 / self.job.fps)

    def _solver_of(self, body: str) -> Solver | None:
        """The solver of a body; None for one that never moves. Raises ValueError: there is no such body."""
        if body not in self._solvers:
            raise ValueError(unknown_name(body, self._solvers, "body", plural="bodies"))
        return self._solvers[body]

    def _names_in(self, group: str) -> list[str]:
        """Names of the bodies of a group; none if nothing is called so."""
        return [name for name, of in self.job.groups.items() if of == group]

    @cached_property
    def _solvers(self) -> dict[str, Solver | None]:
        moving = {body: solver for solver in self.world.solvers.values() for body in solver.snapshots()}
        return {**dict.fromkeys(self.bodies()), **moving}

    def _push(self, solver_name: str, dt: float) -> None:
        solver = self.world.solvers[solver_name]
        for name, body, force in self._forces:
            if name == solver_name and isinstance(solver, TakesPushes):
                pushed = np.asarray(force(self.view(body), self.time_s), dtype=np.float64)
                if not np.isfinite(pushed).all():
                    raise ValueError(f'the force on "{body}" at {self.time_s:g} s is not finite')
                solver.push(body, dt * pushed)


@dataclass(frozen=True)
class Submission:
    """A job in its folder, submitted: runs, waits, or is done."""

    job: LoadedJob
    folder: Path
    """The job's folder, with cache, surfaces, frames and film."""

    @property
    def film(self) -> Path:
        """Where the film is, once it is there."""
        return JobLayout(self.folder).film

    def frame(self, number: int) -> CachedFrame:
        """A simulated frame: its bodies with their arrays, as `read_frame`.

        Raises:
            InvalidArtifactError: it is not there yet, or damaged.
        """
        layout = JobLayout(self.folder)
        return read_frame(layout.path(layout.frame_cache(number)))

    def wait(self) -> Submission:
        """Wait until it is done, with its progress on standard error. Ctrl-C ends the waiting, not the job.

        Raises:
            PipelineError: it failed, was paused or cancelled, or nobody runs the queue any more.
            KeyboardInterrupt: after Ctrl-C.
        """
        from pipeline.queue.following import CTRL_C, Follower, watch
        from pipeline.queue.job_queue import JobQueue

        layout = JobLayout(self.folder)
        queue = JobQueue.of(layout)
        entry = queue.find(self.folder.name)
        code = watch(layout) if entry is None else Follower(queue, layout, submission=entry.submission).follow()
        if code == CTRL_C:
            raise KeyboardInterrupt
        if code != 0:
            how = "waits, and nobody runs its queue" if code is None else "has not come to its end"
            raise PipelineError(f"{self.folder} {how}; see: pipeline status {self.folder}")
        return self


def submit(
    job: LoadedJob, *, output: Path | str = "renders", until: Sequence[str] = (), cores: int | None = None
) -> Submission:
    """Submit a job as `pipeline submit --detach`: it runs in processes of its own, and goes on without this one.

    Submitted again, it continues; what is done is not done twice. What the command prints goes to standard error.

    Args:
        job: of `make_job` or `read_job`.
        output: the folder that holds jobs' folders.
        until: stages after which it ends: `["simulate"]` for data alone; the film if omitted.
        cores: how many processor cores it uses at most; all if omitted.

    Raises:
        JobFileError: carries every problem that the check of the whole job found.
        PipelineError: the folder cannot be written to, or a stage cannot run on this machine.
    """
    layout = JobLayout(Path(output).absolute() / job.job.name)
    with redirect_stdout(sys.stderr):
        code = submit_to_queue(job, layout, options=QueueOptions(detach=True, cores=cores), until=tuple(until))
    if code != 0:
        raise PipelineError(f"{layout.root} could not be queued; see: pipeline status {layout.root}")
    return Submission(job, layout.root)
