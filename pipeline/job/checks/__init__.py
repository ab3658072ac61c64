"""Checks of a job as a whole, one module a subject."""
