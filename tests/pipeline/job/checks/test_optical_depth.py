"""What `check` says of how much light gets through liquids and smoke."""

from pathlib import Path

import pytest
from checked_jobs import PLUME_FROM_A_BALL, checked, says

SCENE = (
    PLUME_FROM_A_BALL
    + """
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.4, 0.4, 0.4] }
position = [0.0, 0.0, 0.3]
"""
)


def findings(folder: Path, keys: str = "") -> tuple[list[str], list[str]]:
    """Warnings about looks, and facts."""
    result = checked(SCENE + keys, folder / "film.toml")
    assert result.errors == []
    facts = [each.message for each in result.findings.facts]
    return [each for each in result.warnings if "optical depth" in each], facts


def test_the_optical_depth_of_each_liquid_and_smoke_is_told(tmp_path):
    warnings, facts = findings(tmp_path)
    assert warnings == []
    of_looks = [fact for fact in facts if "optical depth" in fact]
    assert of_looks == [
        '"water" as water: optical depth 0.66 / 0.12 / 0.02 (red / green / blue) across 0.4 m, density 5.5',
        '"plume" as smoke: optical depth 2.5 across its source, density 12.5',
    ]


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("plume.density = 0.3", '0.3 gives "plume" ... 0.06: the smoke is not seen; omit it, which is 12 here'),
        ("plume.density = 200.0", '200 gives "plume" ... 40: it looks solid; omit it'),
        ("water.density = 0.5", '0.5 gives "water" ... 0.06: the tint is not seen; omit it, which is 5.5 here'),
        ('water = { look = "honey", density = 1.0 }', '1 gives "water" ... 1.2e+02: it is as black as tar; omit it'),
    ],
)
def test_a_density_that_is_not_seen_or_lets_nothing_through_is_warned_of(tmp_path, keys, expected):
    (warning,), _ = findings(tmp_path, f"[material]\n{keys}")
    name = keys.partition(".")[0].partition(" ")[0]
    assert says(warning, f"film.toml:22 material.{name}.density: {expected}")


def test_the_table_that_gives_a_density_to_many_bodies_is_the_one_that_is_told(tmp_path):
    (warning,), _ = findings(tmp_path, '[material."plum*"]\ndensity = 0.3')
    assert warning.startswith('film.toml:22 material."plum*".density: ')


def test_clear_water_and_thick_milk_are_meant(tmp_path):
    for keys in ("water.color = [1.0, 1.0, 1.0]", 'water = { look = "milk", density = 50.0 }'):
        assert findings(tmp_path, f"[material]\n{keys}")[0] == []


def test_water_that_is_clear_but_for_its_dye_is_meant(tmp_path):
    dyed = SCENE + "dye = 1.0\n" + '[[fluid.block]]\nshape = { type = "box", size = [0.1, 0.1, 0.1] }\n'
    for density, seen in ((5.0, True), (0.01, False)):
        look = f"[material.water]\ndensity = {density}\ncolor = [1.0, 1.0, 1.0]\ndye_color = [0.9, 0.1, 0.1]\n"
        result = checked(dyed + "position = [0.4, 0.4, 0.1]\n" + look, tmp_path / "film.toml")
        assert result.errors == []
        told = [each for each in result.warnings if "optical depth" in each]
        assert len(told) == (not seen)
