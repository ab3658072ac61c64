"""Bodies that cannot start are refused with the job, not when its simulation starts."""

from pipeline.model.job import Job
from pipeline.run.checked_job import check_job


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


def ballasted(*positions: tuple[float, float, float]) -> dict:
    """A box 0.1 m wide and 0.3 m high that lies on its side, its ballast given as if it stood."""
    shape = {"type": "box", "size": (0.1, 0.1, 0.3)}
    ballast = [{"mass": 0.2, "position": position} for position in positions]
    return box("a", (0, 0, 0.1)) | {"shape": shape, "rotation_deg": (0, 90, 0), "ballast": ballast}


def test_ballast_outside_of_its_body_is_refused_as_it_is_most_likely_in_millimetres():
    ((path, message),) = errors(ballasted((0, 0, -0.14), (0, 0, -140.0)))
    assert path == ("rigid", 0, "ballast", 1, "position")
    assert message.startswith("lies 140 m outside of the body")
    assert "give it in metres from the shape's centre" in message


def test_ballast_is_placed_before_the_body_is_turned():
    assert not errors(ballasted((0, 0, 0.14)))
    # Inside of the box as it lies, outside of it as it stands.
    assert [path for path, _ in errors(ballasted((0.14, 0, 0)))] == [("rigid", 0, "ballast", 0, "position")]


def test_ballast_may_touch_the_surface():
    assert not errors(ballasted((0.05, 0, -0.15)))
