"""Cost of a job before its first run: time, disk space and memory, on this machine and on its GPU.

Each stage says what a file of it takes on a reference machine; `pipeline.run.rates` knows how fast this one is, and
what runs before this one have taught. Files of a job that was begun count by what its own have taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from pipeline.base import wording
from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.resources import machine_capacity
from pipeline.base.task import FailureKind, Resources, Task, TaskId
from pipeline.kinds.table import KINDS
from pipeline.model.gpus import gpu_count
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from pipeline.queue import disk
from pipeline.record.reader import StageCost
from pipeline.run.events import Committed, Failed, Finished, RunEvent, RunStarted
from pipeline.run.plan import Assessment, Verdict
from pipeline.run.rates import MachineRates, known_rates, learn, measure
from pipeline.stages.base import FileWork
from pipeline.store.cache import open_bodies

START_S = 5.0
"""Time of a run's own start and end, workers' included [s]."""
SPREAD = 1.6
"""How far off work may be that was never measured on this machine, either way [-]."""
LONG_S = 24 * 3600.0
"""A job that takes longer is worth a warning."""
LEAST_TAUGHT_S = 5.0
"""Work that is expected to take less teaches little but how long a start takes [s]."""


class StageExpectation(NamedTuple):
    """What the files of a stage that are to be made will take."""

    stage: str
    files: int
    seconds: float  # one after the other [s]
    bytes: float  # of disk space
    memory_bytes: float  # of all its tasks at a time
    is_measured: bool  # whether this work was measured on this machine
    on_gpu: bool
    occupies_s: float  # time of the whole machine that it takes [s]
    longest_s: float  # of tasks that wait for each other [s]


@dataclass(frozen=True)
class Expectation:
    """What a job will take, or what is left of it."""

    stages: tuple[StageExpectation, ...]
    disk_bytes: float

    @property
    def seconds(self) -> float:
        """Time until its end [s]."""
        if not self.stages:
            return 0.0
        alone = sum(each.occupies_s for each in self.stages if not each.on_gpu)
        of_gpus = sum(each.occupies_s for each in self.stages if each.on_gpu)
        longest = max(each.longest_s for each in self.stages)
        return START_S + max(alone, of_gpus, longest)

    @property
    def memory_bytes(self) -> float:
        """The most of any moment."""
        return max((each.memory_bytes for each in self.stages), default=0.0)

    @property
    def is_measured(self) -> bool:
        """Whether most of the time is of work that was measured on this machine."""
        known = sum(each.seconds for each in self.stages if each.is_measured)
        return 2.0 * known >= sum(each.seconds for each in self.stages)

    @property
    def on_gpu(self) -> bool:
        """Whether a GPU does some of it."""
        return any(each.on_gpu for each in self.stages)

    @property
    def time_text(self) -> str:
        """`about 9 min`, or `3 to 8 min` where nothing like it was measured on this machine."""
        if self.is_measured:
            return f"about {wording.rough_duration(self.seconds)}"
        low, high = (wording.rough_duration(each) for each in (self.seconds / SPREAD, self.seconds * SPREAD))
        return f"{low} to {high}"


@dataclass(frozen=True)
class Costs:
    """What is needed to tell what a job costs on this machine."""

    rates: MachineRates
    capacity: Resources  # what its tasks may use at a time


def costs_here(job: Job, *, draws: bool, cores: int | None = None, say: Callable[[str], None]) -> Costs:
    """What this machine offers a job, which draws pictures or not; measured now, and said so, at first use."""
    rates = known_rates()
    if rates is None:
        rates = measure()
        say(
            f"measured this machine once: {wording.counted(rates.cores, 'core')}, together as fast as "
            f"{rates.all_cores:.1f} of the machine that estimates begin with; each run makes them better"
        )
    capacity = machine_capacity(gpus=gpu_count(job, draws=draws))
    return Costs(rates, capacity if cores is None else replace(capacity, cores=min(cores, capacity.cores)))


def both_ways(
    job: Job,
    assessments: Sequence[Assessment],
    size: disk.Size,
    costs: Costs,
    own: Mapping[str, StageCost] | None = None,
) -> tuple[Expectation, Expectation | None]:
    """What a job will take, and what it would take without the GPU that it runs on; None where it runs on none."""
    expected = expect(job, assessments, size, costs, own)
    return expected, expect(job, assessments, size, costs, own, without_gpu=True) if expected.on_gpu else None


def expect(
    job: Job,
    assessments: Sequence[Assessment],
    size: disk.Size,
    costs: Costs,
    own: Mapping[str, StageCost] | None = None,
    *,
    without_gpu: bool = False,
) -> Expectation:
    """What the files that are to be made will take.

    Args:
        size: what decides how large they are; its elements are those of each kind of body.
        own: what the same stages have taken in this job, where some of their files are of the job as it is now.
        without_gpu: as if the machine had no GPU.
    """
    stages = tuple(_of_stages(job, assessments, size, costs, own or {}, without_gpu=without_gpu))
    checkpoints = disk.checkpoint_bytes(size) if any(each.stage == "simulate" for each in stages) else 0.0
    return Expectation(stages, sum(each.bytes for each in stages) + checkpoints)


def _of_stages(
    job: Job,
    assessments: Sequence[Assessment],
    size: disk.Size,
    costs: Costs,
    own: Mapping[str, StageCost],
    *,
    without_gpu: bool,
) -> Iterator[StageExpectation]:
    from pipeline.stages import STAGES

    todo: dict[str, list[Assessment]] = {}
    for each in assessments:
        if each.rebuilds:
            todo.setdefault(each.task.stage, []).append(each)
    current = _current_stages(assessments)
    for stage in STAGES:
        theirs = todo.get(stage.name)
        if not theirs or (job.recorded is not None and theirs[0].task.checkpointed):
            continue  # nothing computes a recording's frames
        first = theirs[0].task
        on_gpu = first.resources.gpus > 0 and not without_gpu
        gpus = max(1, costs.capacity.gpus)
        cores = _cores_of(first, costs.capacity, on_gpu=on_gpu)
        work = stage.work(job, size.elements, on_gpu=on_gpu)
        name = work_name(stage.name, work, on_gpu=on_gpu)
        files = sum(len(each.rebuilds) for each in theirs)
        cost = own.get(stage.name) if stage.name in current else None
        factors = costs.rates.factors(name)
        each_bytes = factors.bytes * disk.bytes_per_artifact(stage.name, size)
        if cost is not None and cost.seconds_per_artifact > 0.0:
            seconds = files * cost.seconds_per_artifact
        else:
            seconds = factors.time * _seconds(work, files, cores, costs.rates, on_gpu=on_gpu)
            if not costs.rates.is_known(name):
                seconds += work.compiling_s / costs.rates.one_core
        at_once = max(1, min(len(theirs), gpus if on_gpu else costs.capacity.cores // max(1, cores)))
        memory = (work.memory_bytes or float(first.resources.memory_bytes)) * factors.memory
        yield StageExpectation(
            stage=stage.name,
            files=files,
            seconds=seconds,
            bytes=files * (each_bytes if cost is None else cost.bytes_per_artifact),
            memory_bytes=at_once * memory,
            is_measured=cost is not None or costs.rates.is_known(name),
            on_gpu=on_gpu,
            occupies_s=seconds / gpus if on_gpu else seconds * cores / costs.capacity.cores,
            longest_s=seconds if _is_chain(theirs) else 0.0,
        )


def work_name(stage: str, work: FileWork, *, on_gpu: bool) -> str:
    """What a stage's work is called in a machine's rates."""
    return f"{stage}:{'gpu' if on_gpu else 'cpu'}:{work.what}"


def _seconds(work: FileWork, files: int, cores: int, rates: MachineRates, *, on_gpu: bool) -> float:
    """Time of so many files one after the other, on so many cores each, without what was learnt of them [s]."""
    shared = work.work.shared_s if on_gpu else work.work.shared_s / rates.shared_speed(cores)
    return work.start_s / rates.one_core + files * (shared + work.work.host_s / rates.one_core)


def _cores_of(task: Task, capacity: Resources, *, on_gpu: bool) -> int:
    """Cores that a task takes: a long one all of them where there is no GPU for it."""
    asked = 0 if task.checkpointed and not on_gpu else task.resources.cores
    return min(asked or capacity.cores, capacity.cores)


def _current_stages(assessments: Iterable[Assessment]) -> frozenset[str]:
    """Stages of which there are files that are of the job as it is now."""
    return frozenset(
        each.task.stage
        for each in assessments
        if each.verdict is Verdict.UP_TO_DATE or len(each.rebuilds) < len(each.task.outputs)
    )


def _is_chain(assessments: Sequence[Assessment]) -> bool:
    """Whether each task waits for the one before: one task for all, or files that are made from those before them."""
    if len(assessments) == 1:
        return True
    made = {output for each in assessments for output in each.task.outputs}
    second = assessments[1].task
    return any(artifact in made for artifact in second.inputs)


def describe(expected: Expectation, without_gpu: Expectation | None) -> str:
    """A line: time, disk space and memory; `without_gpu` is what the job would take with no GPU, if it has one."""
    rest = f"{wording.size(expected.disk_bytes)} of disk, {wording.size(expected.memory_bytes)} of memory"
    if without_gpu is None or not expected.on_gpu:
        return f"{expected.time_text}, {rest}"
    return f"{without_gpu.time_text} on the processor, {rest}; on the GPU {expected.time_text}"


def too_long(expected: Expectation, job: Job) -> str | None:
    """A warning of a job that takes days, with what would make it shorter; None of others."""
    from pipeline.stages import STAGES

    if expected.seconds <= LONG_S:
        return None
    slowest = max(expected.stages, key=lambda each: each.occupies_s)
    lighter = next(stage for stage in STAGES if stage.name == slowest.stage).lighter(job)
    remedy = f"; less is needed with {lighter}, or --preview" if lighter else "; see --preview"
    where = "" if expected.on_gpu else ", and would on a GPU be done sooner"
    took = wording.rough_duration(expected.seconds)
    return f"this takes about {took} here, most of it to {slowest.stage}{where}{remedy}"


class Teacher:
    """Observer of a run on this machine, which learns from it how fast the machine is."""

    def __init__(self, job: Job, layout: JobLayout, costs: Costs) -> None:
        self._job, self._layout, self._costs = job, layout, costs
        self._tasks: dict[TaskId, Task] = {}
        self._files: dict[TaskId, int] = {}
        self._bytes: dict[TaskId, int] = {}
        self._took: dict[TaskId, float] = {}
        self._peaks: dict[TaskId, int] = {}

    def notify(self, event: RunEvent) -> None:
        """Take note of what is committed, and of how long it took."""
        match event:
            case RunStarted(assessments):
                self._tasks = {each.task.id: each.task for each in assessments}
            case Committed(task_id, _, receipt):
                self._files[task_id] = self._files.get(task_id, 0) + 1
                self._bytes[task_id] = self._bytes.get(task_id, 0) + receipt.size
            case Finished(task_id, _, seconds, peak):
                self._end(task_id, seconds, peak)
            case Failed(task_id, _, FailureKind.CANCELLED, _, _, seconds, peak):
                self._end(task_id, seconds, peak)
            case _:
                return

    def _end(self, task_id: TaskId, seconds: float, peak: int) -> None:
        self._took[task_id] = self._took.get(task_id, 0.0) + seconds
        self._peaks[task_id] = max(peak, self._peaks.get(task_id, 0))

    def teach(self) -> None:
        """Keep what was learnt, beside what other runs have learnt meanwhile; nothing of a job without a frame."""
        elements = self.elements()
        if elements is not None and self._took:
            size = disk.size_of(self._job, Findings(elements=elements))
            learn(lambda rates: self._taught(rates, size))

    def elements(self) -> dict[str, int] | None:
        """Of each kind of body, as the last frame has them; as the kind counts them where the cache keeps no arrays."""
        frames = sorted(self._layout.path(self._layout.frame_cache(0)).parent.glob("[0-9]*.h5"))
        if not frames:
            return None
        counts = dict.fromkeys(KINDS, 0)
        try:
            with open_bodies(frames[-1]) as groups:
                for group in groups.values():
                    if "position" in group and group["position"].ndim == 2:
                        counts[str(group.attrs["kind"])] += len(group["position"])
        except InvalidArtifactError:
            return None
        for name, kind in KINDS.items():
            counts[name] = counts[name] or round(sum(kind.elements(self._job, body) for body in kind.bodies(self._job)))
        return counts

    def _taught(self, rates: MachineRates, size: disk.Size) -> MachineRates:
        from pipeline.stages import STAGES

        for stage in STAGES:
            ended = [self._tasks[each] for each in self._took if self._tasks[each].stage == stage.name]
            files = sum(self._files.get(task.id, 0) for task in ended)
            seconds = sum(self._took[task.id] for task in ended)
            if not files:
                continue
            first = ended[0]
            on_gpu = first.resources.gpus > 0
            cores = _cores_of(first, self._costs.capacity, on_gpu=on_gpu)
            work = stage.work(self._job, size.elements, on_gpu=on_gpu)
            name = work_name(stage.name, work, on_gpu=on_gpu)
            usual = _seconds(work, files, cores, rates, on_gpu=on_gpu)
            if usual - work.start_s / rates.one_core < LEAST_TAUGHT_S:
                continue
            if 0.0 < work.work.shared_s < work.work.host_s:
                continue  # tiny pictures and scenes are overhead, which says nothing of large ones
            if not rates.is_known(name):
                seconds = max(0.2 * seconds, seconds - work.compiling_s / rates.one_core)
            written = disk.bytes_per_artifact(stage.name, size) * files
            memory = work.memory_bytes or float(first.resources.memory_bytes)
            peak = max(self._peaks[task.id] for task in ended)
            rates = rates.taught(
                name,
                time=seconds / usual if usual else 0.0,
                size=sum(self._bytes.get(task.id, 0) for task in ended) / written if written else 0.0,
                memory=peak / memory if memory else 0.0,
            )
        return rates
