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
SMOKE = """
[[smoke]]
name = "air"
cell_size = 0.02
min = [-0.3, -0.3, 0.3]
max = [0.3, 0.3, 0.9]
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.7]
"""
BLOCK = LEAF.replace("0.01]", "0.1]")
BESIDE = BLOCK.replace('"leaf"', '"far"').replace("[0.0, 0.0, 0.5]", "[0.4, 0.0, 0.5]")


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
        ('type = "wind"\nonly = ["leaf"]', BLOCK + SMOKE, 'in place of this air; add "air"'),
        ('type = "wind"\nonly = ["leaf", "air"]', BLOCK + SMOKE, None),
        ('type = "wind"\nonly = ["leaf", "far"]', BLOCK + BESIDE + SMOKE, None),
        ('type = "drag"\nrate = 1.0\nonly = ["leaf"]', BLOCK + SMOKE, None),
    ],
)
def test_forces_that_change_nothing_are_told(tmp_path, force, bodies, said):
    told = [text for text in warnings_of(tmp_path, force, bodies) if "force" in text]
    assert (told == []) if said is None else (len(told) == 1 and said in told[0]), told
