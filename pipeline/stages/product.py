"""The stages that make one file of each body of a kind and frame: surfaces, cloths, volumes."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Resources, Task, TaskId
from pipeline.kinds.base import Kind, Product, Work
from pipeline.model.job import Job
from pipeline.stages.base import FILE_S, FileWork, Stage, TaskContext
from pipeline.store.cache import read_compact


class ProductStage(Stage):
    """One file a body and frame, each from that frame of the cache, and of what the product reads beside it."""

    def __init__(self, kind: Kind, product: Product) -> None:
        self.name, self.about, self.version = product.stage, product.about, product.version
        self._kind, self._product = kind, product

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a body and frame."""
        product = self._product
        bodies = self._bodies(job)
        if not bodies:
            return []
        tools = product.tools(job)
        return [
            Task(
                id=TaskId(f"{self.name}/{body.name}/{frame:06d}"),
                stage=self.name,
                inputs=(layout.frame_cache(frame), *product.also_reads(body.name, frame)),
                outputs=(layout.product(product.folder, body.name, frame, product.suffix),),
                parameters=parameters,
                subject=body.name,
                frame=frame,
                resources=resources,
            )
            for body in bodies
            for resources in (Resources(memory_bytes=product.memory_bytes(job, body)),)
            for parameters in (
                ParameterSet.of(product.parameters(job, body), stage=self.name, version=self.version, tools=tools),
            )
            for frame in range(job.frame_count)
        ]

    def _bodies(self, job: Job) -> list[Any]:
        return [body for body in self._kind.bodies(job) if self._product.of(body)]

    def preflight(self, job: Job) -> list[str]:
        """What this machine lacks to make the files, if there are any to make."""
        return self._product.preflight() if self._bodies(job) else []

    def lighter(self, job: Job) -> str:  # noqa: ARG002
        """What the kind says."""
        return self._kind.lighter

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """The mean of what the kind says of each body with the mean number of elements."""
        bodies, product = self._bodies(job), self._product
        share = 1.0 / max(1, len(bodies))
        work = Work(0.0, FILE_S)
        for body in bodies:
            own = product.work(job, body, share * elements.get(self._kind.name, 0.0))
            work = work.plus(Work(share * own.shared_s, share * own.host_s))
        names = {product.work_name(body) or self._kind.name for body in bodies}
        return FileWork("+".join(sorted(names)), work)

    def run(self, context: TaskContext) -> None:
        """Make the file of one body and frame."""
        task = context.task
        cached = context.layout.path(task.inputs[0])
        body = read_compact(cached, task.subject)
        for further in task.inputs[1:]:
            found = read_compact(context.layout.path(further), task.subject)
            body = replace(
                body, arrays={**body.arrays, **found.arrays}, attributes={**body.attributes, **found.attributes}
            )
        with context.committing(task.outputs[0], self._product.validate) as path:
            try:
                self._product.write(path, body, context.job, context.threads)
            except InvalidArtifactError as error:
                raise InvalidArtifactError(f'{cached}: {self._kind.name} "{task.subject}": {error}') from error
        context.progress(1, 1)
