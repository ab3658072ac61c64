"""What woven looks are on average; importing them needs the bpy module, in a child process."""

from __future__ import annotations

from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy


def test_a_weave_of_period_n_shows_one_nth_of_weft_on_average():
    # One crossing in n. A thread is round, so that the other one looks out beside it: 0.240 and 0.185 were measured.
    run_python(
        """
        from blender_scripts.weaves import COTTON, DENIM, SILK, mean_appearance
        for weave in (COTTON, DENIM, SILK):
            weft_share, brightness = mean_appearance(weave)
            assert abs(weft_share - 1 / weave.period) < 0.03, (weave.period, weft_share)
            assert weave.gaps < brightness < 1.0, brightness
        assert mean_appearance(COTTON)[0] == 0.5  # warp and weft of a plain weave are alike
        """
    )


def test_fibres_of_matt_cloth_shine_in_the_colour_of_their_threads():
    # In a picture of black cloth sheen is three of 255.
    run_python(
        """
        import bpy
        from blender_scripts.looks import new_material
        from blender_scripts.shading import LookContext
        for look in ("cotton", "denim", "silk"):
            context = LookContext.of({}, domain_size=1.0, pixel_angle=1e-3, surface="sheet")
            nodes = new_material("sheet", look, context).node_tree.nodes
            (shader,) = (node for node in nodes if node.type == "BSDF_PRINCIPLED")
            assert shader.inputs["Sheen Weight"].default_value > 0.1
            sheen, base = (shader.inputs[key].links[0].from_socket for key in ("Sheen Tint", "Base Color"))
            assert sheen == base
        """
    )
