"""What woven looks are on average; importing them needs the bpy module, in a child process."""

from __future__ import annotations

from fresh_python import run_python
from needed_blender import needs_bpy

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
