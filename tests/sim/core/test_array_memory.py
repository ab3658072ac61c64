import threading

import pytest
import taichi as ti
from taichi.lang import impl

from sim.core.array_memory import free_given_up


class Program:
    """The program that runs, which notes who frees what."""

    def __init__(self, program):
        self._program, self.freed = program, []

    def __getattr__(self, name):
        return getattr(self._program, name)

    def delete_ndarray(self, known):
        self.freed.append((threading.get_ident(), known))
        self._program.delete_ndarray(known)


@pytest.fixture
def program(taichi_cpu, monkeypatch):
    free_given_up()
    watched = Program(impl.get_runtime().prog)
    monkeypatch.setattr(impl.get_runtime(), "prog", watched)
    return watched


@pytest.mark.parametrize(
    "make", [lambda: ti.ndarray(ti.f32, 10), lambda: ti.Vector.ndarray(3, ti.f32, 10)], ids=["scalars", "vectors"]
)
def test_arrays_are_freed_by_the_thread_of_the_device_whoever_gives_them_up(program, make):
    held = [make()]
    other = threading.Thread(target=held.clear)
    other.start()
    other.join()
    assert program.freed == []
    known = make().arr
    owner = threading.get_ident()
    assert [thread for thread, _ in program.freed] == [owner, owner]
    assert program.freed[1][1] is known
