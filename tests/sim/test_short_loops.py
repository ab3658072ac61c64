from sim import short_loops


def test_a_loop_is_short_by_its_work_and_never_on_a_gpu(monkeypatch):
    items = int(short_loops.LONGEST_NS / 10.0)
    monkeypatch.setattr(short_loops, "runs_on_gpu", lambda: False)
    assert short_loops.is_short(items, 10.0)
    assert not short_loops.is_short(items + 1, 10.0)
    monkeypatch.setattr(short_loops, "runs_on_gpu", lambda: True)
    assert not short_loops.is_short(1, 1.0)
