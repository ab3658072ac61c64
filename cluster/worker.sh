#!/bin/bash
# One Dask worker with these resource tags, until SIGTERM. It waits for the scheduler, and comes back after it was lost.
#
#     PIPELINE_SHARED=/shared/farm cluster/worker.sh CPU=8 MEM=32e9 GPU=1
set -u
run=${PIPELINE_RUN:-./run}
shared=${PIPELINE_SHARED:?name the shared folder: export PIPELINE_SHARED=/shared/farm}
threads=1 # tasks at a time: as many as there are cores, since a task takes one at least
for tag in "$@"; do
    case $tag in CPU=*) threads=${tag#CPU=} ;; esac
done

leave() { # tells the worker until it is gone: while it starts it does not listen
    trap "" TERM
    while jobs=$(jobs -rp) && [ -n "$jobs" ]; do
        kill -TERM $jobs 2>/dev/null
        sleep 1
    done
    exit 0
}
pause() {
    sleep "$1" &
    wait $!
}
trap leave TERM INT
while true; do
    # Here, since Dask would not listen meanwhile.
    until [ -e "$shared/scheduler.json" ]; do pause 1; done
    # No nanny: what restarts it is this loop. No memory limit: Dask would see its own process only.
    # SLURM tells the worker to leave and this script, which tells it, too: a second SIGTERM would end it at once, without
    # the grace for its tasks. After the first Dask puts back what was there before, which is to ignore it.
    (
        trap "" TERM
        exec "$run" dask worker --scheduler-file "$shared/scheduler.json" --no-nanny --nthreads "$threads" \
            --memory-limit 0 --resources "$*" --death-timeout 60 --no-dashboard
    ) &
    wait $!
    pause 5
done
