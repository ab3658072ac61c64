"""The child process that makes one preview movie: `REQUEST_FILE`; prints the processor time that it took [s]."""

import json
import os
import sys
import threading
import time
from pathlib import Path

from pipeline.base.files import sync

_NICENESS = 10
"""What the tasks leave over, and a tenth of a core where they leave nothing."""


def main() -> None:
    """Make the film; the last line is for the runner, also that of an error."""
    threading.Thread(target=_end_with_runner, daemon=True).start()
    os.nice(_NICENESS)
    from render.errors import InvalidFileError
    from render.preview_movie import write_preview_movie

    request = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    pictures = {int(frame): Path(picture) for frame, picture in request["pictures"].items()}
    output = Path(request["output"])
    try:
        write_preview_movie(pictures, request["frames"], output, fps=request["fps"], copies=output.parent)
        sync(output)
    except (InvalidFileError, OSError) as error:
        sys.exit(str(error))
    print(time.process_time())


def _end_with_runner() -> None:
    """Standard input ends when the runner does, however that came about: nobody wants the film then."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)
