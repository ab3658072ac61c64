"""Taichi's tracing of kernels, in half the time.

When a kernel is called for the first time, Taichi walks through its source and writes down for every expression where
it stands, for the error message that hardly any of them ever gets: the line and a second one that underlines the
expression, both wrapped to 80 columns by `textwrap`, which takes as long as all the rest of the tracing. Here they are
written without wrapping. Every process that simulates traces some hundred kernels before its first step.

Like `sim.core.launch` this uses Taichi's internals; the lock file pins the release that they belong to.
"""

from __future__ import annotations

import ast
from typing import Any


def tell_positions_unwrapped() -> None:
    """Let Taichi describe positions in kernels by their first line, and underline what stands on it."""
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

    ASTTransformerContext.get_pos_info = _position


def _position(context: Any, node: ast.expr | ast.stmt) -> str:
    """File, line and function of a node, its source line, and its part of that line underlined."""
    line = context.src[node.lineno - 1].rstrip()
    start = context.indent + node.col_offset
    one_line = node.end_lineno == node.lineno and node.end_col_offset is not None
    end = context.indent + (node.end_col_offset or 0) if one_line else len(line)
    place = f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:'
    return f"{place}\n{line}\n{' ' * start}{'^' * (end - start)}\n"
