"""Ctrl-C before the command line has been loaded."""

import os
import signal
import subprocess
import sys

import pytest

INTERRUPTED_AS_IT_LOADS = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "click":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize("command", [["-m", "pipeline"], ["-c", "from pipeline.__main__ import main; main()"]])
def test_ctrl_c_while_commands_load_ends_the_process_without_a_traceback(tmp_path, command):
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTED_AS_IT_LOADS)
    paths = os.pathsep.join(filter(None, [str(tmp_path), *sys.path]))
    ended = subprocess.run(
        [sys.executable, *command],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert ended.returncode == -signal.SIGINT
    assert (ended.stdout, ended.stderr) == ("", "")
