"""What `check` tells of embers."""

import pytest
from command_line import pipeline

JOB = """\
name = "it"
frames = 60
[domain]
min = [-0.5, -0.5, 0.0]
max = [0.5, 0.5, 1.0]
[[smoke]]
name = "fire"
cell_size = 0.05
max = [0.5, 0.5, 0.6]
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
[[embers]]
name = "sparks"
smoke = "fire"
[[embers.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""


@pytest.mark.parametrize(
    ("option", "is_fine", "expected"),
    [
        ("frames=60", True, "up to 114 embers"),
        ("embers.sparks.smoke=fires", False, 'no smoke is named "fires"; smokes are fire'),
        ("embers.sparks.temperature=700", False, "temperature"),
        ("embers.sparks.source.0.end_s=0", False, "end_s"),
        ("embers.sparks.source.0.start_s=2", True, "start_s: is 2 s; the film ends at 1 s"),
        (
            "embers.sparks.source.0.position=[0,0,0.9]",
            True,
            'is outside of the box of "fire", where no air carries embers',
        ),
        ("embers.sparks.source.0.rate=1e6", False, "rate"),
        ("material.sparks.look=fire", False, '"fire" is a look for [[smoke]]; "sparks" is in [[embers]]'),
        ("material.fire.look=embers", False, 'smoke can only look like "smoke" or "fire", got "embers"'),
    ],
)
def test_embers_are_counted_and_what_is_wrong_is_told(tmp_path, option, is_fine, expected):
    path = tmp_path / "it.toml"
    path.write_text(JOB)
    result = pipeline("check", path, "--set", option)
    assert expected in result.output, result.output
    assert (result.exit_code == 0) == is_fine
