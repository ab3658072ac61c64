"""How fast `pipeline live` steps and shows a cloth over a ball that is moved; JSON on the standard output.

    python -m benchmarks.live --nodes 100 --substeps 20 8 4 --cores 2 [--without-self-collision] [--without-viewer]

A square metre of cotton, pinned at two corners, falls onto a ball, which is then dragged to and fro under it; each for
some seconds of wall time. The loop is that of the command, with its page, and a client in another process that takes
what browsers get. Speed is capped at real time, as it is there: `frames_per_second` counts computed frames,
`shown_per_second` those that went to the client, `real_time` is simulated over wall time; `frame_ms` is the median of a
frame's computation, `processor_ms` the processor time of all threads a frame, page included. The load of the machine
stands beside them.
"""

import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.compare import arguments_of, machine, run
from pipeline.job.loading import read_job
from pipeline.web.live.admission import live_job
from pipeline.web.live.page import LivePage
from pipeline.web.live.recording import Recorder
from pipeline.web.live.running import run as run_loop
from pipeline.web.live.session import Session
from pipeline.web.serving import in_its_loop, page_server
from sim.core.runtime import initialize

JOB = """
name = "live"
fps = {fps}
[domain]
min = [-1.0, -1.0, 0.0]
max = [1.0, 1.0, 1.5]
open_faces = ["x-", "x+", "y-", "y+", "z+"]
[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.2 }}
position = [0.0, 0.0, 0.6]
[[cloth]]
name = "sheet"
shape = {{ type = "rectangle", size = [1.0, 1.0], counts = [{nodes}, {nodes}] }}
position = [0.0, 0.0, 0.9]
substeps = {substeps}
thickness = 3e-3
self_collision = {self_collision}
[[cloth.pin]]
region = {{ type = "sphere", position = [-0.5, 0.5, 0.9], radius = 0.04 }}
[[cloth.pin]]
region = {{ type = "sphere", position = [0.5, 0.5, 0.9], radius = 0.04 }}
"""

CLIENT = """
import sys, viser
from websockets.sync.client import connect
with connect(sys.argv[1], subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None) as page:
    while True:
        print(len(page.recv()), flush=True)
"""


class Counted:
    """A page that counts what it shows."""

    def __init__(self, page: LivePage) -> None:
        self._page, self.shown, self.show_s = page, 0, 0.0

    def show(self) -> None:
        began = time.perf_counter()
        self._page.show()
        self.show_s += time.perf_counter() - began
        self.shown += 1

    def tell(self) -> None:
        self._page.tell()


def measure(session: Session, page: Counted, seconds: float, *, drags: bool) -> dict[str, Any]:
    """Run for so many seconds of wall time, with the ball in hand or not."""
    times: list[float] = []
    substeps: list[int] = []
    strains: list[float] = []
    processor = time.process_time()
    began, first, page.shown, page.show_s = time.perf_counter(), session.world.frame, 0, 0.0
    seen = first

    def ends() -> bool:
        nonlocal seen
        if session.world.frame != seen:
            seen = session.world.frame
            times.append(session.frame_ms)
            substeps.append(session.substeps["cloth"])
            if session.report is not None:
                strains.append(session.report.diagnostics["cloth"]["max_strain"])
        passed = time.perf_counter() - began
        if drags:
            angle = 2.0 * math.pi * passed / 2.0
            session.ask(
                session.drags.move, "rigid", "ball", (0.2 * math.sin(angle), 0.0, 0.6 + 0.1 * math.sin(2 * angle))
            )
        return passed > seconds

    if drags:
        session.drags.grab("rigid", "ball", (0.0, 0.0, 0.6))
    run_loop(session, page, ends=ends)
    session.drags.release_all()
    wall = time.perf_counter() - began
    frames = session.world.frame - first
    return {
        "frames_per_second": frames / wall,
        "shown_per_second": page.shown / wall,
        "real_time": frames * session.dt / wall,
        "frame_ms": statistics.median(times),
        "processor_ms": 1e3 * (time.process_time() - processor) / max(frames, 1),
        "substeps_taken": statistics.mean(substeps),
        "max_strain": max(strains),
        "show_ms": 1e3 * page.show_s / max(page.shown, 1),
        "message": session.message,
    }


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--substeps", type=int, nargs="+", default=[20, 8, 4])
    parser.add_argument("--fps", type=int, default=60)
    parser.add_argument("--cores", type=int)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--without-self-collision", action="store_true")
    parser.add_argument("--without-viewer", action="store_true")
    arguments = parser.parse_args()
    device = initialize("auto", threads=arguments.cores)
    results = []
    for substeps in arguments.substeps:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "live.toml"
            alone = str(not arguments.without_self_collision).lower()
            path.write_text(
                JOB.format(nodes=arguments.nodes, substeps=substeps, fps=arguments.fps, self_collision=alone)
            )
            loaded = read_job(path)
        session = Session(live_job(loaded.job))
        for _ in range(40):
            session.advance()  # kernels, of contacts as well
        session.reset()
        recorder = Recorder(loaded, session, Path(), device=device)
        with page_server() as server:
            page = in_its_loop(server, LivePage, server, session, recorder, Path())
            address = f"ws://127.0.0.1:{server.get_port()}"
            viewer = None
            if not arguments.without_viewer:
                viewer = subprocess.Popen([sys.executable, "-c", CLIENT, address], stdout=subprocess.PIPE, text=True)
                assert viewer.stdout is not None
                viewer.stdout.readline()  # it has got the scene
            counted = Counted(page)
            try:
                falls = measure(session, counted, arguments.seconds, drags=False)
                dragged = measure(session, counted, arguments.seconds, drags=True)
            finally:
                sent = []
                if viewer is not None:
                    viewer.terminate()
                    sent = [int(line) for line in viewer.communicate()[0].split()]
        result = {"substeps": substeps, "falls": falls, "dragged": dragged}
        results.append({**result, "messages_to_viewer": len(sent), "bytes_to_viewer": sum(sent)})
    return {
        **machine(device),
        "nodes": arguments.nodes**2,
        "fps": arguments.fps,
        "cores": arguments.cores or len(os.sched_getaffinity(0)),
        "self_collision": not arguments.without_self_collision,
        "results": results,
    }


if __name__ == "__main__":
    run(main)
