"""The files of soft matter: what decides them, and what they are expected to take."""

import pytest
from planned_jobs import concerned

from pipeline.model.job import Job
from pipeline.model.problems import Findings
from pipeline.queue import disk
from pipeline.stages import STAGES

BLOCK = {"shape": {"type": "box", "size": [0.2, 0.2, 0.2]}, "position": [0.0, 0.0, 0.2]}


def job_of(material: str, **tables: object) -> Job:
    soft = {"name": "heap", "material": material, "cell_size": 0.02, "block": [BLOCK]}
    return Job.model_validate({"name": "film", "frames": 2, "device": "cpu", "soft": [soft], **tables}, strict=False)


@pytest.mark.parametrize(
    ("material", "surface", "stages"),
    [
        ("jelly", {"threshold": 0.5}, {"soft"}),
        ("jelly", {"drop_diameter": 1.0e-3, "drops_per_particle": 3}, set()),
        ("sand", {"threshold": 0.5}, set()),
        ("sand", {"drop_diameter": 1.0e-3}, set()),
    ],
)
def test_keys_of_surfaces_concern_what_has_one_and_keys_of_drops_nobody(material, surface, stages):
    assert concerned(job_of(material), job_of(material, surface=surface)) == stages


def expected(*materials: str, particles: int) -> tuple[str, float, float]:
    """What a file of bodies of so many particles each is called, and what it takes [s, bytes]."""
    job = job_of(materials[0])
    bodies = [job_of(each).soft[0].model_copy(update={"name": each}) for each in materials]
    job = job.model_copy(update={"soft": tuple(bodies)})
    elements = {"soft": particles * len(materials)}
    stage = next(each for each in STAGES if each.name == "soft")
    work = stage.work(job, elements, on_gpu=False)
    size = disk.size_of(job, Findings(elements=elements))
    return work.what, work.work.host_s, disk.bytes_per_artifact("soft", size)


@pytest.mark.parametrize(("particles", "took_s", "megabytes"), [(27_000, 0.66, 2.3), (216_000, 2.1, 9.4)])
def test_surfaces_of_jelly_take_what_was_measured_and_grains_what_their_number_says(particles, took_s, megabytes):
    what, seconds, size = expected("jelly", particles=particles)
    assert what == "surface"
    assert took_s / 2.0 < seconds < 2.0 * took_s
    assert size == pytest.approx(1.0e6 * megabytes, rel=0.05)
    grains = expected("sand", particles=particles)
    assert grains == ("grains", pytest.approx(3.0e-6 * particles, abs=0.05), pytest.approx(33.0 * 8.0 * particles))
    both = expected("jelly", "sand", particles=particles)
    assert both == ("grains+surface", pytest.approx((seconds + grains[1]) / 2), pytest.approx((size + grains[2]) / 2))
