"""OpenVDB's files: a write that the library did not finish does not go unnoticed."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import HELPERS, PROJECT

from render import vdb_file
from render.errors import InvalidFileError, VolumeUnavailableError
from render.volume import import_openvdb

try:
    import_openvdb()
except VolumeUnavailableError as error:
    pytestmark = pytest.mark.skip(reason=str(error))


def unsigned(path: Path, grids: int = 2) -> Path:
    openvdb = import_openvdb()
    made = []
    for index in range(grids):
        made.append(openvdb.FloatGrid())
        made[-1].name = f"grid{index}"
        made[-1].copyFromArray(np.random.default_rng(index).uniform(1, 2, (20, 20, 20)).astype(np.float32))
    openvdb.write(str(path), made, {"note": "some metadata", "fps": 60.0})
    return path


@pytest.mark.parametrize("grids", [0, 1, 3])
def test_a_whole_file_is_signed_and_then_passes(tmp_path, grids):
    path = unsigned(tmp_path / "a.vdb", grids)
    size = path.stat().st_size
    with pytest.raises(InvalidFileError, match="truncated or changed"):
        vdb_file.check(path)
    vdb_file.sign(path)
    vdb_file.check(path)
    assert path.stat().st_size == size
    _, metadata = import_openvdb().readAll(str(path))
    assert metadata == {"note": "some metadata", "fps": 60.0}


@pytest.mark.parametrize("kept", [58, 70, 130, 200, 0.4, 0.6, -1])
def test_a_file_that_was_cut_while_written_is_not_signed(tmp_path, kept):
    path = unsigned(tmp_path / "a.vdb")
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(OSError, match="could not write the whole file") as raised:
        vdb_file.sign(path)
    assert raised.value.errno == errno.EIO
    with pytest.raises(InvalidFileError):
        vdb_file.check(path)


def test_what_the_disk_refused_is_told_by_its_own_error(tmp_path):
    """A limit on the size of files refuses like a full disk, in the middle of a write, with EFBIG for ENOSPC."""
    script = f"""
import resource, signal, sys
sys.path[:0] = [{str(HELPERS)!r}, {str(Path(__file__).parent)!r}]
from pathlib import Path
from render import vdb_file
from test_vdb_file import unsigned
whole = unsigned(Path("whole.vdb")).stat().st_size
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (whole // 2, whole // 2))
path = unsigned(Path("cut.vdb"))  # raises nothing: this is the trap
assert path.stat().st_size < whole
vdb_file.sign(path)
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        check=False,
        cwd=tmp_path,
        env={"PYTHONPATH": str(PROJECT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert f"OSError: [Errno {errno.EFBIG}]" in done.stderr
