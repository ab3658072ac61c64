"""A job as an Open Job Description template: how it is handed to the farm manager that a studio has already.

Specification 2023-09, with the extension TASK_CHUNKING. One step a stage; each step depends on those whose files it
reads, and a stage whose frames do not depend on each other is cut into chunks of frames. Every task runs
`pipeline work --stage` in the job's folder, which all machines share.
"""

from collections.abc import Sequence
from typing import Any

from pipeline.base.task import Resources, Task
from pipeline.run.plan import frame_ranges

SPECIFICATION = "jobtemplate-2023-09"
CHUNK_FRAMES = 10  # frames a chunk, unless the farm says otherwise: Blender and the scene are loaded once a chunk
_STOP_PERIOD_S = 120  # time a simulation gets to write its checkpoint when the farm cancels it [s]
_NAME_CHARACTERS = 128  # longest name of a job that the specification allows


def job_template(name: str, tasks: Sequence[Task], *, python: str) -> dict[str, Any]:
    """The template of a job and its plan, ready to be written as JSON into the job's folder, beside the job file."""
    return {
        "specificationVersion": SPECIFICATION,
        "extensions": ["TASK_CHUNKING"],
        "name": name[:_NAME_CHARACTERS],
        "description": "A film of simulated physics, made by `pipeline export --to openjd`.",
        "parameterDefinitions": [
            {
                "name": "JobFolder",
                "type": "PATH",
                "objectType": "DIRECTORY",
                "dataFlow": "INOUT",
                "default": ".",
                "description": "The job's folder, on a disk that all machines share: that of this template.",
            },
            {
                "name": "Python",
                "type": "STRING",
                "default": python,
                "description": "The interpreter of the environment that this program is installed in.",
            },
            {
                "name": "ChunkFrames",
                "type": "INT",
                "default": CHUNK_FRAMES,
                "minValue": 1,
                "description": "Frames in a chunk.",
            },
        ],
        "steps": [_step(stage, tasks) for stage in dict.fromkeys(task.stage for task in tasks)],
    }


def _step(stage: str, tasks: Sequence[Task]) -> dict[str, Any]:
    own = [task for task in tasks if task.stage == stage]
    arguments = ["-P", "-m", "pipeline", "work", "{{Param.JobFolder}}", "--stage", stage, "--openjd"]
    step: dict[str, Any] = {"name": stage}
    dependencies = _dependencies(stage, tasks)
    if dependencies:
        step["dependencies"] = [{"dependsOn": name} for name in dependencies]
    frames = _independent_frames(own)
    if frames:
        arguments += ["--frames", "{{Task.Param.Frames}}"]
        step["parameterSpace"] = {
            "taskParameterDefinitions": [
                {
                    "name": "Frames",
                    "type": "CHUNK[INT]",
                    "range": frame_ranges(frames, range(max(frames) + 1)).replace(" ", ""),
                    "chunks": {"defaultTaskCount": "{{Param.ChunkFrames}}", "rangeConstraint": "CONTIGUOUS"},
                }
            ]
        }
    amounts = _amounts([task.resources for task in own])
    if amounts:
        step["hostRequirements"] = {"amounts": amounts}
    step["script"] = {
        "actions": {
            "onRun": {
                "command": "{{Param.Python}}",
                "args": arguments,
                "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": _STOP_PERIOD_S},
            }
        }
    }
    return step


def _dependencies(stage: str, tasks: Sequence[Task]) -> list[str]:
    """The stages that make what a stage reads."""
    makers = {output: task.stage for task in tasks for output in task.outputs}
    read = {makers[artifact] for task in tasks if task.stage == stage for artifact in task.inputs}
    return [name for name in dict.fromkeys(task.stage for task in tasks) if name in read - {stage}]


def _independent_frames(tasks: Sequence[Task]) -> frozenset[int]:
    """The frames of a stage, if each can be run without the others; else none, and the stage runs as a whole."""
    own = {output for task in tasks for output in task.outputs}
    frames = frozenset(task.frame for task in tasks if task.frame is not None)
    whole = any(task.frame is None or own.intersection(task.inputs) for task in tasks)
    return frozenset() if whole else frames


def _amounts(needs: Sequence[Resources]) -> list[dict[str, Any]]:
    """What a machine must have for the largest task of a stage, in the units of the specification."""
    amounts = {
        "amount.worker.vcpu": max(need.cores for need in needs),
        "amount.worker.memory": -(-max(need.memory_bytes for need in needs) // 2**20),  # MiB, rounded up
        "amount.worker.gpu": max(need.gpus for need in needs),
    }
    return [{"name": name, "min": amount} for name, amount in amounts.items() if amount]
