#!/bin/bash
# A job's stages as SLURM jobs: arrays over chunks of frames, each of which begins when those that it reads are done.
#
#     pipeline export job.toml --to openjd --farm /shared/renders --set device=cpu --set render.device=cpu
#     cluster/stages.sh /shared/renders/my-film --partition=cpu      # options of sbatch for all stages
#     pipeline resume /shared/renders/my-film                        # when all are done: takes them into the record
#
# PIPELINE_CHUNK is the number of frames in a task of an array, 10 unless set. What is done is not done again.
set -euo pipefail
here=${PIPELINE_CLUSTER:-cluster}
folder=${1:?name the folder of the job, into which pipeline export openjd wrote}
shift

# A line for each stage: its name, those that it needs, its options, and its chunks of frames.
stages=$("${PIPELINE_RUN:-./run}" python - "$folder/openjd.json" "${PIPELINE_CHUNK:-10}" <<'PYTHON'
import json, sys

options = {"vcpu": "--cpus-per-task={}", "memory": "--mem={}M", "gpu": "--gpus-per-task={}"}
size = int(sys.argv[2])
for step in json.load(open(sys.argv[1]))["steps"]:
    amounts = step.get("hostRequirements", {}).get("amounts", [])
    needs = [need["dependsOn"] for need in step.get("dependencies", [])]
    [frames] = [each["range"] for each in step.get("parameterSpace", {}).get("taskParameterDefinitions", [])] or [""]
    ranges = [[int(end) for end in part.split("-")] for part in frames.split(",") if part]
    chunks = [
        f"{begin}-{min(begin + size - 1, last)}" for first, *_, last in ([r[0], r[-1]] for r in ranges)
        for begin in range(first, last + 1, size)
    ]
    wanted = [options[each["name"].split(".")[-1]].format(each["min"]) for each in amounts]
    print(step["name"], ",".join(needs), " ".join(wanted), " ".join(chunks), sep="|")
PYTHON
)

declare -A job # SLURM's number of each stage
# Where SLURM refuses one, by a limit of the account's, those before it would make half a film.
trap '[ -z "${job[*]}" ] || { scancel ${job[*]}; echo "the jobs before it are cancelled" >&2; }' ERR
while IFS='|' read -r stage needs options chunks; do
    read -ra options <<<"$options"
    read -ra chunks <<<"$chunks"
    [ ${#chunks[@]} = 0 ] || options+=("--array=0-$((${#chunks[@]} - 1))")
    after=
    for need in ${needs//,/ }; do after+=:${job[$need]}; done
    [ -z "$after" ] || options+=("--dependency=afterok$after" --kill-on-invalid-dep=yes)
    job[$stage]=$(sbatch --parsable --job-name="pipeline-$stage" "${options[@]}" "$@" \
        "$here/stage-array.sbatch" "$folder" "$stage" "${chunks[@]}")
    echo "$stage: job ${job[$stage]}"
done <<<"$stages"
