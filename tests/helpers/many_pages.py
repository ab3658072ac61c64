"""Many pages that come and go at a live session, some of which send what cannot be read: counts, as JSON.

    python tests/helpers/many_pages.py [--pages 200] [--minutes 10] [--seed 1]

Fails if the session ends, prints a traceback, stands still, or refuses a page at the end.
"""

import argparse
import asyncio
import json
import random
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil
import viser
from live_jobs import BALL_OVER_SHEET
from places import PROJECT
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

PROTOCOL = f"viser-v{viser.__version__}"
MALFORMED = (b"", b"\xc1", b"\x81\xa4type\xa4none", b"\x92\x80\x00", b"\xff" * 4096, b"\xdd\xff\xff\xff\xff", "text")
"""Nothing, bytes that msgpack never begins with, a message of no kind, a list cut short, 4e9 elements, text."""
STAYS_S = 6.0
"""How long a page stays at most [s]."""


async def crowd(address: str, *, pages: int, seconds: float, seed: int) -> Counter[str]:
    """So many pages at a time at a session, each of which leaves after a while and comes again; what they saw."""
    seen: Counter[str] = Counter()
    until = time.monotonic() + seconds

    async def one(chance: random.Random) -> None:
        await asyncio.sleep(chance.uniform(0.0, min(STAYS_S, seconds / 2.0)))
        while time.monotonic() < until:
            try:
                async with connect(address, subprotocols=[PROTOCOL], max_size=None, compression=None) as page:
                    seen["visits"] += 1
                    await _stay(page, chance, seen)
                    if chance.random() < 0.3:
                        page.transport.abort()  # as a browser that is killed
            except ConnectionClosed:
                seen["closed by the session"] += 1
            except (InvalidHandshake, OSError, TimeoutError):
                seen["refused"] += 1
                await asyncio.sleep(0.5)

    await asyncio.gather(*(one(random.Random(f"{seed}/{number}")) for number in range(pages)))
    return seen


async def _stay(page: ClientConnection, chance: random.Random, seen: Counter[str]) -> None:
    leaves = time.monotonic() + chance.uniform(0.0, STAYS_S)
    if chance.random() < 0.25:
        await page.send(chance.choice(MALFORMED))
        seen["malformed"] += 1
    while (left := leaves - time.monotonic()) > 0.0:
        try:
            await asyncio.wait_for(page.recv(), left)
        except TimeoutError:
            return
        seen["messages"] += 1


def _live(folder: Path, printed: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A session in a process of its own, and its address."""
    job = folder / "drape.toml"
    job.write_text(BALL_OVER_SHEET)
    command = [sys.executable, "-P", "-m", "pipeline", "live", str(job), "--port", "0", "--farm", str(folder)]
    with printed.open("wb") as log:
        process = subprocess.Popen(command, cwd=PROJECT, stdout=log, stderr=log)
    while (found := re.search(r"http://(\S+:\d+)/ runs", printed.read_text())) is None:
        if process.poll() is not None:
            raise SystemExit(printed.read_text())
        time.sleep(0.1)
    return process, f"ws://{found[1]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        printed = Path(name, "printed.txt")
        process, address = _live(Path(name), printed)
        try:
            memory = psutil.Process(process.pid).memory_info
            asyncio.run(crowd(address, pages=1, seconds=5.0, seed=given.seed))
            before = memory().rss
            seen = asyncio.run(crowd(address, pages=given.pages, seconds=60.0 * given.minutes, seed=given.seed))
            last = asyncio.run(crowd(address, pages=1, seconds=5.0, seed=given.seed + 1))
            lives = process.poll() is None
            after = memory().rss if lives else 0
        finally:
            process.terminate()
            process.wait(30)
        text = printed.read_text()
    tracebacks = text.count("Traceback")
    megabytes = {"before": before // 10**6, "after": after // 10**6}
    print(json.dumps({**seen, "lives": lives, "tracebacks": tracebacks, "memory_mb": megabytes}, indent=1))
    if not lives or tracebacks or not last["messages"] or last["refused"]:
        raise SystemExit(text[-4000:])


if __name__ == "__main__":
    main()
