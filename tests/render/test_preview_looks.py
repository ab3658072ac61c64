"""Looks as other programs show them: every look that a body can have is told from the others."""

from blender_scripts.look_table import LOOK_TABLE
from render.parameters import MaterialParameters
from render.preview_looks import preview_of


def test_only_what_is_of_a_blend_file_is_shown_grey():
    grey = preview_of(MaterialParameters(blend="looks.blend:Old gold"))
    previews = {name: preview_of(MaterialParameters(look=name)) for name, row in LOOK_TABLE.items() if row.bodies}
    assert [name for name, look in previews.items() if look == grey] == []
