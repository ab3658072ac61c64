"""Cost of a picture of a scene on the line to a browser."""

from struct import unpack_from

import numpy as np
import viser
from live_jobs import loaded
from websockets.sync.client import ClientConnection, connect
from zstandard import ZstdDecompressor

from pipeline.web.live.scene import LiveScene
from pipeline.web.serving import page_server
from sim.core.snapshots import Snapshot

SHEET = """\
name = "drape"
[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [1.0, 1.0], counts = [100, 100] }
position = [0.0, 0.0, 0.5]
[[cloth.pin]]
edge = "y-"
"""
HEADER_BYTES = 16
"""Lengths of what viser has packed, before and after that; arrays follow it."""
NODES, EDGE = 100 * 100, np.arange(100)


def test_a_moved_sheet_costs_its_positions_and_no_triangles(tmp_path):
    job = loaded(tmp_path, SHEET).job
    first = np.arange(NODES).reshape(100, 100)[:-1, :-1].ravel()
    triangles = np.concatenate([first[:, None] + [0, 1, 100], first[:, None] + [1, 101, 100]]).astype(np.int32)
    with page_server(port=0, label="drape") as server:
        drawing, end = LiveScene(server, job, job.placed_camera, lambda *_: None), server.gui.add_markdown("")
        address = f"ws://127.0.0.1:{server.get_port()}"
        versions = [f"viser-v{viser.__version__}"]
        with connect(address, subprotocols=versions, max_size=None, compression=None, max_queue=None) as browser:
            sizes = []
            for number in range(4):
                position = np.random.default_rng(number).uniform(size=(NODES, 3)).astype(np.float32)
                sheet = Snapshot("cloth", {"position": position, "triangles": triangles.copy()}, {})
                drawing.show({"sheet": sheet}, {0: ("sheet", EDGE)})
                end.content = f"end of picture {number}"
                sizes.append(bytes_until(browser, end.content.encode()))
    assert sizes[0] > 12 * (NODES + len(triangles))  # the first one has them, so that they would be seen
    assert all(12 * NODES <= size <= 1.1 * 12 * NODES for size in sizes[1:]), sizes


def bytes_until(browser: ClientConnection, end: bytes) -> int:
    """How much comes up to and with a message that has this in it: viser packs all but arrays."""
    size = 0
    while True:
        message = browser.recv(timeout=60.0)
        assert isinstance(message, bytes)
        size += len(message)
        _, packed = unpack_from("<QQ", message)
        if end in ZstdDecompressor().decompress(message[HEADER_BYTES : HEADER_BYTES + packed]):
            return size
