import pytest
from checked_jobs import load_checked_job

STILL = """
[[rigid]]
name = "leaf"
kind = "static"
shape = { type = "box", size = [0.1, 0.1, 0.01] }
position = [0.0, 0.0, 0.5]
"""
LEAF = STILL.replace('"static"', '"dynamic"\ndensity = 300.0')
POOL = """
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.2]
"""


def warnings_of(tmp_path, force, bodies):
    (tmp_path / "job.toml").write_text(f'name = "job"\nduration = 1.0\n{bodies}\n[[force]]\n{force}\n')
    _, findings = load_checked_job(tmp_path / "job.toml")
    return [str(each) for each in findings.warnings]


@pytest.mark.parametrize(
    ("force", "bodies", "said"),
    [
        ('type = "wind"\nvelocity = [3.0, 0.0, 0.0]', POOL, 'give air_density to "water"'),
        ('type = "drag"\nrate = 1.0', STILL + POOL.replace("water", "sea"), None),
        ('type = "drag"\nrate = 1.0\nonly = ["leaf"]', STILL + POOL, "make one dynamic"),
        ('type = "drag"\nrate = 1.0\nstart_s = 2.0', LEAF, "the film ends at 1 s"),
        (
            'type = "drag"\nrate = 1.0\nwithin = { shape = { type = "sphere", radius = 0.1 }, position = [90, 0, 0] }',
            LEAF,
            "is the place meant?",
        ),
        ('type = "wind"', LEAF, None),
    ],
)
def test_forces_that_change_nothing_are_told(tmp_path, force, bodies, said):
    told = [text for text in warnings_of(tmp_path, force, bodies) if "force" in text]
    assert (told == []) if said is None else (len(told) == 1 and said in told[0]), told
