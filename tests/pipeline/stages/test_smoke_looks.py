"""What `check` says of the looks of smoke and fire, and what Blender is told of their boxes."""

import pytest
from checked_jobs import checked

from pipeline.base.layout import JobLayout
from pipeline.job.loading import read_job
from pipeline.stages.render_scene import render_spec
from render.spec import VolumeSequenceObject

PLUME = """
name = "fire"
frames = 10
[[smoke]]
name = "flames"
cell_size = 0.05
min = [-0.4, -0.4, 0.0]
max = [0.4, 0.4, 0.98]
open_faces = ["z+"]
ambient_temperature = 280.0
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
temperature = 1600.0
[material.flames]
"""
COLD = PLUME.replace("1600.0", "500.0")
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.7]
[material.ball]
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PLUME + 'look = "smoke"\nemission = 3.0', 'flames.emission: has no effect on the look "smoke"'),
        (PLUME + 'look = "smoke"\nflame_temperature = 1400', 'temperature: has no effect on the look "smoke"'),
        (
            PLUME + 'look = "smoke"' + BALL + 'look = "metal"\nanisotropy = 0.5',
            'anisotropy: has no effect on the look "m',
        ),
        (
            PLUME + 'look = "smoke"' + BALL + 'look = "metal"\nedge_fade = 0.5',
            'edge_fade: has no effect on the look "m',
        ),
        (
            COLD + 'look = "fire"',
            'dam.toml:16 material.flames.look: is "fire", but its hottest gas has 500 K, and nothing glows below '
            "some 900 K; flames have 1300 K and more",
        ),
    ],
)
def test_keys_and_fires_without_effect_are_warned_of(text, expected, tmp_path):
    errors, warnings, _ = checked(text, tmp_path / "dam.toml")
    assert errors == []
    assert any(expected in warning for warning in warnings), warnings


def test_fire_and_smoke_with_all_their_keys_pass(tmp_path):
    keys = "density = 8.0\nanisotropy = -0.2\nedge_fade = 0.0\ncolor = [0.5, 0.5, 0.5]\n"
    for look, own in (("smoke", ""), ("fire", "emission = 10.0\nflame_temperature = 1400.0\n")):
        checks = checked(PLUME + f'look = "{look}"\n' + keys + own, tmp_path / "dam.toml")
        assert (checks.errors, checks.warnings) == ([], [])


def test_only_smoke_burns(tmp_path):
    errors, _, _ = checked(PLUME + 'look = "smoke"' + BALL + 'look = "fire"', tmp_path / "dam.toml")
    assert errors == ['dam.toml:22 material.ball.look: "fire" is a look for [[smoke]]; "ball" is in [[rigid]]']


def test_blender_is_told_the_whole_cells_the_open_faces_and_the_air_of_the_box(tmp_path):
    path = tmp_path / "dam.toml"
    path.write_text(PLUME + 'look = "fire"')
    (volume,) = render_spec(read_job(path).job, JobLayout(tmp_path / "job")).objects
    assert isinstance(volume, VolumeSequenceObject)
    assert volume.box_min == (-0.4, -0.4, 0.0)
    # 0.98 m are rounded up to twenty cells.
    assert volume.box_max == pytest.approx((0.4, 0.4, 1.0), abs=1e-9)
    assert volume.open_faces == ("z+",)
    assert volume.ambient_temperature == 280.0
