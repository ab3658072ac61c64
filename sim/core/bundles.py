"""Bundles: arrays and numbers that belong together, as one argument of kernels and device functions.

A bundle is a named tuple whose fields have types that kernels take, other bundles among them:

    @bundle
    class Particles(NamedTuple):
        x: Vectors        # positions [m], (n,)
        m: Floats         # masses [kg], (n,)

    @func
    def weight(p: Particles, i: ti.i32):
        return 9.81 * p.m[i]

    @kernel               # sim.core.launch
    def fall(p: Particles, dt: ti.f32): ...

    fall(Particles(x, m), dt)

A kernel that takes bundles is compiled as if each of their fields were an argument of its own, so bundling changes
neither what the device does nor a bit of the result (docs/decisions/0037-kernel-arguments.md). This relies on how
Taichi 1.7 reads the source of a kernel, as `sim.core.runtime` does.
"""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import taichi as ti
from taichi.lang import kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.exception import TaichiSyntaxError

SEPARATOR = "__"  # between the names of a bundle and its field, in that of an argument

NamedTupleType = TypeVar("NamedTupleType", bound=type)


def bundle(named_tuple: NamedTupleType) -> NamedTupleType:
    """Make a named tuple of kernel types a type of arguments itself."""
    named_tuple.__bundled__ = inspect.get_annotations(named_tuple, eval_str=True)  # type: ignore[attr-defined]
    return named_tuple


def with_room(kind: Any, places: int, **given: Any) -> Any:
    """A bundle whose arrays have so many places, one at least, all of them 0, but for the fields that are given."""
    return kind(
        **{
            field: given[field] if field in given else ti.ndarray(array.dtype, max(places, 1))
            for field, array in kind.__bundled__.items()
        }
    )


def is_bundle(kind: Any) -> bool:
    """Whether a type was made by `bundle`."""
    return hasattr(kind, "__bundled__")


def flattened(values: tuple[Any, ...]) -> Iterator[Any]:
    """Values with each bundle replaced by its fields, in order."""
    for value in values:
        if is_bundle(value):
            yield from flattened(value)
        else:
            yield value


def func(function: Callable[..., Any]) -> Any:
    """Decorator in place of `ti.func`: the function may take bundles, all of them by reference."""
    signature = inspect.signature(function, eval_str=True)
    parameters = [
        parameter.replace(annotation=ti.template()) if is_bundle(parameter.annotation) else parameter
        for parameter in signature.parameters.values()
    ]
    function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return ti.func(function)


def with_fields_as_arguments(function: Callable[..., Any]) -> Callable[..., Any]:
    """Tell Taichi, before it makes a kernel of a function, that the fields of bundles are its arguments."""
    signature = inspect.signature(function, eval_str=True)
    annotations = [parameter.annotation for parameter in signature.parameters.values()]
    kinds = tuple(kind if is_bundle(kind) else None for kind in annotations)
    if any(kinds):
        parameters = [
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=kind)
            for parameter in signature.parameters.values()
            for name, kind in _leaves(parameter.name, parameter.annotation)
        ]
        function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        function.__bundles__ = kinds  # type: ignore[attr-defined]
        function.__used__ = set()  # type: ignore[attr-defined]
    return function


def is_used(function: Callable[..., Any], argument: str) -> bool:
    """Whether a kernel reads an argument, as far as it was compiled: of bundles often only a few fields."""
    return SEPARATOR not in argument or argument in getattr(function, "__used__", ())


def field_paths(kind: Any, prefix: str = "") -> Iterator[str]:
    """Dotted paths of the fields of a bundle that are arguments of kernels, in order."""
    for field, field_kind in kind.__bundled__.items():
        if is_bundle(field_kind):
            yield from field_paths(field_kind, f"{prefix}{field}.")
        else:
            yield f"{prefix}{field}"


def _leaves(name: str, kind: Any) -> Iterator[tuple[str, Any]]:
    """Names and types of the arguments that an argument becomes."""
    if is_bundle(kind):
        for field, field_kind in kind.__bundled__.items():
            yield from _leaves(f"{name}{SEPARATOR}{field}", field_kind)
    else:
        yield name, kind


class _Fields:
    """A bundle while a kernel is compiled: its fields are the kernel's arguments; those that it reads become `used`."""

    def __init__(self, name: str, kind: Any, context: Any, used: set[str]) -> None:
        self._name, self._kinds, self._context, self._used = name, kind.__bundled__, context, used

    def __getattr__(self, field: str) -> Any:
        kind = self._kinds.get(field)
        if kind is None:
            raise AttributeError(f"{self._name.replace(SEPARATOR, '.')} has no field {field}")
        name = f"{self._name}{SEPARATOR}{field}"
        if is_bundle(kind):
            return _Fields(name, kind, self._context, self._used)
        self._used.add(name)
        return self._context.get_var_by_name(name)


def _read_source(kernel: Any, *args: Any, **keywords: Any) -> tuple[ast.Module, Any]:
    """As Taichi reads the source of a kernel or device function, but with the fields of bundles as arguments.

    That of a function is read once, not for each call that kernels have of it, thousands in all.
    """
    if keywords.get("is_kernel") is False:
        tree, place = _source_of(kernel.func)
        return tree, ASTTransformerContext(
            is_kernel=False,
            func=kernel,
            global_vars=kernel_impl._get_global_vars(kernel.func),
            argument_data=keywords["args"],
            ast_builder=keywords["ast_builder"],
            **place,
        )
    tree, context = _taichi_reads_source(kernel, *args, **keywords)
    kinds = getattr(kernel.func, "__bundles__", ())
    if kinds:
        arguments = tree.body[0].args
        written, arguments.args = arguments.args, []
        for argument, kind in zip(written, kinds, strict=True):
            for name, _ in _leaves(argument.arg, kind):
                arguments.args.append(ast.copy_location(ast.arg(name, argument.annotation), argument))
            if kind is not None:
                context.global_vars[argument.arg] = _Fields(argument.arg, kind, context, kernel.func.__used__)
    return tree, context


@functools.cache
def _source_of(function: Callable[..., Any]) -> tuple[ast.Module, dict[str, Any]]:
    """Tree of a device function, and where it stands as contexts have it."""
    lines, first = inspect.getsourcelines(function)
    tree = ast.parse(textwrap.dedent("".join(lines)))
    tree.body[0].decorator_list = []  # type: ignore[attr-defined]
    return tree, {"file": inspect.getsourcefile(function), "src": lines, "start_lineno": first}


def _trace(tree: ast.Module, context: Any) -> Any:
    """As Taichi traces a kernel or a function, which writes into the tree. Raises TaichiSyntaxError where a function
    calls itself."""
    if tree in _traced:
        raise TaichiSyntaxError(f"{context.func.func.__name__} calls itself; device functions cannot")
    _traced.append(tree)
    try:
        return _taichi_traces(tree, context)
    finally:
        _traced.pop()


_traced: list[ast.Module] = []  # the kernel that is traced, the function that it calls, and so on
_taichi_reads_source, _taichi_traces = kernel_impl._get_tree_and_ctx, kernel_impl.transform_tree
kernel_impl._get_tree_and_ctx, kernel_impl.transform_tree = _read_source, _trace
