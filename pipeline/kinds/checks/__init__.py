"""Checks of the bodies of a job, one module a kind or a pair that meets."""
