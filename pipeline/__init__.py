"""The orchestrator: from a job file to a movie, through tracked and resumable stages."""
