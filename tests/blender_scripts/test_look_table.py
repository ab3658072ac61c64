"""The table of looks and the functions that draw them; importing these needs the bpy module, in a child process."""

from __future__ import annotations

import pytest
from needed_blender import needs_bpy
from warm_python import run_python

from blender_scripts.look_table import LOOK_TABLE, MATERIAL_KEYS, looks_for
from render.parameters import MaterialParameters, SetParameters


@needs_bpy
def test_each_row_has_a_function_and_each_function_a_row():
    told = run_python("from blender_scripts.looks import LOOKS; print(*LOOKS)")
    assert sorted(told.split()) == sorted(LOOK_TABLE)


@needs_bpy
def test_a_function_without_a_row_is_refused():
    run_python(
        """
        from blender_scripts.shading import draws
        try:
            draws("mist")
        except KeyError as error:
            assert "look_table" in str(error)
        else:
            raise AssertionError
        """
    )


def test_the_keys_of_the_table_are_those_of_materials():
    assert {key for row in LOOK_TABLE.values() for key in row.keys} == set(MATERIAL_KEYS)
    assert {"look", "blend", "color", *MATERIAL_KEYS} == set(MaterialParameters.model_fields)


def test_job_files_can_name_what_a_body_can_wear_and_what_paves_the_ground():
    def accepts(check: type, **keys: str) -> bool:
        try:
            check(**keys)
        except ValueError:
            return False
        return True

    for name, row in LOOK_TABLE.items():
        assert accepts(MaterialParameters, look=name) == bool(row.bodies)
        assert accepts(SetParameters, ground=name) == row.paves


@pytest.mark.parametrize(("body", "looks"), [("smoke", {"smoke", "fire"}), ("nothing", set())])
def test_looks_of_a_kind_of_body(body, looks):
    assert set(looks_for(body)) == looks
