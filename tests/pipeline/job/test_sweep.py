"""Sweeps: which jobs a few settings come to, and what they are called."""

import re

import pytest

from pipeline.base.errors import JobFileError
from pipeline.job.sweep import LONGEST_SUFFIX, split_values, variants
from pipeline.model.job import NAME_PATTERN


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1", ["1"]),
        ("0.01, 0.1,1", ["0.01", "0.1", "1"]),
        ("[0,-3,1],[2,-2,1]", ["[0,-3,1]", "[2,-2,1]"]),
        ("[[1,2],[3,4]]", ["[[1,2],[3,4]]"]),
        ('"a,b",c', ['"a,b"', "c"]),
        ("'a,\"b',c", ["'a,\"b'", "c"]),
        (
            "{ type = 'box', size = [1,2,3] },{ type = 'sphere' }",
            ["{ type = 'box', size = [1,2,3] }", "{ type = 'sphere' }"],
        ),
        ("1,,2", ["1", "", "2"]),
    ],
)
def test_values_end_at_commas_outside_brackets_and_quotes(text, values):
    assert split_values(text) == values


def test_every_combination_is_a_job_and_the_last_key_changes_fastest():
    found = variants(["fluid.water.viscosity=0.1,1", "fps=30,60", "render.quality=draft"])
    assert [each.overrides for each in found] == [
        ("fluid.water.viscosity=0.1", "fps=30", "render.quality=draft"),
        ("fluid.water.viscosity=0.1", "fps=60", "render.quality=draft"),
        ("fluid.water.viscosity=1", "fps=30", "render.quality=draft"),
        ("fluid.water.viscosity=1", "fps=60", "render.quality=draft"),
    ]
    assert [each.suffix for each in found][:2] == ["viscosity-0.1-fps-30", "viscosity-0.1-fps-60"]
    assert found[0].label == "viscosity = 0.1\nfps = 30"


def test_names_say_which_of_two_keys_of_the_same_last_word_is_meant():
    found = variants(["fluid.water.viscosity=1,2", "fluid.oil.viscosity=3,4"])
    assert found[0].suffix == "water.viscosity-1-oil.viscosity-3"


@pytest.mark.parametrize(
    "settings",
    [
        ["camera.position=[0, -3, 1],[2,-2,1]"],
        ['material.duck.look="rubber / wet","ä"'],
        [f"a.b={'1' * 80},{'1' * 81}"],
        ["gravity=[0,0,-9.81],[0, 0, -9.81]"],
        ["x='a b','a_b'"],
    ],
)
def test_names_are_sane_on_disk_and_each_is_there_once(settings):
    found = variants(settings)
    names = [f"job-{each.suffix}" for each in found]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(NAME_PATTERN, name) for name in names)
    assert all(len(each.suffix) <= LONGEST_SUFFIX for each in found)
    assert names == [f"job-{each.suffix}" for each in variants(settings)]  # so that the same command goes on


def test_a_value_that_is_given_twice_is_one_job():
    assert len(variants(["fps=30,60,30"])) == 2


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        (["fps=30"], ["nothing varies"]),
        (["fps", "x=1,"], ["--set fps:", "--set x=1,:"]),
        (["fps=1,2", "fps=3,4"], ["fps: is there 2 times"]),
        (["name=a,b"], ["--set name: "]),
        (["a=" + ",".join(map(str, range(40))), "b=" + ",".join(map(str, range(40)))], ["1,600 jobs"]),
    ],
)
def test_what_is_no_sweep_is_refused_with_all_that_is_wrong(settings, parts):
    with pytest.raises(JobFileError) as caught:
        variants(settings)
    for part in parts:
        assert part in str(caught.value)
