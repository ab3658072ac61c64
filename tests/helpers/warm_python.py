"""A Python that stays warm between pieces of code: Blender takes seconds to import, and its scenes follow each other.

Code runs in a namespace of its own and may open any number of scenes one after another, as a worker does. What must not
share a process with anything before it is for `fresh_python`.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import tempfile
import textwrap
from functools import cache
from typing import IO

from places import PROJECT

_SERVE = """
import contextlib, io, json, os, sys, traceback
answers = os.fdopen(int(sys.argv[1]), "w")
for line in sys.stdin:
    request = json.loads(line)
    sys.argv, printed, error = ["-c", *request["arguments"]], io.StringIO(), ""
    try:
        with contextlib.redirect_stdout(printed):
            exec(compile(request["code"], "<test>", "exec"), {"__name__": "__main__"})
    except BaseException:
        error = traceback.format_exc()
    print(json.dumps({"printed": printed.getvalue(), "error": error}), file=answers, flush=True)
"""


class _WarmPython:
    def __init__(self) -> None:
        answers, theirs = os.pipe()
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, str(theirs)],
            cwd=PROJECT,
            stdin=subprocess.PIPE,
            stdout=self._log,
            stderr=self._log,
            text=True,
            pass_fds=(theirs,),
        )
        os.close(theirs)
        self._answers = os.fdopen(answers)
        atexit.register(self.close)

    def run(self, code: str, arguments: tuple[str, ...]) -> str:
        assert self._process.stdin is not None
        print(json.dumps({"code": code, "arguments": arguments}), file=self._process.stdin, flush=True)
        line = self._answers.readline()
        if not line:
            _warm_python.cache_clear()
            self._log.seek(0)
            raise AssertionError(f"Python ended: {self._process.wait()}\n{self._log.read().decode()[-4000:]}")
        answer = json.loads(line)
        assert not answer["error"], answer["printed"] + answer["error"]
        return str(answer["printed"])

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._answers.close()
        self._log.close()


@cache
def _warm_python() -> _WarmPython:
    return _WarmPython()


def run_python(code: str, *arguments: str) -> str:
    """Run code with its assertions in the warm Python of this session, from the project's folder.

    Args:
        code: the program; it may be indented.
        arguments: its `sys.argv[1:]`.

    Returns:
        What it printed.
    """
    return _warm_python().run(textwrap.dedent(code), arguments)
