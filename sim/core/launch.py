"""Kernel launches that cost little of the host's time.

Taichi looks at every argument of every call several times. `FastKernel` has Taichi check the types of a call once, and
hands the arguments of later calls with the same types straight to the runtime, but for fields of bundles that the
kernel does not read. Most calls come again with the same arrays, for which the whole context of the launch is kept on
CPUs and with CUDA, and on other GPUs what the arrays are to the runtime.
Measurements: docs/performance.md.

This relies on Taichi's internals, as `sim.core.bundles`, `sim.core.runtime` and `sim.core.reductions` do; the lock file
pins the release that they belong to.
"""

import functools
import operator
import time
import weakref
from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
from taichi.lang import impl
from taichi.lang.matrix import MatrixType, VectorType
from taichi.lang.util import to_numpy_type
from taichi.types import primitive_types
from taichi.types.ndarray_type import NdarrayType

from sim.core.array_memory import free_given_up
from sim.core.bundles import field_paths, flattened, is_used, with_fields_as_arguments
from sim.core.cuda_launch import Graph, HostBuffers, Tasks, tasks_of

_REAL_TYPES = frozenset(primitive_types.real_types)

SLOW_S = 0.25
"""A kernel whose source is read takes longer to compile, and less to be read from the cache of Taichi [s]."""
_tell_compiled: list[Callable[[str, float], None]] = []

MOST_LAUNCHES = 256  # most combinations of arrays whose launch context a kernel keeps

LAUNCHES_BEFORE_GRAPH = 2  # with the same arrays: a graph takes as long to make as some launches

_waits = [0]
"""How often somebody has waited for all that was launched."""

ADDRESS_OF_ARRAY = 1  # place of an array's address among what a kernel gets of it, after its shape


def on_compiled(tell: Callable[[str, float], None] | None) -> None:
    """Have `tell(name, seconds)` called after every kernel that had to be compiled in this process; None: nobody."""
    _tell_compiled[:] = [] if tell is None else [tell]


@dataclass(eq=False, slots=True)
class _Launch:
    """What is kept of a launch with these arrays, until one of them is gone."""

    compiled: Any
    make_context: Callable[[], Any]
    context: Any  # on a CPU, and with CUDA
    numbers: list[Any]  # what that context has, by argument
    handles: list[tuple[tuple[int], Any]]  # of the arrays, by place; on other GPUs
    arrays: tuple[weakref.ref[Any], ...]
    tasks: Tasks | None = None  # with CUDA, where they are known
    buffers: HostBuffers | None = None  # with CUDA
    graph: Graph | None = None
    count: int = 0  # of launches before there is a graph


def _forget(launches: dict[tuple[Any, ...], _Launch], key: tuple[Any, ...], _: object) -> None:
    """Drop a context, one of whose arrays is gone: another array may have its `id` from now on."""
    launches.pop(key, None)


def _picker(read: Sequence[str], count: int) -> Callable[[Sequence[Any]], Sequence[Any]]:
    """A function of `count` arguments that returns what a kernel reads of them, in order.

    Args:
        read: its paths, as "argument_2.field".
        count: of the arguments.
    """
    if list(read) == [_name_of(number) for number in range(count)]:
        return lambda arguments: arguments
    arguments_of: Any = namedtuple("Arguments", [_name_of(number) for number in range(count)])
    if len(read) > 1:
        get = operator.attrgetter(*read)
        return lambda arguments: get(arguments_of(*arguments))
    getters = [operator.attrgetter(path) for path in read]
    return lambda arguments: [get(arguments_of(*arguments)) for get in getters]


def _name_of(number: int, field: str = "") -> str:
    """Path of an argument, or of a field of it."""
    return f"argument_{number}.{field}" if field else f"argument_{number}"


