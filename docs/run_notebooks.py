"""Run notebooks as plain Python, each cell in turn in one namespace, and say what took how long.

    python docs/run_notebooks.py docs/notebooks/*.ipynb           # fails where a cell fails
    python docs/run_notebooks.py --write docs/notebooks/*.ipynb   # keeps what cells printed and drew in the files

Needs matplotlib, and no kernel. What a cell shows is what it prints and the figures that it leaves open.
"""

import argparse
import base64
import contextlib
import io
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

DPI = 70


def run(path: Path) -> dict[str, Any]:
    """The notebook with the outputs of its code cells; raises what a cell raises, with its number."""
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] != "code":
            continue
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                exec(compile("".join(cell["source"]), f"{path.name}[{number}]", "exec"), namespace)  # noqa: S102
        except Exception as error:
            error.add_note(f"in cell {number} of {path}")
            raise
        cell["outputs"] = [*_text(printed.getvalue()), *_figures()]
    return notebook


def _text(printed: str) -> list[dict[str, Any]]:
    return [{"name": "stdout", "output_type": "stream", "text": printed.splitlines(keepends=True)}] if printed else []


def _figures() -> list[dict[str, Any]]:
    outputs = []
    for number in plt.get_fignums():
        picture = io.BytesIO()
        plt.figure(number).savefig(picture, format="png", dpi=DPI, metadata={"Software": None})
        data = {"image/png": base64.b64encode(picture.getvalue()).decode(), "text/plain": ["<Figure>"]}
        outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return outputs


def main() -> None:
    """Run the notebooks that are named, in an empty folder each."""
    parser = argparse.ArgumentParser(description="Run notebooks as plain Python.")
    parser.add_argument("notebooks", nargs="+", type=Path)
    parser.add_argument("--write", action="store_true", help="keep the outputs in the files")
    arguments = parser.parse_args()
    for path in map(Path.absolute, arguments.notebooks):
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            notebook = run(path)
        if arguments.write:
            path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        shown = sum(len(cell.get("outputs", ())) for cell in notebook["cells"])
        print(f"{path.name}: {shown} outputs, {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    # What runs in the background of a job imports the program as this process does.
    os.environ.setdefault("MPLBACKEND", "Agg")
    main()
