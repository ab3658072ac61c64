"""The files of soft matter: what decides them, and what they are expected to take."""

import pytest
from planned_jobs import concerned

from pipeline.model.job import Job

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
