"""`python -m pipeline`, and the command `pipeline`."""

import os
import signal

from pipeline.base.threads import BLAS_THREADS

os.environ.update(BLAS_THREADS)  # before anything loads numpy

_HANDLER = signal.getsignal(signal.SIGINT)
if _HANDLER is signal.default_int_handler:
    # Ctrl-C while the commands are loading ends the process like any other program's, not with a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from pipeline.cli.main import main as commands  # noqa: E402


def main() -> None:
    """Run the command line."""
    signal.signal(signal.SIGINT, _HANDLER)
    commands(prog_name="pipeline")


if __name__ == "__main__":
    main()
