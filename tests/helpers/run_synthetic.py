"""A runner in a process of its own, to be killed: `run_synthetic.py FOLDER FRAMES`; exits with the run's code."""

import sys
from pathlib import Path

from synthetic_jobs import job_text, run_synthetic

from pipeline.base.task import Policy
from pipeline.run.events import Notice, RunEvent
from pipeline.run.executors.processes import ProcessExecutor


class Printer:
    def notify(self, event: RunEvent) -> None:
        if isinstance(event, Notice):
            print(event.message, flush=True)


if __name__ == "__main__":
    with ProcessExecutor() as executor:
        text = job_text(frames=int(sys.argv[2]))
        # Whoever kills at random may hit the same task many times.
        policy = Policy(attempts=100, backoff_s=0.01)
        sys.exit(
            run_synthetic(Path(sys.argv[1]), executor, text, observers=[Printer().notify], policy=policy).exit_code
        )
