"""Documents for Blender: what is refused, and that the file is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from blender_scripts.documents import read_document
from blender_scripts.errors import RenderInputError


def test_a_document_of_the_wanted_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "0.json"
    path.write_text('{"version": 2, "frame": 0}', encoding="utf-8")
    assert read_document(path, "poses", version=2) == {"version": 2, "frame": 0}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b'{"version": 2', "not JSON: "),
        (b'{"version": 2, "name": "\xff"}', "not JSON: "),
        (b'{"version": 1}', "version 1, and 2 is needed"),
        (b'{"frame": 0}', "version None, and 2 is needed"),
        (b"[2]", "version None, and 2 is needed"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_file(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "0.json"
    path.write_bytes(content)
    with pytest.raises(RenderInputError) as refused:
        read_document(path, "poses", version=2)
    assert str(refused.value).startswith(f"the poses {path}: {complaint}")


def test_a_file_that_is_not_there_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(RenderInputError, match=r"^cannot read the poses .*absent\.json: No such file"):
        read_document(tmp_path / "absent.json", "poses", version=2)
