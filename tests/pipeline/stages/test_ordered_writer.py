"""Writes in a thread beside the computing one: in order, bounded, and no error is lost."""

import ctypes
import errno
import threading

import pytest

from pipeline.run.executors.failures import is_disk_full
from pipeline.stages.ordered_writer import WAITING, OrderedWriter, WriterLostError

PATIENCE_S = 60.0
"""Only a hang gets here."""


class Gate:
    """A write that does not end before it is let through."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.open = threading.Event()

    def __call__(self) -> None:
        self.reached.set()
        assert self.open.wait(PATIENCE_S)


def full_disk() -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_writes_are_done_in_order_and_all_of_them_before_the_block_ends():
    done: list[int] = []
    with OrderedWriter() as writer:
        for number in range(20):
            writer.submit(lambda number=number: done.append(number))
    assert done == list(range(20))


def test_computing_goes_on_while_a_write_is_under_way():
    gate = Gate()
    with OrderedWriter() as writer:
        writer.submit(gate)
        assert gate.reached.wait(PATIENCE_S)
        writer.submit(lambda: None)  # returns although the first one has not ended
        gate.open.set()


def test_no_more_writes_wait_than_the_memory_is_counted_for():
    gate, handed_in = Gate(), []
    with OrderedWriter() as writer:

        def compute() -> None:
            for number in range(WAITING + 5):
                writer.submit(lambda: None)
                handed_in.append(number)

        writer.submit(gate)
        assert gate.reached.wait(PATIENCE_S)
        computing = threading.Thread(target=compute)
        computing.start()
        computing.join(0.2)  # would be over long before if nothing held it up
        assert computing.is_alive()
        assert len(handed_in) == WAITING
        gate.open.set()
        computing.join(PATIENCE_S)
    assert len(handed_in) == WAITING + 5


def test_a_full_disk_is_still_a_full_disk_in_the_computing_thread_and_nothing_is_written_after_it():
    done: list[str] = []
    gate = Gate()

    def fail() -> None:
        gate()
        full_disk()

    with pytest.raises(OSError, match="No space left") as error, OrderedWriter() as writer:
        writer.submit(fail)
        assert gate.reached.wait(PATIENCE_S)
        writer.submit(lambda: done.append("checkpoint"))
        gate.open.set()
        for _ in range(WAITING + 2):
            writer.submit(lambda: done.append("frame"))
    assert error.value.errno == errno.ENOSPC
    assert is_disk_full(error.value)
    assert done == []


def test_the_error_of_the_last_write_is_raised_on_leaving():
    with pytest.raises(OSError, match="No space left"), OrderedWriter() as writer:
        writer.submit(full_disk)


def end_writing_thread() -> None:
    """Raise SystemExit in it, where it waits for the next write."""
    (thread,) = (each for each in threading.enumerate() if each.name == "writer")
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))


def test_a_thread_that_ended_is_an_error_for_the_computing_one_and_no_endless_wait():
    done: list[int] = []
    with pytest.raises(WriterLostError, match="has ended unexpectedly"), OrderedWriter() as writer:
        writer.submit(lambda: done.append(0))
        end_writing_thread()
        for number in range(1, WAITING + 5):
            writer.submit(lambda number=number: done.append(number))
    assert done in ([], [0])  # whether it was already at the first one


def test_a_thread_that_ended_is_found_on_leaving_where_nothing_came_after():
    done: list[int] = []
    with pytest.raises(WriterLostError), OrderedWriter() as writer:
        end_writing_thread()
        writer.submit(lambda: done.append(0))
    assert done == []


def test_what_was_computed_before_a_divergence_is_written():
    done: list[int] = []
    with pytest.raises(ArithmeticError), OrderedWriter() as writer:
        writer.submit(lambda: done.append(1))
        writer.submit(lambda: done.append(2))
        raise ArithmeticError("diverged")
    assert done == [1, 2]


def test_a_divergence_says_so_when_its_last_frames_could_not_be_written_either():
    with pytest.raises(ArithmeticError) as error, OrderedWriter() as writer:
        writer.submit(full_disk)
        raise ArithmeticError("diverged")
    assert error.value.__notes__ == ["besides, writing failed: OSError: [Errno 28] No space left on device"]
