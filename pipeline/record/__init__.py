"""The manifest, a job's record of its tasks: one writer, queries, reconciliation with what is on disk."""
