"""Bodies that cannot start are refused with the job, not when its simulation starts."""

from __future__ import annotations

from pipeline.job.checks import check_job
from pipeline.job.models import Job


def box(name: str, position: tuple[float, float, float], kind: str = "dynamic") -> dict:
    density = {"density": 400.0} if kind == "dynamic" else {}
    return {
        "name": name,
        "kind": kind,
        "shape": {"type": "box", "size": (0.1, 0.1, 0.1)},
        "position": position,
    } | density


def errors(*bodies: dict) -> list[tuple[object, str]]:
    job = Job.model_validate({"name": "a", "frames": 2, "device": "cpu", "rigid": bodies}, strict=False)
    return [(problem.path, problem.message) for problem in check_job(job).errors]


def test_bodies_that_start_in_each_other_are_refused_at_their_place():
    ((path, message),) = errors(box("post", (0, 0, 0.05), "static"), box("a", (0, 0, 0.13)))
    assert path == ("rigid", 1)
    assert message.startswith('rigid bodies "a" and "post" start 0.02 m deep in each other')


def test_every_body_behind_a_wall_is_told_at_once():
    found = errors(box("a", (0, 0, 0.02)), box("b", (0.3, 0, 0.03)))
    assert [path for path, _ in found] == [("rigid", 0), ("rigid", 1)]
    assert all("behind the wall z-" in message for _, message in found)


def test_bodies_that_touch_and_static_ones_that_overlap_may_start():
    assert not errors(box("post", (0, 0, 0.05), "static"), box("beam", (0, 0, 0.1), "static"), box("a", (0.1, 0, 0.05)))
