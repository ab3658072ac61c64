"""The user's own files, kept with the job: its folder can be moved, and continued when the originals are gone."""

from pathlib import Path

from blake3 import blake3

from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.job.input_files import input_files
from pipeline.job.loading import LoadedJob, changed_text, job_of_text
from pipeline.job.overrides import Override
from pipeline.model.job import Job


def keep_inputs(loaded: LoadedJob, layout: JobLayout) -> tuple[Job, str]:
    """Copy the files that the job reads into its folder.

    A copy is named after its content, so one of another job version never replaces it. One that does not hold that
    content any more is written again.

    Returns:
        The job that reads the copies, as the workers will load it, and its text, which names them by paths relative to
        the folder.

    Raises OSError: a file cannot be read, or the folder not be written.
    """
    changes = []
    for file in input_files(loaded.job):
        source = Path(file.path)
        content = source.read_bytes()
        digest = blake3(content).hexdigest()[:12]
        copy = layout.inputs / f"{source.stem.removesuffix(f'-{digest}')}-{digest}{source.suffix}"
        if not copy.is_file() or copy.read_bytes() != content:
            copy.parent.mkdir(parents=True, exist_ok=True)
            # No lease is held yet, and the runner of this folder would remove a part.
            replace_durably(copy, content, mark="copying")
        kept = file.written(copy.relative_to(layout.root).as_posix())
        changes.append(Override(file.place, kept, loaded.path.name))
    text = changed_text(loaded.text, changes) if changes else loaded.text
    return job_of_text(text, layout.job_file), text
