"""The whole command line over the synthetic stages, in a process of its own: `synthetic_command.py ARGUMENTS`.

LEASE_EXPIRY_S says after how long a holder on another machine counts as dead [s].
"""

import os
import sys

import synthetic_stages

import pipeline.base.lease
import pipeline.queue.farm
import pipeline.queue.turns
import pipeline.stages
from pipeline.cli.main import main

if __name__ == "__main__":
    pipeline.stages.STAGES = synthetic_stages.STAGES
    pipeline.queue.turns.STAGES_REFERENCE = synthetic_stages.REFERENCE
    pipeline.queue.farm.COMMAND = (sys.executable, __file__)
    if "LEASE_EXPIRY_S" in os.environ:
        pipeline.base.lease.EXPIRY_S = float(os.environ["LEASE_EXPIRY_S"])
        pipeline.base.lease.HEARTBEAT_INTERVAL_S = pipeline.base.lease.EXPIRY_S / 12
    main()
