"""The lamps of fires: where they stand and what they give, in a child process, as Blender's libraries are needed."""

from __future__ import annotations

from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy

SCENE = """
    import math
    import sys
    from pathlib import Path
    import numpy as np
    from blender_scripts.black_body import black_body_color
    from blender_scripts.openvdb_binding import import_openvdb
    from blender_scripts.errors import RenderInputError
    from blender_scripts.flames import Glow, lamps_of_file, lamps_of_grids
    from blender_scripts.shading import SmokeBox
    openvdb = import_openvdb()

    def grid(values, name):
        made = openvdb.FloatGrid()
        made.name = name
        made.copyFromArray(np.ascontiguousarray(values, np.float32))
        transform = openvdb.createLinearTransform(0.1)
        transform.postTranslate((1.05, 2.05, 3.05))
        made.transform = transform
        return made

    # A box of 4 m x 1 m x 1 m at (1, 2, 3), in blocks of 1 m: two fires, and warm smoke between them.
    box = SmokeBox((1.0, 2.0, 3.0), (5.0, 3.0, 4.0), (), 300.0)
    glow = Glow(2.0, 5.0, 1500.0, box)
    density, heat = np.zeros((40, 10, 10)), np.zeros((40, 10, 10))
    density[:, 4:6, 4:6], heat[:, 4:6, 4:6] = 1.0, 200.0
    heat[2:6, 4:6, 4:6] = 1200.0
    density[34:36, 4:6, 4:6], heat[34:36, 4:6, 4:6] = 0.5, 1500.0
    lamps = lamps_of_grids(grid(density, "density"), grid(heat, "temperature"), glow)
"""


def check(code: str, *arguments: str) -> None:
    run_python(SCENE + code, *arguments)


def test_each_fire_has_its_lamp_with_the_light_of_its_cells():
    check("""
    assert len(lamps) == 2, lamps
    for lamp, x, kelvin, smoke in ((lamps[0], 1.4, 1500.0, 16.0), (lamps[1], 4.5, 1800.0, 4.0)):
        np.testing.assert_allclose(lamp.position, (x, 2.5, 3.5), atol=1e-9)
        luminance = math.exp(24000.0 * (1 / 1500.0 - 1 / kelvin))
        power = 4 * math.pi * 2.0 * 5.0 * smoke * 1e-3 * luminance * black_body_color(np.array([kelvin]))[0]
        np.testing.assert_allclose(lamp.power, power, rtol=1e-6)
    # Centres of 4 x 2 x 2 cells: mean square radius (0.0125 + 0.0025 + 0.0025) m²; half the ball's that has the same.
    assert abs(lamps[0].radius - 0.5 * math.sqrt(5 / 3 * 0.0175)) < 1e-6
    """)


def test_what_hardly_shines_beside_another_fire_gets_no_lamp_and_a_dead_fire_none():
    check("""
    heat[34:36, 4:6, 4:6] = 700.0
    assert len(lamps_of_grids(grid(density, "density"), grid(heat, "temperature"), glow)) == 1
    assert lamps_of_grids(grid(density, "density"), grid(np.minimum(heat, 350.0), "temperature"), glow) == []
    assert lamps_of_grids(openvdb.FloatGrid(), openvdb.FloatGrid(), glow) == []
    """)


def test_a_fire_without_emission_has_no_lamps(tmp_path):
    code = """
    from dataclasses import replace
    from blender_scripts.volumes import FireLight
    dark = replace(glow, emission=0.0)
    assert lamps_of_grids(grid(density, "density"), grid(heat, "temperature"), dark) == []
    path = Path(sys.argv[1]) / "fire.vdb"
    openvdb.write(str(path), [grid(density, "density"), grid(heat, "temperature")])
    FireLight("dark", dark).shine(path)
    """
    check(code, str(tmp_path))


def test_lamps_fade_at_open_faces_as_the_smoke_does():
    """The first fire has its cells 0.05 m, 0.15 m ... from the side x-; smoothstep over 0.2 m leaves 5/32 and 27/32."""
    check("""
    from dataclasses import replace
    heat[:2, 4:6, 4:6] = 1200.0
    grids = grid(density, "density"), grid(heat, "temperature")
    plain, faded, at_far_side, cut = (
        lamps_of_grids(*grids, replace(glow, box=replace(box, open_faces=open_faces), fade_width=width))
        for open_faces, width in (((), 0.0), (("x-",), 0.2), (("x+",), 0.2), (("x-", "x+"), 0.0))
    )
    assert plain == cut == at_far_side
    assert len(faded) == 2 and faded[1] == plain[1]
    weights = np.array([5 / 32, 27 / 32, 1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(faded[0].power, np.array(plain[0].power) * weights.mean(), rtol=1e-6)
    centre = 1.0 + weights @ (0.05 + 0.1 * np.arange(6)) / weights.sum()
    np.testing.assert_allclose(faded[0].position, (centre, 2.5, 3.5), atol=1e-6)
    """)


def test_the_look_tells_lamps_of_its_fade():
    run_python(
        """
    from blender_scripts.shading import LookContext, SmokeBox
    from blender_scripts.smoke_looks import glow_of
    box = SmokeBox((0.0, 0.0, 0.0), (1.0, 0.5, 2.0), ("z+",), 300.0)
    for own, width in (({}, 0.04), ({"edge_fade": 0.3}, 0.3), ({"edge_fade": 0.0}, 0.0)):
        own["density"] = 5.0
        told = glow_of(LookContext.of(own, domain_size=2.0, pixel_angle=1e-3, smoke_box=box))
        assert told.box.open_faces == ("z+",) and abs(told.fade_width - width) < 1e-12, told
    """
    )


def test_a_volume_without_temperature_is_refused_with_its_name(tmp_path):
    code = """
    path = Path(sys.argv[1]) / "cold.vdb"
    openvdb.write(str(path), [grid(density, "density")])
    try:
        lamps_of_file(path, glow)
    except RenderInputError as error:
        assert "cold.vdb has no grid named temperature, which the look of fire needs" in str(error)
    else:
        raise AssertionError("it was drawn as cold smoke")
    """
    check(code, str(tmp_path))