class FastKernel:
    """A kernel that remembers what Taichi compiled for the types of its arguments; called as the kernel itself.

    Arguments are arrays made by Taichi, numbers, vectors and compile-time values, all of them by position; the result
    is nothing, a number, or a list of a vector's numbers: Taichi's own vectors take 0.1 ms to make.

    Raises:
        TypeError: the kernel takes arguments of a type that it cannot pass.
    """

    def __init__(self, kernel: Any, *, is_large: bool = False) -> None:
        functools.update_wrapper(self, kernel)
        self._primal = kernel._primal
        self._is_large = is_large
        self._kinds = getattr(self._primal.func, "__bundles__", (None,) * len(self._primal.arguments))
        self._program: Any = None
        self._compiled: dict[tuple[Any, ...], tuple[Any, Any, Tasks | None]] = {}
        self._launches: dict[tuple[Any, ...], _Launch] = {}
        self._last: tuple[Any, ...] = ()  # key of the launch that was asked for last
        self._on_cpu = self._on_cuda = False
        self._sort_arguments()

    def __call__(self, *args: Any) -> Any:
        """Launch; waits for the device only where the kernel returns something."""
        return self.later(*args)()

    def _enter_program(self) -> Any:
        """Taichi's program; of one before nothing is kept."""
        program = impl.get_runtime().prog
        if program is not self._program:
            self._program, self._compiled, self._launches = program, {}, {}
            arch = impl.current_cfg().arch
            self._on_cpu, self._on_cuda = arch in (ti.x64, ti.arm64), arch == ti.cuda
        return program

    def later(self, *args: Any) -> Callable[[], Any]:
        """Launch; what is returned is called for the result, which waits for the device unless somebody has since.

        To be called before the kernel is launched again.
        """
        program = self._enter_program()
        used = self._used(args)
        arrays = [used[index] for index, _ in self._arrays]
        key = (*[used[index] for index in self._templates], *map(id, arrays))
        self._last = key
        launch = self._launches.get(key)
        if launch is None:
            compiled = self._compiled.get(self._key(used))
            if compiled is None:
                result = self._first_call(program, args)
                return lambda: result
            launch = self._launches[key] = self._kept(program, key, compiled, arrays, len(used))
        context = self._launch(program, launch, used)
        return functools.partial(self._result, program, launch, context, _waits[0])

    def repeat(self, times: int, *args: Any) -> None:
        """Launch so often with the same arguments, of which nothing is returned: with CUDA, 3 us each."""
        graph = None
        for _ in range(times):
            if graph is None:
                self.later(*args)
                launch = self._launches.get(self._last)
                graph = None if launch is None else launch.graph
            else:
                graph.launch(is_changed=False)

    def _kept(
        self,
        program: Any,
        key: tuple[Any, ...],
        compiled: tuple[Any, Any, Tasks | None],
        arrays: Sequence[Any],
        used: int,
    ) -> _Launch:
        """What is worth keeping of a launch.

        On a CPU arrays are passed by their addresses, as those of other libraries are: Taichi would look up its own in
        every launch. With CUDA it does so unless it has no size of them; addresses are put where it would have them.
        """
        free_given_up()
        kernel, executable, tasks = compiled
        context, buffers, handles = None, None, []
        if self._on_cpu or self._on_cuda:
            context = kernel.make_launch_context()
            for (_, place), array in zip(self._arrays, arrays, strict=True):
                address = program.get_ndarray_data_ptr_as_int(array.arr)
                if self._on_cpu:
                    size = array.arr.nelement() * array.arr.element_size()
                    context.set_arg_external_array_with_shape(place, address, size, list(array.shape), 0)
                    continue
                context.set_struct_arg_uint((*place, ADDRESS_OF_ARRAY), address)
                for axis, length in enumerate(array.shape):
                    context.set_struct_arg_int((*place, 0, axis), length)
            buffers = HostBuffers(context) if self._on_cuda else None
        else:
            handles = [(place, array.arr) for (_, place), array in zip(self._arrays, arrays, strict=True)]
        if len(self._launches) >= MOST_LAUNCHES:
            self._launches.clear()
        forget = functools.partial(_forget, self._launches, key)
        references = tuple(weakref.ref(array, forget) for array in arrays)
        make_context = kernel.make_launch_context
        return _Launch(executable, make_context, context, [None] * used, handles, references, tasks, buffers)

    def _used(self, args: tuple[Any, ...]) -> Sequence[Any]:
        """Arguments that the kernel reads, fields of bundles among them. Raises TypeError where a bundle is another."""
        for number, kind in self._bundles:
            if type(args[number]) is not kind:
                raise TypeError(f"{self.__name__} takes a {kind.__name__}, got a {type(args[number]).__name__}")
        return self._pick(args)

    def _key(self, used: Sequence[Any]) -> tuple[Any, ...]:
        """What a kernel is compiled for: compile-time values, and the types of arrays."""
        types = [(used[index].element_type, len(used[index].shape)) for index, _ in self._arrays]
        return (*[used[index] for index in self._templates], *types)

    def _first_call(self, program: Any, args: tuple[Any, ...]) -> Any:
        """Call as Taichi does, which checks the types, compiles, and says what is wrong."""
        flat = tuple(flattened(args))
        config, tasks = program.config(), None
        optimizes = config.advanced_optimization
        config.advanced_optimization = optimizes and not (self._is_large and self._on_cpu)
        try:
            began = time.perf_counter()
            kernel = self._primal.compiled_kernels[self._primal.ensure_compiled(*flat)]
            traced = time.perf_counter()
            compiled = program.compile_kernel(config, program.get_device_caps(), kernel)
            ended = time.perf_counter()
            if ended - traced > SLOW_S:
                for tell in _tell_compiled:
                    tell(self.__name__, ended - began)
            if self._on_cuda:
                result, tasks = tasks_of(self.__name__, lambda: self._primal(*flat))
            else:
                result = self._primal(*flat)
        finally:
            config.advanced_optimization = optimizes
        if self._used_count != len(getattr(self._primal.func, "__used__", ())):
            self._compiled, self._launches = {}, {}  # their keys are of other arguments
            self._sort_arguments()
        self._compiled[self._key(self._used(args))] = kernel, compiled, tasks
        return result.to_numpy().tolist() if self._returns_vector else result

    def _launch(self, program: Any, launch: _Launch, used: Sequence[Any]) -> Any:
        """Launch with arrays that are kept and the numbers among what is `used`; returns the context."""
        context, passed = launch.context, launch.numbers
        if context is None:
            context, passed = launch.make_context(), [None] * len(used)  # it does not outlive the launch
            for place, handle in launch.handles:
                context.set_arg_ndarray(place, handle)
        elif launch.buffers is not None and launch.graph is None:
            launch.buffers.restore()
            if launch.tasks is not None and launch.count >= LAUNCHES_BEFORE_GRAPH:
                launch.graph = Graph(launch.tasks, launch.buffers)
            launch.count += 1
        is_changed = self._pass_numbers(context, used, passed)
        if launch.graph is None:
            program.launch_kernel(launch.compiled, context)
        else:
            launch.graph.launch(is_changed=is_changed)
        return context

    def _result(self, program: Any, launch: _Launch | None, context: Any, waits: int) -> Any:
        """What a launch returned, before which there were so many waits."""
        if self._primal.return_type is None:
            return None
        if not self._on_cpu:
            if waits == _waits[0]:
                program.synchronize()
                _waits[0] += 1
            if launch is not None and launch.graph is not None:
                launch.graph.take_result()
        kind = self._primal.return_type[0]
        if self._returns_vector:
            get = context.get_struct_ret_float if kind.dtype in _REAL_TYPES else context.get_struct_ret_int
            return [get((0, axis)) for axis in range(kind.n)]
        return self._primal.construct_kernel_ret(context, kind, (0,))

    def _sort_arguments(self) -> None:
        """Note how each argument that is used is passed, and at which place among those that are no templates."""
        self._templates: list[int] = []
        self._arrays: list[tuple[int, tuple[int]]] = []
        self._floats: list[tuple[int, tuple[int]]] = []
        self._integers: list[tuple[int, tuple[int]]] = []
        self._float_vectors: list[tuple[int, list[tuple[int, int]]]] = []
        self._integer_vectors: list[tuple[int, list[tuple[int, int]]]] = []
        self._bundles = [(number, kind) for number, kind in enumerate(self._kinds) if kind is not None]
        read: list[str] = []
        arguments = iter(enumerate(self._primal.arguments))
        count = 0
        for number, kind in enumerate(self._kinds):
            paths = [""] if kind is None else list(field_paths(kind))
            for path, (place, argument) in zip(paths, arguments, strict=False):
                is_template = isinstance(argument.annotation, ti.template)
                if not (is_template or is_used(self._primal.func, argument.name)):
                    continue
                if is_template:
                    self._templates.append(count)
                else:
                    self._sort_argument(count, place - len(self._templates), argument.annotation)
                read.append(_name_of(number, path))
                count += 1
        self._pick = _picker(read, len(self._kinds))
        self._used_count = len(getattr(self._primal.func, "__used__", ()))

    def _sort_argument(self, index: int, place: int, annotation: Any) -> None:
        if isinstance(annotation, NdarrayType):
            self._arrays.append((index, (place,)))
        elif isinstance(annotation, VectorType):
            vectors = self._float_vectors if annotation.dtype in primitive_types.real_types else self._integer_vectors
            vectors.append((index, [(place, axis) for axis in range(annotation.n)]))
        elif annotation in primitive_types.real_types:
            self._floats.append((index, (place,)))
        elif annotation in (ti.i32, ti.i64):
            self._integers.append((index, (place,)))
        else:
            raise TypeError(f"a fast kernel cannot pass arguments of type {annotation}")

    @property
    def _returns_vector(self) -> bool:
        return self._primal.return_type is not None and isinstance(self._primal.return_type[0], VectorType)

    def _pass_numbers(self, context: Any, used: Sequence[Any], passed: list[Any]) -> bool:
        """Pass numbers to a context that has those that were `passed` before; returns whether any differ."""
        is_changed = False
        for numbers, set_number in ((self._floats, context.set_arg_float), (self._integers, context.set_arg_int)):
            for index, place in numbers:
                if used[index] is not passed[index] and not _is_same(used[index], passed[index]):
                    set_number(place, used[index])
                    passed[index], is_changed = used[index], True
        for vectors, set_component in (
            (self._float_vectors, context.set_struct_arg_float),
            (self._integer_vectors, context.set_struct_arg_int),
        ):
            for index, places in vectors:
                if used[index] is not passed[index]:
                    for place, component in zip(places, used[index], strict=True):
                        set_component(place, component)
                    # Other vectors than tuples may be the same object with other numbers next time.
                    passed[index], is_changed = used[index] if type(used[index]) is tuple else None, True
        return is_changed


