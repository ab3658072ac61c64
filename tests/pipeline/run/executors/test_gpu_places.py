"""Which of the machine's GPUs a task is given."""

from pathlib import Path

import pytest

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Resources, Task, TaskId
from pipeline.job.loading import job_of_text
from pipeline.model.gpus import OWN_GPUS, first_gpu, own_gpus
from pipeline.run.executors.dask_local import gpu_places
from pipeline.run.executors.gpu_places import GpuPlaces, NoGpuLeftError
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES


def task(stage: str) -> Task:
    """A task that needs a GPU; a simulation takes the lowest."""
    parameters = ParameterSet.of(stage=stage, version=1, tools={})
    return Task(TaskId(stage), stage, (), (), parameters, lowest_gpu=stage == "simulate")


def test_each_picture_gets_the_highest_gpu_that_is_free():
    places = GpuPlaces(None)
    assert [places.take(there=3), places.take(there=3), places.take(there=3)] == [2, 1, 0]
    places.give_back(1)
    assert places.take(there=3) == 1


def test_where_it_is_not_known_how_many_there_are_the_lowest_that_is_free_is_given():
    places = GpuPlaces(None)
    assert [places.take(), places.take(), places.take()] == [0, 1, 2]
    places.give_back(1)
    assert places.take() == 1
    assert places.take() == 3


def test_simulations_take_the_lowest_gpus_and_pictures_the_others():
    places = GpuPlaces(None)
    taken = [places.take(lowest=True, there=4), places.take(there=4), places.take(lowest=True, there=4)]
    assert taken == [0, 3, 1]
    places = GpuPlaces([1, 3])
    assert [places.take(lowest=True), places.take(), places.take(lowest=True)] == [1, 3, 1]
    assert [GpuPlaces([]).take(lowest=True, there=2), GpuPlaces([]).take(lowest=True)] == [0, 0]


def test_a_gpu_that_failed_is_given_no_more():
    places = GpuPlaces(None)
    assert [places.take([1], there=3, failed={1}), places.take(lowest=True, there=3, failed={0, 1})] == [2, 2]
    assert places.take(failed={0}) == 1  # where it is not known how many there are
    with pytest.raises(NoGpuLeftError):
        places.take(there=3, failed={0, 1, 2})
    with pytest.raises(NoGpuLeftError):
        GpuPlaces([1]).take(lowest=True, failed={1})


def test_a_simulation_asks_for_the_lowest_gpu():
    text = 'name = "ball"\ndevice = "cuda"\n[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.1 }\n'
    planned = plan_job(job_of_text(text, Path("job.toml")), JobLayout(Path("renders/ball")), STAGES)
    assert {task.stage for task in planned if task.lowest_gpu} == {"simulate"}


def test_a_gpu_where_blender_waits_goes_before_another_unless_a_task_is_on_it():
    places = GpuPlaces(None)
    assert places.take(warm=[2, 1], there=4) == 1
    assert places.take(warm=[1], there=4) == 3
    assert places.take(warm=[1, 2], there=4) == 2


def test_a_process_with_some_gpus_gives_those_and_no_others():
    places = GpuPlaces([1, 3])
    assert [places.take(there=2), places.take(there=2)] == [3, 1]
    assert places.take() == 3  # of a runner that does not know of the first two tasks
    places.give_back(1)
    assert places.take() == 1


def test_a_process_without_gpus_gives_none(monkeypatch):
    monkeypatch.setenv(OWN_GPUS, "")
    assert first_gpu(task("simulate")) == 0
    for take in (GpuPlaces(own_gpus()).take, lambda: first_gpu(task("render"))):
        with pytest.raises(PipelineError, match="PIPELINE_GPUS leaves this process none of the machine's GPUs"):
            take()


@pytest.mark.parametrize(
    ("text", "own", "first"), [(None, None, 0), ("2,3", (2, 3), 2), ("3,2, 3", (2, 3), 2), (" 1 ", (1,), 1)]
)
def test_the_environment_says_which_gpus_a_process_has(monkeypatch, text, own, first):
    monkeypatch.delenv(OWN_GPUS, raising=False)
    if text is not None:
        monkeypatch.setenv(OWN_GPUS, text)
    assert (own_gpus(), first_gpu(task("render"))) == (own, first)


@pytest.mark.parametrize("text", ["all", "-1", "0,-2"])
def test_places_that_cannot_be_read_are_told_with_their_form(monkeypatch, text):
    monkeypatch.setenv(OWN_GPUS, text)
    with pytest.raises(PipelineError, match=f"PIPELINE_GPUS={text}: must be places of GPUs, from 0 on, with commas"):
        own_gpus()


def test_workers_of_a_cluster_on_one_machine_have_different_gpus(monkeypatch):
    monkeypatch.delenv(OWN_GPUS, raising=False)
    assert gpu_places([Resources(2, 0, 2), Resources(2, 0, 1), Resources(2, 0, 0)]) == [[0, 1], [2], []]
    monkeypatch.setenv(OWN_GPUS, "4,6,7")
    assert gpu_places([Resources(2, 0, 2), Resources(2, 0, 1)]) == [[4, 6], [7]]
    monkeypatch.setenv(OWN_GPUS, "")
    assert gpu_places([Resources(2, 0, 1), Resources(2, 0, 0)]) == [[], []]
