"""The ground of the orchestrator: tasks, paths, errors, files, leases, resources."""
