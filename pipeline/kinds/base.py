"""Kinds of bodies: the type of a row of the table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import dist
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.live_parameters import LiveParameters
from pipeline.model.boxes import Box
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.bounds import Reach
from render.parameters import MaterialParameters
from render.spec import SceneObject
from sim.core.parameters import Parameters
from sim.core.snapshots import Snapshot
from sim.core.solver import Solver
from sim.scene import SceneParameters
from sim.shapes.parameters import Placement

if TYPE_CHECKING:
    import h5py

    from sim.shapes.placement import PlacedSolid

Solids = Mapping[KeyPath, "PlacedSolid"]
"""Shapes of a job that can be built, by the path of their table."""

SolidBuilder = Callable[[], Solids]

Change = tuple[KeyPath, object]
"""A key of the job file, and another value for it."""

Materials = Callable[[str], MaterialParameters]
"""Material of a part of a body, by the name of the part."""


class Work(NamedTuple):
    """Work of a frame, or of one file."""

    shared_s: float = 0.0  # of one core, that several share; or of the GPU [s]
    host_s: float = 0.0  # of one core, that no other takes part in, such as launches [s]

    def plus(self, other: Work) -> Work:
        """One after the other."""
        return Work(self.shared_s + other.shared_s, self.host_s + other.host_s)


FrameWork = Callable[[Job, float, bool], Work]
"""Work of a frame of all bodies of a kind, by the number of their elements, on a GPU or not."""


class Codec(Protocol):
    """Codec of bodies that the cache does not keep array by array as they are."""

    def write(self, group: h5py.Group, name: str, snapshot: Snapshot, *, longest_shutter_s: float) -> None:
        """Write the arrays of a body into its group; what no shutter of this length [s] shows may be left out."""

    def read(self, group: h5py.Group) -> Any:
        """A body as the kind's product is made of it."""

    def sparse(self, group: h5py.Group) -> Mapping[str, Iterable[Any]]:
        """Datasets that are larger than what is stored of them, each with selections that hold all that is stored."""


@dataclass(frozen=True, kw_only=True)
class Product:
    """The file that a stage makes of a body of this kind in each frame, for the renderer."""

    stage: str  # name of the stage, and the first part of its tasks' names
    version: int  # raised when the same cache gives another file
    of: Callable[[Any], bool] = lambda _body: True  # whether it is made of a body
    folder: str  # of the files in the job's folder
    suffix: str  # of the files
    tools: Callable[[Job], Mapping[str, str]]  # version of each package that does the work
    # what decides the file of a body besides the cache
    parameters: Callable[[Job, Any], Mapping[str, Any]] = lambda _job, _body: {}
    memory_bytes: Callable[[Job, Any], int]  # memory of a task
    write: Callable[[Path, Any, Job, int], None]  # makes the file of a body, with so many threads
    validate: Callable[[Path], None]  # decodes the file; raises InvalidArtifactError
    # files of the body and frame that hold further arrays of it, in the format of the cache
    also_reads: Callable[[str, int], tuple[ArtifactPath, ...]] = lambda _body, _frame: ()
    file_bytes: Callable[[Any, float], float]  # about the size of a body's file by the number of its elements
    about: str = ""  # what they are, in a few words for people
    # work of the file of a job's body of so many elements, and what that is called where bodies differ in it
    work: Callable[[Job, Any, float], Work] = lambda _job, _body, _elements: Work()
    work_name: Callable[[Any], str] = lambda _body: ""
    preflight: Callable[[], list[str]] = list  # why this machine cannot make it, a sentence each

    def file_of(self, body: str) -> str:
        """Files of a body for the renderer: path below the job's folder, with {frame}."""
        return f"{self.folder}/{body}/{{frame}}{self.suffix}"


