"""The orchestrator: from a job file to a movie, through tracked and resumable stages."""

__version__ = "0.1.0"
