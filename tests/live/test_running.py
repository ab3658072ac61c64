"""The command puts a session and its page together."""

import math

import pytest
from click.testing import CliRunner
from live_jobs import loaded

from pipeline.cli import main
from pipeline.live import running
from pipeline.live.frame_watch import PATIENCE_S

pytestmark = pytest.mark.usefixtures("taichi")


@pytest.mark.parametrize(("options", "patience_s"), [([], PATIENCE_S), (["--anyway"], math.inf)])
def test_a_frame_may_take_long_only_anyway_and_the_end_does_not_wait_for_it(tmp_path, monkeypatch, options, patience_s):
    found = []
    monkeypatch.setattr(
        running,
        "run",
        lambda session, _page, *, ends: found.append((session._watch.patience_s, session.ends is ends)),
    )
    loaded(tmp_path)
    arguments = ["live", str(tmp_path / "drape.toml"), "--port", "0", "--output", str(tmp_path), *options]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    assert found == [(patience_s, True)]
