"""Rates of a machine: measured once, kept, and better with every run."""

import subprocess
import sys

import pytest
from places import PROJECT

from pipeline.run import rates
from pipeline.run.rates import LARGEST_CORRECTION, MachineRates, keep, known_rates, measure, rates_file

NAME = "simulate:cpu:wcsph"


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


@pytest.mark.usefixtures("own_cache")
def test_a_machine_is_measured_once_and_remembered():
    assert known_rates() is None
    measured = measure()
    assert measured.one_core > 0.0
    assert measured.all_cores >= measured.one_core
    assert known_rates() == measured


@pytest.mark.usefixtures("own_cache")
def test_machines_that_share_a_home_keep_rates_of_their_own(monkeypatch):
    keep(MachineRates(1.0, 2.0, 2))
    monkeypatch.setattr(rates.platform, "node", lambda: "another")
    assert known_rates() is None
    keep(MachineRates(3.0, 6.0, 2))
    assert known_rates() == MachineRates(3.0, 6.0, 2)
    monkeypatch.undo()


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("text", ["", "[]", "{", '{"it": 1}'])
def test_a_damaged_file_counts_as_none(text):
    rates_file().parent.mkdir(parents=True, exist_ok=True)
    rates_file().write_text(text)
    assert known_rates() is None
    keep(MachineRates(1.0, 2.0, 2))
    assert known_rates() == MachineRates(1.0, 2.0, 2)


LEARNS = """
import sys
from pipeline.run.rates import learn
for number in range(40):
    learn(lambda rates: rates.taught(f"simulate:cpu:{sys.argv[1]}-{number}", time=2.0, size=1.0, memory=1.0))
"""


def test_processes_that_learn_at_once_lose_nothing_of_each_other(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keep(MachineRates(1.0, 2.0, 2))
    processes = [subprocess.Popen([sys.executable, "-c", LEARNS, name], cwd=PROJECT) for name in "abc"]
    assert [process.wait() for process in processes] == [0, 0, 0]
    rates = known_rates()
    assert rates is not None and len(rates.learnt) == 3 * 40
    assert measure() == rates  # who comes to measure now takes nothing back


def test_the_first_run_of_a_kind_of_work_is_believed_and_later_ones_move_it():
    first = MachineRates(1.0, 2.0, 2).taught(NAME, time=4.0, size=2.0, memory=0.5)
    assert first.factors(NAME)[:3] == pytest.approx((4.0, 2.0, 0.5))
    second = first.taught(NAME, time=1.0, size=0.0, memory=0.5)
    assert second.factors(NAME).time == pytest.approx(2.0)  # the mean of the two, by their logarithms
    assert second.factors(NAME).bytes == pytest.approx(2.0)  # not measured


def test_a_run_that_was_stopped_or_starved_spoils_little():
    taught = MachineRates(1.0, 2.0, 2).taught(NAME, time=1e6, size=1.0, memory=1.0)
    assert taught.factors(NAME).time == pytest.approx(LARGEST_CORRECTION)


def test_work_that_is_new_here_goes_by_what_is_like_it():
    taught = MachineRates(1.0, 2.0, 2).taught("simulate:cpu:dfsph", time=4.0, size=1.0, memory=1.0)
    assert taught.factors("simulate:cpu:pcisph").time == pytest.approx(4.0)
    assert not taught.is_known("simulate:cpu:pcisph")
    assert taught.factors("simulate:gpu:dfsph").time == 1.0
    assert taught.factors("render:cpu:draft").time == 1.0
