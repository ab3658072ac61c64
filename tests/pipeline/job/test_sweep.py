"""Sweeps: which jobs a few settings come to, and what they are called."""

import re

import pytest

from pipeline.base.errors import JobFileError
from pipeline.job.loading import make_job
from pipeline.job.sweep import LONGEST_SUFFIX, split_values, sweep_name, variants
from pipeline.model.job import NAME_PATTERN

BLOCK = {"shape": {"type": "box", "size": [0.1, 0.1, 0.1]}, "position": [0.0, 0.0, 0.3]}
JOB = make_job(name="job", fluid=[{"name": "water", "block": [BLOCK]}]).job


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
    found = variants(["fluid.water.viscosity=0.1,1", "fps=30,60", "render.quality=draft"], JOB)
    assert [each.overrides for each in found] == [
        ("fluid.water.viscosity=0.1", "fps=30", "render.quality=draft"),
        ("fluid.water.viscosity=0.1", "fps=60", "render.quality=draft"),
        ("fluid.water.viscosity=1", "fps=30", "render.quality=draft"),
        ("fluid.water.viscosity=1", "fps=60", "render.quality=draft"),
    ]
    assert [each.suffix for each in found][:2] == ["viscosity-0.1-fps-30", "viscosity-0.1-fps-60"]
    assert found[0].label == "viscosity = 0.1\nfps = 30"


def test_names_say_which_of_two_keys_of_the_same_last_word_is_meant():
    found = variants(["fluid.water.viscosity=1,2", "fluid.oil.viscosity=3,4"], JOB)
    assert found[0].suffix == "water.viscosity-1-oil.viscosity-3"


def test_a_key_that_another_body_has_too_is_named_with_its_body():
    fluids = [{"name": name, "block": [BLOCK]} for name in ("water", "oil")]
    two = make_job(name="job", fluid=fluids, material={name: {"roughness": 0.5} for name in ("oil", "water")}).job
    for setting, suffix in (
        ("fluid.water.viscosity=1,2", "water.viscosity-1"),
        ("fluid.1.viscosity=1,2", "1.viscosity-1"),
        ("material.oil.roughness=0,1", "oil.roughness-0"),
        ("fps=30,60", "fps-30"),
    ):
        assert variants([setting], two)[0].suffix == suffix


def test_results_are_called_by_the_keys():
    def name(*settings: str) -> str:
        return sweep_name("job", variants(settings, JOB)[0])

    assert name("fluid.water.viscosity=1,2", "fps=30") == "job-viscosity-sweep"
    assert name("fps=30,60", "fluid.water.viscosity=1,2") == "job-fps-viscosity-sweep"
    named = {
        name(f"material.{each}.roughness=0,1", f"material.{other}.roughness=0,1") for each, other in ("水油", "油水")
    }
    assert len(named) == 2 and all(re.fullmatch(NAME_PATTERN, each) for each in named)
    assert len(name(*(f"{'k' * 20}{number}=1,2" for number in range(5)))) < 90


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
    found = variants(settings, JOB)
    names = [f"job-{each.suffix}" for each in found]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(NAME_PATTERN, name) for name in names)
    assert all(len(each.suffix) <= LONGEST_SUFFIX for each in found)
    assert names == [f"job-{each.suffix}" for each in variants(settings, JOB)]  # so that the same command goes on


def test_a_value_that_is_given_twice_is_one_job():
    assert len(variants(["fps=30,60,30"], JOB)) == 2


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
        variants(settings, JOB)
    for part in parts:
        assert part in str(caught.value)