@dataclass(frozen=True)
class Display:
    """How `pipeline view` and `pipeline live` show a body of this kind."""

    layer: str  # title of the box that shows and hides the bodies of the kind
    # points at `position` [m], coloured by the speed of `velocity` or any array of a number each; a mesh of `position`
    # [m] and `triangles`; parts of the body's shape, placed by `position` [m] and `orientation`; density of the cells
    # of a grid
    form: Literal["points", "mesh", "parts", "density"]
    radius: str = "radius"  # of points: the attribute that holds it [m]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of body."""

    name: str  # of its tables in the job file, `[[name]]`, and of its snapshots
    parameters: type[Parameters]  # what a table of it says
    about: str  # what the reference says of the table
    size: str = ""  # how many elements the bodies of a job have, for people: "about {:,} particles"
    elements: Callable[[Job, Any], float] = lambda _job, _body: 0.0  # about how many of these a body has at most
    # size of an element in memory, in a frame of the cache, and in a checkpoint
    snapshot_bytes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    method: Callable[[Any], str] = lambda _body: ""  # how a body is computed, where that makes a difference in time
    # work of a frame of all bodies of a job, by the number of their elements
    work: FrameWork = lambda _job, _elements, _on_gpu: Work()
    solver_bytes: float = 0.0  # memory of an element while it is simulated on a CPU, as measured
    compiling_s: float = 0.0  # time of compiling its kernels on the reference machine, once [s]
    drawing: float = 0.0  # time that its bodies add to a picture, over that of a scene of one fluid [-]
    wears: str = "rigid"  # the kind whose looks its bodies can have (`blender_scripts.look_table`)
    material: Callable[[Any], Mapping[str, MaterialParameters]]  # usual materials of the parts of a body, itself first
    # size of a body that its look is scaled by [m]: of a liquid its own, of smoke its source's; the domain's if omitted
    look_size: Callable[[Job, Any], float] = lambda job, _body: dist(job.domain.min, job.domain.max)
    # boxes that a body is in by the job, beside the domain, for a camera that shows the whole scene
    boxes: Callable[[Job, Any], Iterable[Box]] = lambda _job, _body: ()
    # the solids that its tables place, each with the path of its table below the body's
    placements: Callable[[Job, int], Iterator[tuple[KeyPath, Placement]]] = lambda _job, _index: iter(())
    # looks at all bodies of the kind; returns the number of their elements
    check: Callable[[Job, Solids, MemoryBudget, Findings], int]
    # changes that make the bodies coarser by a factor, for a preview; the last argument builds the solids of the job,
    # or is None where its numbers cannot be computed with
    coarser: Callable[[Job, float, SolidBuilder | None], Sequence[Change]] = lambda _job, _factor, _solids: ()
    lighter: str = ""  # what of it takes less memory, for people: "a larger fluid.particle_radius"
    # its solvers in a scene, at so many frames a second; None for the kinds that `sim.build` couples
    solvers: Callable[[SceneParameters, float], Sequence[Solver]] | None = None
    # of kinds that grow by themselves: why a job has no memory for so many more elements just then; None if it has
    growth: Callable[[Job], Callable[[float], str | None]] | None = None
    # whether a body is one of those that have one solver, which is called by the name of the kind; None for kinds whose
    # solvers have the names of their bodies
    shares_solver: Callable[[Any], bool] | None = None
    is_closed: bool = True  # its drawn meshes have an inside
    codec: Callable[[], Codec] | None = None  # how the cache keeps it, if not array by array
    # the file that is made of each frame; None if the renderer needs none but the cached frame
    product: Product | None = None
    objects: Callable[[Job, JobLayout, Any, Materials], Iterator[SceneObject]]  # what the renderer draws of a body
    # how far a body reaches in a frame, from its group of the cache; None where there is nothing of it
    reach: Callable[[Job, JobLayout, Any, h5py.Group], Reach | None]
    reach_bytes: float = 0.0  # what finding that takes, by the number of elements
    display: Display  # how the viewer shows it
    live: LiveParameters | None = None  # what can be changed of it while it runs; None: it does not run live
    # a body in a few words, for the report, with the number of its elements in the last frame if known
    facts: Callable[[Any, float | None], str] = lambda _body, _count: ""

    def bodies(self, job: SceneParameters) -> Sequence[Any]:
        """The job's bodies of this kind, in the order of the file."""
        bodies: Sequence[Any] = getattr(job, self.name)
        return bodies

    def has_shared_solver(self, job: SceneParameters) -> bool:
        """Whether some bodies of the job share a solver that is called by the name of the kind."""
        return self.shares_solver is not None and any(map(self.shares_solver, self.bodies(job)))
