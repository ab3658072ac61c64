"""The stages of a job, each with a pure plan() and an idempotent run()."""
