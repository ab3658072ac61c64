"""Spoils the sample jobs in thousands of ways, and lists what becomes of them.

    python tests/helpers/fuzz_jobs.py --seed 1 --count 10000
    python tests/helpers/fuzz_jobs.py --seed 1 --first 4711 --count 1

Each mutation is read; if it still is a valid job file, it is planned, and a share of these (`--scenes`) goes through
all of `pipeline check`, which builds the scene and takes a second or so. Promised are: never a traceback, never a hang,
never a started job or program, nothing written, and every path of an accepted job inside of its folder. Prints a
Markdown table of what was refused and why; exits with 1 if a promise was broken.
"""

import argparse
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import FrameType
from typing import Any

from click.testing import CliRunner
from places import PROJECT

HANG_S = 60.0
"""A check of a sample job takes a second or so."""
HOSTILE = (
    *(
        "-1",
        "0",
        "1",
        "1e400",
        "-1e308",
        "nan",
        "inf",
        "9" * 40,
        "9" * 6000,
        "1e-320",
        "0x7fffffffffffffff",
        "true",
        "1979-05-27",
    ),
    *('""', "[]", "{}", "[[]]", "[" * 200 + "]" * 200, "[0.0, 0.0, 0.0, 0.0]", "[1, 'a']", '{ type = "box" }', "None"),
    *(
        '"../../../etc/passwd"',
        '"/etc/passwd"',
        '"/dev/zero"',
        '"."',
        '".."',
        '"a/b"',
        '"a\\\\b"',
        '"CON"',
        '".hidden"',
    ),
    *('"$(touch PWNED)"', '"; touch PWNED"', '"`touch PWNED`"', '"| touch PWNED"', '"-rf"', '"a\\nb"', '"\\u0000"'),
    *(
        "\"__import__('os').system('touch PWNED')\"",
        '"{0.__class__}"',
        '"%s%n"',
        '"\\u202egpj"',
        '"😀"',
        '"' + "x" * 5000 + '"',
    ),
)
"""Values that a key should not have, or that somebody would try."""
INSERTED = (
    *("[render]\nblender = 'touch'\n", "include = '/etc/passwd'\n", "[a.b.c.d]\n"),
    *("[[", "=", "\x00", "\ufeff", "# \x1b[2J\n"),
    *(".".join("a" * 3000) + " = 1\n", "what = [" + "1, " * 3000 + "]\n", '"\\u001b[2J" = 1\n'),
)
"""Pieces of text, anywhere."""


def change_value(text: str, generator: random.Random) -> str:
    """Another value for a key."""
    keys = [match.span(1) for match in re.finditer(r"=\s*([^#\n]+)", text)]
    start, end = generator.choice(keys)
    return text[:start] + generator.choice(HOSTILE) + text[end:]


def change_key(text: str, generator: random.Random) -> str:
    """Another name for a key or a table."""
    words = [match.span() for match in re.finditer(r"(?m)^\s*\[*[A-Za-z_][\w.]*", text)]
    start, end = generator.choice(words)
    other = generator.choice(words)
    replacement = generator.choice([text[other[0] : other[1]], "__class__", "x", text[start:end] + "_"])
    return text[:start] + replacement + text[end:]


def drop_line(text: str, generator: random.Random) -> str:
    """A line less."""
    lines = text.splitlines(keepends=True)
    del lines[generator.randrange(len(lines))]
    return "".join(lines)


def repeat_line(text: str, generator: random.Random) -> str:
    """A line twice, or somewhere else."""
    lines = text.splitlines(keepends=True)
    lines.insert(generator.randrange(len(lines)), generator.choice(lines))
    return "".join(lines)


def cut_off(text: str, generator: random.Random) -> str:
    """A truncated file."""
    return text[: generator.randrange(len(text))]


def insert(text: str, generator: random.Random) -> str:
    """Something foreign, anywhere."""
    place = generator.randrange(len(text))
    return text[:place] + generator.choice(INSERTED) + text[place:]


def flip_bits(text: str, generator: random.Random) -> str:
    """A few bits of the file flipped; what is no text any more is kept as such by surrogates."""
    content = bytearray(text.encode())
    for _ in range(generator.choice((1, 1, 3))):
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
    return content.decode(errors="surrogateescape")


MUTATIONS: tuple[Callable[[str, random.Random], str], ...] = (
    *(change_value, change_value, change_value, change_value),
    *(change_key, drop_line, repeat_line, cut_off, insert, flip_bits),
)


class HungError(BaseException):
    """A mutation took too long; no `except Exception` of the program may swallow it."""


@dataclass
class Report:
    """What became of the mutations.

    Attributes:
        mutations: how many of each kind.
        refused: how many were refused, by the kind of message.
        accepted: how many still are valid jobs.
        broken: what broke a promise, and by which mutation.
    """

    mutations: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    accepted: int = 0
    broken: list[str] = field(default_factory=list)

    def table(self) -> str:
        """As Markdown."""
        lines = ["| what | mutations |", "|---|---|", f"| accepted: still a valid job | {self.accepted} |"]
        lines += [f"| refused: {kind} | {count} |" for kind, count in self.refused.most_common()]
        return "\n".join([*lines, f"| promises broken | {len(self.broken)} |"])


CHANGES = {f"os.{name}" for name in ("mkdir", "rename", "remove", "rmdir", "link", "symlink", "truncate", "chmod")}


