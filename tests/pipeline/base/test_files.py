from pathlib import Path

import pytest

from pipeline.base.files import replace_durably


@pytest.mark.parametrize("content", ["größer\n", "größer\n".encode()])
def test_a_replaced_file_holds_the_new_content_and_leaves_nothing_beside_it(
    tmp_path: Path, content: str | bytes
) -> None:
    path = tmp_path / "job.toml"
    path.write_text("old")
    replace_durably(path, content)
    assert path.read_bytes() == "größer\n".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_two_writers_at_once_do_not_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "parameters.json"
    waiting = ["the other writer's"]

    def sync(each: Path) -> None:
        """In the middle of writing, another one of the same process id writes it, too."""
        if waiting and each.parent == tmp_path:
            replace_durably(path, waiting.pop())

    monkeypatch.setattr("pipeline.base.files.sync", sync)
    replace_durably(path, "ours")
    assert path.read_text() == "ours"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_replacement_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.mkdir()  # which a file cannot replace
    with pytest.raises(OSError):
        replace_durably(path, "new")
    assert list(tmp_path.iterdir()) == [path]
    assert path.is_dir()
