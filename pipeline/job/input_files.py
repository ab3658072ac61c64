"""The user's own files that a job names, each with its place in the job file."""

from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.model.groups import written_place
from pipeline.model.job import Job
from pipeline.model.meshes import mesh_shapes
from pipeline.model.positions import KeyPath


@dataclass(frozen=True)
class InputFile:
    """One file that a job reads."""

    place: KeyPath  # of the key that names it
    path: str  # as the job names it
    kind: str  # what it is, for messages: "mesh"
    rest: str = ""  # what the key's value says after the path

    def written(self, path: str) -> str:
        """The key's value with the file under another path."""
        return path + self.rest


def input_files(job: Job) -> Iterator[InputFile]:
    """Every file that the job reads, meshes first."""
    found: dict[KeyPath, str] = {}
    for place, shape in mesh_shapes(job):
        found.setdefault((*written_place(job, place), "file"), shape.file)
    for place, file in found.items():
        yield InputFile(place, file, "mesh")
    if job.set.hdri is not None:
        yield InputFile(("set", "hdri"), job.set.hdri, "picture")
    if job.set.backplate is not None:
        yield InputFile(("set", "backplate"), job.set.backplate, "picture")
    for name, material in job.material.items():
        if material.blend is not None:
            file, inside = split_blend(material.blend)
            yield InputFile(("material", name, "blend"), file, ".blend file", f":{inside}")


def split_blend(reference: str) -> tuple[str, str]:
    """File and name of a material: `file.blend:Name`."""
    stem, _, name = reference.partition(".blend:")
    return f"{stem}.blend", name
