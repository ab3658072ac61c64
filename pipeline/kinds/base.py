"""Kinds of bodies: the type of a row of the table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.parameters import MaterialParameters
from sim.core.parameters import Parameters
from sim.core.solver import Solver
from sim.scene import SceneParameters
from sim.shapes.parameters import Placement

if TYPE_CHECKING:
    import h5py

    from pipeline.base.layout import JobLayout
    from render.bounds import Reach
    from render.spec import SceneObject
    from sim.core.snapshots import Snapshot
    from sim.shapes import PlacedSolid

Solids = Mapping[KeyPath, "PlacedSolid"]
"""Shapes of a job that can be built, by the path of their table."""

Change = tuple[KeyPath, object]
"""A key of the job file, and another value for it."""


Materials = Callable[[str], MaterialParameters]
"""What a part of a body looks like, by the name of the part."""


class Codec(Protocol):
    """Codec of bodies that the cache does not keep array by array as they are."""

    def write(self, group: h5py.Group, name: str, snapshot: Snapshot, *, longest_shutter_s: float) -> None:
        """Write the arrays of a body into its group.

        Args:
            group: the body's.
            name: of the body, for errors.
            snapshot: the body.
            longest_shutter_s: the longest time that any shutter is open [s]; what no picture shows may be left out.
        """

    def read(self, group: h5py.Group) -> Any:
        """A body as the kind's product is made of it."""

    def sparse(self, group: h5py.Group) -> Mapping[str, Iterable[Any]]:
        """Datasets whose files may be far smaller than they are, with selections that hold all that is there of them.

        Raises:
            InvalidArtifactError: they are none that `write` writes.
        """


@dataclass(frozen=True, kw_only=True)
class Product:
    """The file that a stage makes of a body of this kind in each frame, for the renderer.

    Attributes:
        stage: name of the stage, and the first part of its tasks' names.
        version: raised when the same cache gives another file.
        folder: of the files in the job's folder.
        suffix: of the files.
        tools: version of each package that does the work.
        parameters: what decides the file besides the cache.
        memory_bytes: what a task takes.
        preflight: why this machine cannot make it, a sentence each.
        write: makes the file of a body; `threads` are what it may use.
        validate: decodes the file; raises InvalidArtifactError.
        file_bytes: about the size of a file by the number of the body's elements.
    """

    stage: str
    version: int
    folder: str
    suffix: str
    tools: Callable[[Job], Mapping[str, str]]
    parameters: Callable[[Job], Mapping[str, Any]]
    memory_bytes: Callable[[Job, Any], int]
    write: Callable[[Path, Any, Job, int], None]
    validate: Callable[[Path], None]
    file_bytes: Callable[[float], float]
    preflight: Callable[[], list[str]] = list


def _none_of_each(_job: Job, _index: int) -> Iterator[tuple[KeyPath, Placement]]:
    return iter(())


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of body.

    Attributes:
        name: of its tables in the job file, `[[name]]`, and of its snapshots.
        parameters: what a table of it says.
        about: what the reference says of the table.
        size: how many elements the bodies of a job have, for people: "about {:,} particles".
        elements: about how many of these a body has at most.
        snapshot_bytes: what a snapshot or a checkpoint takes, by the number of elements: in memory, in a frame of the
            cache, and in a checkpoint.
        wears: the kind whose looks its bodies can have (`blender_scripts.look_table`).
        material: materials of the parts of a body, itself first, where the job does not say.
        placements: the solids that its tables place, each with the path of its table below the body's.
        check: looks at all bodies of the kind; returns the number of their elements.
        coarser: changes that make the bodies coarser by a factor, for a preview; the last argument says whether the
            shapes of the job can be built at all.
        solvers: its solvers in a scene, at so many frames a second; None for the kinds that `sim.build` couples.
        codec: how the cache keeps it.
        product: the file that is made of each frame; None if the renderer needs none but the cached frame.
        objects: what the renderer draws of a body.
        reach: how far a body reaches in a frame, from its group of the cache; None where there is nothing of it.
        reach_bytes: what finding that takes, by the number of elements.
        facts: a body in a few words, for the report; the number of its elements in the last frame, if that is known.
    """

    name: str
    parameters: type[Parameters]
    about: str
    size: str = ""
    elements: Callable[[Job, Any], float] = lambda _job, _body: 0.0
    snapshot_bytes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wears: str = "rigid"
    material: Callable[[Any], Mapping[str, MaterialParameters]]
    placements: Callable[[Job, int], Iterator[tuple[KeyPath, Placement]]] = _none_of_each
    check: Callable[[Job, Solids, MemoryBudget, Findings], int]
    coarser: Callable[[Job, float, bool], Sequence[Change]] = lambda _job, _factor, _can_be_built: ()
    solvers: Callable[[SceneParameters, float], Sequence[Solver]] | None = None
    codec: Codec | None = None
    product: Product | None = None
    objects: Callable[[Job, JobLayout, Any, Materials], Iterator[SceneObject]]
    reach: Callable[[Job, JobLayout, Any, h5py.Group], Reach | None]
    reach_bytes: float = 0.0
    facts: Callable[[Any, float | None], str] = lambda _body, _count: ""

    def bodies(self, job: SceneParameters) -> Sequence[Any]:
        """The job's bodies of this kind, in the order of the file."""
        bodies: Sequence[Any] = getattr(job, self.name)
        return bodies
