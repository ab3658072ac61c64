"""Executors: where attempts of tasks run."""
