"""The orchestrator: from a job file to a movie, through tracked and resumable stages.

As a library it has the names of `pipeline.library`, which is loaded when one of them is asked for.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.library import Scene, Submission, make_job, read_frame, read_job, submit

__version__ = "0.1.0"
__all__ = ["Scene", "Submission", "__version__", "make_job", "read_frame", "read_job", "submit"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("pipeline.library"), name)
