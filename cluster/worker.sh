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

worker=
trap 'trap "" TERM; [ -z "$worker" ] || kill -TERM "$worker" 2>/dev/null; wait; exit 0' TERM INT
while true; do
    # No nanny: what restarts it is this loop. No memory limit: Dask would see its own process only.
    "$run" dask worker --scheduler-file "$shared/scheduler.json" --no-nanny --nthreads "$threads" \
        --memory-limit 0 --resources "$*" --death-timeout 60 --no-dashboard &
    worker=$!
    wait "$worker"
    worker=
    sleep 5 &
    wait $!
done
