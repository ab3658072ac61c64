"""Which of the machine's GPUs a task is given."""

import pytest

from pipeline.errors import PipelineError
from pipeline.executors.dask_local import gpu_places
from pipeline.executors.gpu_places import GpuPlaces
from pipeline.gpus import OWN_GPUS, first_gpu, own_gpus
from pipeline.task import Resources


def test_each_task_gets_the_first_gpu_that_is_free():
    places = GpuPlaces(None)
    assert [places.take(), places.take(), places.take()] == [0, 1, 2]
    places.give_back(1)
    assert places.take() == 1
    assert places.take() == 3


def test_a_gpu_where_blender_waits_goes_before_another_unless_a_task_is_on_it():
    places = GpuPlaces(None)
    assert places.take(warm=[2, 1]) == 1
    assert places.take(warm=[1]) == 0
    assert places.take(warm=[1, 2]) == 2


def test_a_process_with_some_gpus_gives_those_and_no_others():
    places = GpuPlaces([1, 3])
    assert [places.take(), places.take()] == [1, 3]
    assert places.take() == 1  # of a runner that does not know of the first two tasks
    places.give_back(3)
    assert places.take() == 3


@pytest.mark.parametrize(("text", "own", "first"), [(None, None, 0), ("2,3", (2, 3), 2), ("", (), 0), (" 1 ", (1,), 1)])
def test_the_environment_says_which_gpus_a_process_has(monkeypatch, text, own, first):
    monkeypatch.delenv(OWN_GPUS, raising=False)
    if text is not None:
        monkeypatch.setenv(OWN_GPUS, text)
    assert (own_gpus(), first_gpu()) == (own, first)


def test_places_that_cannot_be_read_are_told_with_their_form(monkeypatch):
    monkeypatch.setenv(OWN_GPUS, "all")
    with pytest.raises(PipelineError, match="PIPELINE_GPUS=all: must be places of GPUs with commas between them"):
        own_gpus()


def test_workers_of_a_cluster_on_one_machine_have_different_gpus(monkeypatch):
    monkeypatch.delenv(OWN_GPUS, raising=False)
    assert gpu_places([Resources(2, 0, 2), Resources(2, 0, 1), Resources(2, 0, 0)]) == [[0, 1], [2], []]
    monkeypatch.setenv(OWN_GPUS, "4,6,7")
    assert gpu_places([Resources(2, 0, 2), Resources(2, 0, 1)]) == [[4, 6], [7]]
