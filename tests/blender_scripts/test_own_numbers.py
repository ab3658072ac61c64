"""What tells bodies of one look apart: numbers by their names."""

from __future__ import annotations

from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy


def test_numbers_of_a_name_are_the_same_in_every_process_and_version():
    run_python(
        """
        from blender_scripts.shading import LookContext

        def numbers(name, count):
            return LookContext.of({}, domain_size=1.0, pixel_angle=1e-3, name=name).own_numbers(count)

        kept = [-0.214435, 0.257984]
        assert [round(each, 6) for each in numbers("oak", 2)] == kept, numbers("oak", 2)
        assert numbers("oak.lid", 2) == numbers("oak", 2)  # a part of the body
        assert numbers("", 3) == [0.0, 0.0, 0.0]  # the ground
        many = [each for place in range(500) for each in numbers(f"stone{place}", 3)]
        assert len(set(many)) > 1400 and abs(sum(many)) / 1500 < 0.05 and -1.0 <= min(many) and max(many) <= 1.0
        """
    )
