"""Kernel launches that cost little of the host's time.

Taichi looks at every argument of every call several times: the launch of a kernel with 17 arguments takes 0.14 ms of
Python, longer than the kernel itself runs on a GPU for 100 000 particles. `fast_launch` has Taichi check the types of
a call once, and from then on hands the arguments of calls with the same types straight to the runtime.
Measurements: docs/performance.md.

This is the only place that uses Taichi's internals; the lock file pins the release that they belong to.
"""

import functools
from typing import Any

import taichi as ti
from taichi.lang import impl
from taichi.lang.matrix import VectorType
from taichi.types import primitive_types
from taichi.types.ndarray_type import NdarrayType


class FastKernel:
    """A kernel that remembers what Taichi compiled for the types of its arguments; called as the kernel itself.

    Arguments are arrays made by Taichi, numbers, vectors and compile-time values, all of them by position; the result
    is nothing, a number or a vector.
    """

    def __init__(self, kernel: Any) -> None:
        functools.update_wrapper(self, kernel)
        self._kernel, self._primal = kernel, kernel._primal
        self._program: Any = None
        self._compiled: dict[tuple[Any, ...], tuple[Any, Any]] = {}
        self._templates: list[int] = []
        self._arrays: list[tuple[int, tuple[int]]] = []
        self._floats: list[tuple[int, tuple[int]]] = []
        self._integers: list[tuple[int, tuple[int]]] = []
        self._float_vectors: list[tuple[int, list[tuple[int, int]]]] = []
        self._integer_vectors: list[tuple[int, list[tuple[int, int]]]] = []
        for index, argument in enumerate(self._primal.arguments):
            self._sort_argument(index, argument.annotation)

    def __call__(self, *args: Any) -> Any:
        """Launch; waits for the device only where the kernel returns something."""
        program = impl.get_runtime().prog
        if program is not self._program:
            self._program, self._compiled = program, {}
        types = [(args[index].element_type, len(args[index].shape)) for index, _ in self._arrays]
        key = (*[args[index] for index in self._templates], *types)
        compiled = self._compiled.get(key)
        if compiled is None:
            # This way Taichi checks the types, compiles, and says what is wrong.
            result = self._kernel(*args)
            kernel = self._primal.compiled_kernels[self._primal.ensure_compiled(*args)]
            self._compiled[key] = kernel, program.compile_kernel(program.config(), program.get_device_caps(), kernel)
            return result
        context = compiled[0].make_launch_context()
        self._pass_arguments(context, args)
        program.launch_kernel(compiled[1], context)
        if self._primal.return_type is None:
            return None
        impl.get_runtime().sync()
        return self._primal.construct_kernel_ret(context, self._primal.return_type[0], (0,))

    def _sort_argument(self, index: int, annotation: Any) -> None:
        """Note how argument `index` is passed, and at which place among those that are not compile-time values."""
        if isinstance(annotation, ti.template):
            self._templates.append(index)
            return
        place = index - len(self._templates)
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
            raise TypeError(f"fast_launch cannot pass arguments of type {annotation}")

    def _pass_arguments(self, context: Any, args: tuple[Any, ...]) -> None:
        for index, place in self._arrays:
            context.set_arg_ndarray(place, args[index].arr)
        for index, place in self._floats:
            context.set_arg_float(place, args[index])
        for index, place in self._integers:
            context.set_arg_int(place, args[index])
        for index, places in self._float_vectors:
            for place, component in zip(places, args[index], strict=True):
                context.set_struct_arg_float(place, component)
        for index, places in self._integer_vectors:
            for place, component in zip(places, args[index], strict=True):
                context.set_struct_arg_int(place, component)


def fast_launch(kernel: Any) -> FastKernel:
    """Decorator that stands above `ti.kernel`.

    Raises:
        TypeError: the kernel takes arguments of a type that it cannot pass.
    """
    return FastKernel(kernel)
