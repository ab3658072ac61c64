"""The campaign's command line."""

import argparse
import json
import signal
import sys
import tempfile
import time
from pathlib import Path

from .campaign import Campaign
from .faults import KINDS, may_mount
from .studio import SCENES
from .table import Result

EXAMPLES = """
examples:
  python -m tests.campaign --seed 1 --kills 200
  python -m tests.campaign --seed 2 --kills 200 --minutes 30 --json campaign.json
  python -m tests.campaign --seed 1 --kills 8 --per-round 8 --quick
  python -m tests.campaign --seed 1 --kills 12 --only "disk full" --keep /tmp/campaign
"""


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaign",
        description="Run a small real job under seeded faults, submit it again until it is done, and hold the result "
        "against an undisturbed run's. Prints a table in Markdown; exits with 1 if a promise was broken.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seed", type=int, default=1, help="of the faults and their moments (default: %(default)s)")
    parser.add_argument("--kills", type=int, default=200, help="how many faults (default: %(default)s)")
    parser.add_argument("--per-round", type=int, default=6, help="faults on one job, at most (default: %(default)s)")
    parser.add_argument("--scene", choices=SCENES, default="ball", help="what is simulated (default: %(default)s)")
    parser.add_argument("--only", action="append", metavar="FAULT", help="this kind only; may be given several times")
    parser.add_argument("--quick", action="store_true", help="one undisturbed run instead of two")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no further round after this time")
    parser.add_argument("--json", type=Path, help="write the result here, too")
    parser.add_argument("--keep", type=Path, help="work in this folder, and keep the rounds that broke a promise")
    parser.add_argument("--list", action="store_true", help="name the kinds of faults, and end")
    options = parser.parse_args()
    if options.list:
        print(*(kind.name for kind in KINDS), sep="\n")
        return 0
    kinds = tuple(kind for kind in KINDS if not options.only or kind.name in options.only)
    if unknown := set(options.only or ()) - {kind.name for kind in kinds}:
        parser.error(f"no fault is called {', '.join(sorted(unknown))}; --list names them")
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell starts what is in the background with SIGINT ignored
        signal.signal(number, signal.default_int_handler)
    until = time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory(prefix="campaign-") as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        campaign = Campaign(
            folder,
            seed=options.seed,
            scene=options.scene,
            may_mount=may_mount(),
            in_haste=options.quick,
            say=_say,
            save=lambda result: _write(result, options.json),
        )
        try:
            campaign.run(options.kills, per_round=options.per_round, until=until, kinds=kinds)
        except KeyboardInterrupt:
            _say("stopped; so far:")
        finally:
            campaign.close()
        result = campaign.result
    print(result.markdown())
    for sentence in result.broken:
        print(f"broken: {sentence}", file=sys.stderr)
    return 1 if result.broken else 0


def _write(result: Result, path: Path | None) -> None:
    if path is not None:
        path.write_text(json.dumps(result.to_json(), indent=1) + "\n")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
