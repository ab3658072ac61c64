"""A run of one job: plan, scheduler, runner, progress."""
