"""Cloths as a job names them: materials, sheets, pins."""

import pytest
from cloth_scenes import cloth, rectangle
from pydantic import ValidationError

from sim.cloth.parameters import MATERIALS, ClothParameters, shared_conflicts


@pytest.mark.parametrize("material", sorted(MATERIALS))
def test_what_is_omitted_comes_from_the_material_and_what_is_given_stays(material):
    made = cloth(material=material, friction=0.11)
    expected = {**MATERIALS[material], "friction": 0.11}
    assert {key: getattr(made, key) for key in expected} == expected


def test_parameters_survive_being_written_and_read_again():
    made = cloth(material="denim", thickness=0.004)
    assert ClothParameters.model_validate(made.model_dump()) == made


def test_rubber_is_the_isotropic_sheet_that_its_docstring_says():
    rubber = MATERIALS["rubber"]
    assert rubber["stretch_stiffness"] == pytest.approx(1500.0)
    assert rubber["shear_stiffness"] == pytest.approx(1500.0 / 3.0)  # E h / (2 (1 + 1/2))
    assert rubber["bend_stiffness"] == pytest.approx(1.5e6 * 1e-9 / 12.0 / 0.75)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"shape": {"type": "rectangle", "size": (1, 1)}}, "give counts or resolution"),
        ({"shape": {"type": "rectangle", "size": (1, 1), "resolution": 1e-5}}, "4096 at most"),
        ({"shape": {"type": "rectangle", "size": (1e3, 1), "resolution": 1e-307}}, "4096 at most"),
        ({"mass_per_area": 0.0}, "greater than 0"),
        ({"pin": [{}]}, "give one of corner, edge, index and region, got none"),
        ({"pin": [{"corner": "x-y-", "edge": "x-"}]}, "got corner and edge"),
        ({"pin": [{"edge": "x-", "keyframe": [{"time_s": 0.0}]}]}, "needs two keyframes"),
        (
            {"pin": [{"edge": "x-", "keyframe": [{"time_s": 1.0}, {"time_s": 1.0}]}]},
            r"keyframe\[1\].time_s must be after",
        ),
        (
            {"pin": [{"edge": "x-", "keyframe": [{"time_s": 0.5, "offset": (0, 0, 0.1)}, {"time_s": 1.0}]}]},
            r"keyframe\[0\] is where the pin starts, .* got \(0.0, 0.0, 0.1\) m and \(0.0, 0.0, 0.0\) degrees; move or",
        ),
        (
            {"pin": [{"edge": "x-", "keyframe": [{"time_s": 0.0, "rotation_deg": (0, 9, 0)}, {"time_s": 1.0}]}]},
            "or add a keyframe without them before it",
        ),
        ({"pin": [{"edge": "x-", "interpolation": "linear"}]}, "no meaning without keyframes"),
        ({"shape": {"type": "mesh", "file": "a.obj"}, "pin": [{"edge": "x-"}]}, "pin a mesh by index or region"),
        (
            {"integrator": "explicit", "iterations": 2},
            'iterations = 2 has no meaning for integrator = "explicit"; remove',
        ),
    ],
)
def test_what_has_no_meaning_is_refused_with_a_remedy(keys, message):
    with pytest.raises(ValidationError, match=message):
        cloth(**keys)


def test_resolution_divides_the_sides_evenly():
    shape = cloth(shape={"type": "rectangle", "size": (1.0, 0.5), "resolution": 0.03}).shape
    assert shape.node_counts == (34, 18)


def test_cloths_that_step_differently_cannot_share_a_scene():
    (conflict,) = shared_conflicts((cloth("a"), cloth("b", integrator="explicit")))
    assert conflict[:2] == (1, "integrator")
    assert "all cloths share it" in conflict[2]
    others = {"shape": rectangle((1, 1), (3, 3)), "substeps": 40, "iterations": 3}
    assert shared_conflicts((cloth("a"), cloth("b", **others))) == []


@pytest.mark.parametrize("material", [{"a": 1}, ["cotton"], 3, "chiffon", None])
def test_a_material_that_is_none_is_refused(material):
    with pytest.raises(ValidationError, match="material"):
        cloth(material=material)