class Watch:
    """Notes what a checked job file must never lead to: programs, connections, files written."""

    def __init__(self) -> None:
        self._armed = False
        self.seen: list[str] = []
        sys.addaudithook(self._hear)

    @contextmanager
    def armed(self) -> Iterator[None]:
        self._armed, self.seen = True, []
        try:
            yield
        finally:
            self._armed = False

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._armed:
            return
        if event in {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect"}:
            self.seen.append(f"{event}{arguments[:1]!r:.200}")
        elif event in CHANGES or (event == "open" and _writes(arguments[1], arguments[2])):
            path = str(arguments[0])
            is_bytecode = "__pycache__" in path or ".pyc" in path  # the latter in a folder of its own
            if not is_bytecode and not path.isdigit() and not path.startswith("/dev/null"):
                self.seen.append(f"{event}{arguments[:3]!r:.200}")


def _writes(mode: object, flags: object) -> bool:
    """Whether a file is opened to be written: by `open`, which has a mode, or by `os.open`, which has none."""
    if isinstance(mode, str):
        return bool(set(mode) & set("wax+"))
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def fuzz(seed: int, count: int, folder: Path, *, first: int = 0, scenes: float = 0.1) -> Report:
    """Make mutations and see what becomes of them.

    Args:
        seed: of the mutations.
        count: how many.
        folder: an empty one.
        first: number of the first one.
        scenes: share of the valid job files whose scene is checked, too.
    """
    from pipeline.base.errors import PipelineError
    from pipeline.base.layout import JobLayout
    from pipeline.cli.main import main as command_line
    from pipeline.job.loading import read_job
    from pipeline.run.checked_job import require_own_programs, require_plannable
    from pipeline.run.plan import plan_job
    from pipeline.stages import STAGES

    samples = {path.name: path.read_text(encoding="utf-8") for path in sorted((PROJECT / "jobs").glob("*.toml"))}
    report = Report()
    watch = Watch()
    runner = CliRunner()
    path = folder / "job-to-be.toml"

    def hung(_number: int, _frame: FrameType | None) -> None:
        raise HungError

    # What libraries start when they are loaded is not the job files' doing.
    for name in ("quickstart.toml", "everything.toml"):
        assert runner.invoke(command_line, ["check", str(PROJECT / "jobs" / name)]).exit_code == 0
    before = signal.signal(signal.SIGALRM, hung)
    try:
        for number in range(first, first + count):
            generator = random.Random(f"{seed}/{number}")  # each can be looked at by itself
            name = generator.choice(sorted(samples))
            mutation = generator.choice(MUTATIONS)
            broken_before = len(report.broken)
            text = mutation(samples[name], generator)
            report.mutations[mutation.__name__] += 1
            path.write_bytes(text.encode(errors="surrogateescape"))
            what = f"seed {seed}, mutation {number} ({mutation.__name__} of {name})"
            signal.setitimer(signal.ITIMER_REAL, HANG_S)
            try:
                with watch.armed():
                    loaded = read_job(path)
                    require_own_programs(loaded, ())
                    require_plannable(loaded)
                    _assert_inside(plan_job(loaded.job, JobLayout(folder / "renders"), STAGES))
                    refusal = (
                        _checked(runner, command_line, path, report, what) if generator.random() < scenes else None
                    )
                if refusal is None:
                    report.accepted += 1
                else:
                    report.refused[_kind(refusal)] += 1
            except PipelineError as error:
                report.refused[_kind(f"error: {error}")] += 1
            except (HungError, Exception) as error:
                report.broken.append(f"{what}: {error!r:.300}")
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            report.broken += [f"{what}: {seen}" for seen in watch.seen]
            left = {each.name for each in folder.iterdir()} - {path.name}
            if left:
                report.broken.append(f"{what}: left {left}")
            for line in report.broken[broken_before:]:
                print(line, file=sys.stderr, flush=True)
            done = number + 1 - first
            if done % 500 == 0:
                print(f"{done} of {count}, {len(report.broken)} broken", file=sys.stderr, flush=True)
    finally:
        signal.signal(signal.SIGALRM, before)
    return report


def _checked(runner: CliRunner, command_line: Any, path: Path, report: Report, what: str) -> str | None:
    """What `pipeline check` says against a job file; None if it accepts it. A traceback breaks a promise."""
    result = runner.invoke(command_line, ["check", str(path)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        report.broken.append(f"{what}: {result.exception!r:.300}")
    return result.stderr if result.exit_code else None


def _assert_inside(tasks: list[Any]) -> None:
    """No path of a plan leads out of the job's folder, and none is hidden in it."""
    for task in tasks:
        for each in (task.id, *task.inputs, *task.outputs):
            parts = PurePosixPath(each).parts
            assert not PurePosixPath(each).is_absolute(), each
            assert not any(part.startswith(".") or "\0" in part for part in parts), each


_KINDS = {
    "names a program": "names a program to run",
    "no such file": "names a file that is not there, or none that can be read",
    "cannot be read": "names a file that is not there, or none that can be read",
    "not UTF-8": "not UTF-8 text",
    "nested too deeply": "nested too deeply",
    "unknown key": "unknown key",
    "is missing": "a key is missing",
    "units are SI": "a number that no scene can have",
    "memory": "larger than the memory",
}


def _kind(message: str) -> str:
    for words, kind in _KINDS.items():
        if words in message:
            return kind
    if re.search(r"toml:\d+:\d+ ", message):
        return "no TOML"
    return "a value that cannot be" if re.search(r"toml:\d+", message) else "the scene is not possible"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutation")
    parser.add_argument("--scenes", type=float, default=0.1, help="share of the valid ones whose scene is checked, too")
    options = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = fuzz(options.seed, options.count, Path(folder), first=options.first, scenes=options.scenes)
    print(report.table())
    for line in report.broken:
        print(line)
    print(f"{options.count} mutations, seed {options.seed}, in {time.monotonic() - began:.0f} s")
    sys.exit(bool(report.broken))


if __name__ == "__main__":
    main()
