"""Notebooks and the library's page: every cell and every block runs as it stands."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import PROJECT

NOTEBOOKS = sorted((PROJECT / "docs" / "notebooks").glob("*.ipynb"))

pytestmark = pytest.mark.slow


def run(*arguments: object, cwd: Path) -> str:
    search_path = os.pathsep.join(filter(None, [str(PROJECT), os.environ.get("PYTHONPATH")]))
    completed = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": search_path, "CUDA_VISIBLE_DEVICES": ""},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr
    return completed.stdout


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_shows_as_much_as_it_keeps(notebook, tmp_path):
    kept = [len(cell.get("outputs", ())) for cell in json.loads(notebook.read_text())["cells"]]
    assert f"{notebook.name}: {sum(kept)} outputs" in run(PROJECT / "docs" / "run_notebooks.py", notebook, cwd=tmp_path)


def test_code_on_the_page_of_the_library_runs_in_order(tmp_path):
    page = (PROJECT / "docs" / "guide" / "library.md").read_text(encoding="utf-8")
    program = tmp_path / "page.py"
    program.write_text("\n".join(re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)))
    assert "0.017 s: the wave is at 0.29 m" in run(program, cwd=tmp_path)
    assert (tmp_path / "renders" / "dam" / "cache" / "000030.h5").exists()


def test_readme_shows_the_first_block_of_that_page():
    blocks = [
        re.search(
            r"^```python\n.*?^```", (PROJECT / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ).group()
        for page in ("README.md", "docs/guide/library.md")
    ]
    assert blocks[0] == blocks[1]
