"""What has to hold after whatever happened."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Set

from .studio import SO_FAR, Studio

SUCCEEDED = "succeeded"


def broken_promises(studio: Studio, reference: Mapping[str, str], harmed: Set[str]) -> Iterator[str]:
    """A sentence for each promise that a finished job breaks.

    Args:
        studio: where the job was made.
        reference: hash of each artifact of an undisturbed run.
        harmed: artifacts that were damaged on purpose: these may have been made twice.
    """
    mine = studio.artifacts()
    for path in sorted(mine.keys() | reference.keys()):
        if mine.get(path) != reference.get(path):
            how = "is missing" if path not in mine else "should not be there" if path not in reference else "differs"
            yield f"{path} {how}"
    recorded = studio.recorded()
    if recorded != dict(reference):
        wrong = sorted(path for path in recorded.keys() | reference.keys() if recorded.get(path) != reference.get(path))
        yield f"the record is wrong about {', '.join(wrong)}"
    if (studio.root / "runner.lease").exists():
        yield "a lease is left"
    left = [
        path.relative_to(studio.root).as_posix()
        for path in studio.root.rglob("*")
        if ".part" in path.name or SO_FAR in path.name
    ]
    if left:
        yield f"unfinished files are left: {', '.join(left)}"
    if temporary := sorted(path.name for path in studio.temporary.iterdir()):
        yield f"temporary files are left: {', '.join(temporary)}"
    yield from _done_twice(studio, harmed)
    if "Traceback" in studio.printed():
        yield "a command ended in a traceback"


def _done_twice(studio: Studio, harmed: Set[str]) -> Iterator[str]:
    outcomes = defaultdict(list)
    for task, _, outcome in studio.attempts():
        outcomes[task].append(outcome)
    for task, all_of_them in outcomes.items():
        if SUCCEEDED in all_of_them[:-1] and not _may_be_done_again(task, harmed):
            yield f"{task} was done again after it had succeeded: {', '.join(all_of_them)}"


def _may_be_done_again(task: str, harmed: Set[str]) -> bool:
    """Whether an output of the task was damaged. Tasks are called after stages, outputs after folders."""
    stage, _, rest = task.partition("/")
    folders = {"simulate": "cache/", "render": "frames/", "bodies": "meshes/", "volume": "volumes/", "movie": "movie"}
    folders |= {"surface": "surfaces/", "cloth": "cloths/"}
    stems = rest.removeprefix("segment-")
    return any(path.startswith(folders[stage]) and (stage in ("simulate", "movie") or stems in path) for path in harmed)
