"""A whole job on a machine with two GPUs: its Blender says that it has them, and draws with the processor."""

from __future__ import annotations

import stat
import sys
import textwrap
from pathlib import Path

import pytest
from command_line import pipeline
from needed_blender import needs_bpy

from pipeline.base.layout import JobLayout
from pipeline.model import gpus
from pipeline.stages.gpu_kernels import kernels_marker
from pipeline.store.receipts import read_receipt

pytestmark = [needs_bpy, pytest.mark.slow]

CARD = "NVIDIA H100"
JOB = """
name = "ball"
device = "cpu"
frames = 4
render = { resolution = [64, 36], quality = "draft", samples = 1 }
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
"""


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """This environment's own Blender with the command line of the executable, and with two GPUs as far as it says.

    Each process that draws leaves a file that is named by the GPU that it was told to use.
    """
    script = tmp_path / "blender"
    script.write_text(
        f"#!{sys.executable}\n"
        + textwrap.dedent(
            f"""
            import json, os, runpy, sys
            from pathlib import Path
            if sys.argv[1:] == ["--version"]:
                print("Blender 5.0.1")
                sys.exit()
            path = Path(sys.argv[sys.argv.index("--python") + 1])
            sys.path.insert(0, str(path.parents[1]))
            if path.name == "gpus.py":
                cards = [{{"name": "{CARD}", "id": slot}} for slot in "ab"]
                print("GPUS", json.dumps({{"backend": "OPTIX", "devices": cards}}))
                print("GPUS_DONE 5.0.1")
                sys.exit()
            from blender_scripts import gpus
            def choose(wanted, gpu):
                Path("{tmp_path}", f"{{wanted}}-{{gpu}}-{{os.getpid()}}").touch()
                return "OPTIX: {CARD}"
            gpus.choose_device = choose
            runpy.run_path(str(path), run_name="__main__")
            """
        )
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return script


def test_two_gpus_have_a_renderer_each_one_compiles_and_each_frame_says_what_drew_it(tmp_path, monkeypatch, blender):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(gpus, "_device_files", lambda: ["/dev/nvidia0"])
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(4)))  # cores for two renderers
    (tmp_path / "ball.toml").write_text(JOB)
    layout = JobLayout(tmp_path / "renders" / "ball")
    for seed, device in enumerate(("auto", "gpu")):  # what was simulated for the first is drawn anew for the second
        keys = {"blender": blender, "device": device, "seed": seed}
        options = [word for key, value in keys.items() for word in ("--set", f"render.{key}={value}")]
        result = pipeline("submit", tmp_path / "ball.toml", "--farm", tmp_path / "renders", *options)
        assert result.exit_code == 0, result.stderr
        assert result.stderr.count(f"render: compiling Cycles' kernels for {CARD}; minutes, once") == 1
        assert kernels_marker(f"OPTIX: {CARD}", "5.0.1").exists()
        used = sorted(path.name.rpartition("-")[0] for path in tmp_path.glob(f"{device}-*"))
        assert used == [f"{device}-0", f"{device}-1"]
        receipts = [read_receipt(layout, layout.picture(frame)) for frame in range(4)]
        assert {receipt and receipt.device for receipt in receipts} == {f"OPTIX: {CARD}"}
        logs = [path.read_text() for path in (layout.root / "logs" / "render").glob(f"*.{seed + 1}.log")]
        assert len(logs) == 4 and all(f"Cycles draws on OPTIX: {CARD}, GPU " in log for log in logs)
        assert f"drawn on OPTIX: {CARD}" in pipeline("explain", layout.root, "render/000003").stdout
        kernels_marker(f"OPTIX: {CARD}", "5.0.1").unlink()