def _is_same(number: Any, before: Any) -> bool:
    """Whether a number is certainly the one before, bit by bit: 0.0 equals -0.0."""
    return type(number) is type(before) and number == before and (type(number) is int or number != 0.0)


def kernel(function: Callable[..., Any]) -> FastKernel:
    """Decorator in place of `ti.kernel`: the kernel may take bundles, and its launches are fast."""
    return FastKernel(ti.kernel(with_fields_as_arguments(function)))


def large_kernel(function: Callable[..., Any]) -> FastKernel:
    """As `kernel`, for one that takes seconds to compile: on a CPU LLVM alone optimizes it, in a quarter of the time.

    Serial and parallel variants of its loops may differ in their last bits.
    """
    return FastKernel(ti.kernel(with_fields_as_arguments(function)), is_large=True)


class HostArraysKernel(FastKernel):
    """A kernel whose arrays may also be numpy's, of other sizes in every launch.

    On a CPU their addresses are passed where others were before; elsewhere Taichi copies them there and back.

    Raises:
        TypeError: an array is of another type, has more or fewer axes, or is not stored row by row.
    """

    def later(self, *args: Any) -> Callable[[], Any]:
        """Launch; what is returned is called for the result."""
        program = self._enter_program()
        used = self._used(args)
        if not any(isinstance(used[index], np.ndarray) for index, _ in self._arrays):
            return super().later(*args)
        if not self._on_cpu:
            result = self._primal(*flattened(args))
            return lambda: result
        key = self._key(used)
        compiled = self._compiled.get(key)
        if compiled is None:
            result = self._first_call(program, args)
            return lambda: result
        kernel, executable, _ = compiled
        launch = self._launches.get(key)
        if launch is None:
            make_context = kernel.make_launch_context
            launch = _Launch(executable, make_context, make_context(), [None] * len(used), [], ())
            self._launches[key] = launch
        context, passed = launch.context, launch.numbers
        for index, place in self._arrays:
            array, before = used[index], passed[index]
            if not isinstance(array, np.ndarray):
                if isinstance(before, weakref.ref) and before() is array:
                    continue
                size, shape = array.arr.nelement() * array.arr.element_size(), array.shape
                address, passed[index] = program.get_ndarray_data_ptr_as_int(array.arr), weakref.ref(array)
            else:
                kind, axes, of_elements = self._host_types[place]
                if array.dtype != kind or array.ndim != axes or not array.flags.c_contiguous:
                    raise TypeError(f"{self.__name__} got an array of {array.ndim} axes of {array.dtype}, takes {kind}")
                size, shape = array.nbytes, array.shape[: axes - of_elements]
                address = array.__array_interface__["data"][0]
                if before == (address, shape):
                    continue
                passed[index] = address, shape
            context.set_arg_external_array_with_shape(place, address, size, shape, 0)
        self._pass_numbers(context, used, passed)
        program.launch_kernel(executable, context)
        return functools.partial(self._result, program, None, context, 0)

    def _sort_arguments(self) -> None:
        self._host_types: dict[tuple[int], tuple[np.dtype[Any], int, int]] = {}  # numpy's, its axes, those of elements
        super()._sort_arguments()

    def _sort_argument(self, index: int, place: int, annotation: Any) -> None:
        super()._sort_argument(index, place, annotation)
        if isinstance(annotation, NdarrayType):
            of_elements = annotation.dtype.ndim if isinstance(annotation.dtype, MatrixType) else 0
            kind = annotation.dtype.dtype if of_elements else annotation.dtype
            self._host_types[place,] = np.dtype(to_numpy_type(kind)), annotation.ndim + of_elements, of_elements

    def _key(self, used: Sequence[Any]) -> tuple[Any, ...]:
        """Compile-time values alone: these kernels name the types of all arrays."""
        return tuple(used[index] for index in self._templates)


def kernel_of_host_arrays(function: Callable[..., Any]) -> HostArraysKernel:
    """Decorator in place of `ti.kernel`: bundles may hold numpy's arrays, too."""
    return HostArraysKernel(ti.kernel(with_fields_as_arguments(function)))
