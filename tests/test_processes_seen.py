"""What is told of processes that live, that have ended and that are gone."""

import subprocess
import sys
import time

import psutil
from processes_seen import busiest, lives, pid_lives, words_of


def test_a_process_that_ends_is_told_apart_before_and_after_it_is_collected():
    child = subprocess.Popen([sys.executable, "-c", "input()", "told"], stdin=subprocess.PIPE)
    seen = psutil.Process(child.pid)
    assert lives(seen) and pid_lives(child.pid)
    until = time.monotonic() + 30.0
    while not words_of(seen):  # the kernel is still laying them out
        assert time.monotonic() < until
    assert words_of(seen)[1:] == ["-c", "input()", "told"]
    child.kill()
    while seen.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < until
        time.sleep(0.01)
    assert not lives(seen) and not pid_lives(child.pid) and words_of(seen) == []
    child.communicate()
    assert not lives(seen) and not pid_lives(child.pid) and words_of(seen) == []


def test_what_is_busy_is_named_with_the_test_that_began_it(request):
    child = subprocess.Popen([sys.executable, "-c", "print(flush=True)\nwhile True: pass"], stdout=subprocess.PIPE)
    try:
        child.stdout.readline()
        assert any(f" {child.pid} " in line and request.node.nodeid in line for line in busiest(1000))
    finally:
        child.kill()
        child.communicate()
