import dataclasses
import json
import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_samples import film, parameter_set

from pipeline.base.parameter_set import ParameterSet, explain_difference
from pipeline.base.task import ArtifactPath, task_fingerprint

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-9, 9),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text("ab.[", max_size=3),
)
DOCUMENTS = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text("ab.[", max_size=4), inner, max_size=4)
    ),
    max_leaves=8,
)
TABLES = st.dictionaries(st.sampled_from(["name", "camera", "fluid", "light"]), DOCUMENTS, max_size=4)


def canonical(document: Any) -> ParameterSet:
    return ParameterSet(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False))


def shuffled(document: Any, seed: int) -> Any:
    if isinstance(document, dict):
        items = [(key, shuffled(value, seed)) for key, value in document.items()]
        random.Random(seed).shuffle(items)
        return dict(items)
    return document


@settings(deadline=None)
@given(document=TABLES, seed=st.integers(0, 9))
def test_order_of_keys_does_not_change_the_digest(document: dict[str, Any], seed: int) -> None:
    assert parameter_set("s", a=document).digest == parameter_set("s", a=shuffled(document, seed)).digest


@settings(deadline=None)
@given(old=TABLES, new=TABLES)
def test_a_difference_is_explained_exactly_when_the_digest_differs(old: dict[str, Any], new: dict[str, Any]) -> None:
    explanation = explain_difference(canonical(old), canonical(new))
    assert bool(explanation) == (canonical(old).digest != canonical(new).digest)


def test_a_changed_value_is_named_by_its_path() -> None:
    old = parameter_set("render", camera={"position": [0, -5, 2], "lens": 50.0})
    new = parameter_set("render", camera={"position": [0, -4, 2], "lens": 50.0})
    assert explain_difference(old, new) == ["camera.position changed from [0, -5, 2] to [0, -4, 2]"]


def test_a_changed_body_is_named_by_its_name_wherever_it_stands_in_the_list() -> None:
    old = parameter_set("simulate", fluid=[{"name": "water", "viscosity": 1}, {"name": "oil", "viscosity": 5}])
    new = parameter_set("simulate", fluid=[{"name": "water", "viscosity": 1}, {"name": "oil", "viscosity": 6}])
    assert explain_difference(old, new) == ["fluid[oil].viscosity changed from 5 to 6"]


def test_added_removed_and_reordered_bodies_are_told_apart() -> None:
    water, oil = {"name": "water"}, {"name": "oil"}
    one, two, turned = (parameter_set("s", fluid=bodies) for bodies in ([water], [water, oil], [oil, water]))
    assert explain_difference(one, two) == ['fluid[oil] was added: {"name": "oil"}']
    assert explain_difference(two, one) == ['fluid[oil] was removed: {"name": "oil"}']
    assert explain_difference(two, turned) == ["fluid changed its order"]


def test_a_new_tool_version_is_a_difference() -> None:
    old = ParameterSet.of(stage="render", version=1, tools={"bpy": "5.0.1"})
    new = ParameterSet.of(stage="render", version=2, tools={"bpy": "5.2.0"})
    assert explain_difference(old, new) == [
        "stage_version changed from 1 to 2",
        'tools.bpy changed from "5.0.1" to "5.2.0"',
    ]


def test_values_that_json_cannot_hold_are_refused() -> None:
    with pytest.raises(ValueError, match="JSON"):
        parameter_set("s", speed=float("nan"))


def test_a_parameter_may_be_called_stage_but_no_two_share_a_name() -> None:
    old, new = (ParameterSet.of({"stage": {"ground": ground}}, stage="render", version=1, tools={}) for ground in "ab")
    assert explain_difference(old, new) == ['stage.ground changed from "a" to "b"']
    with pytest.raises(ValueError, match="two parameters of stage render are called camera"):
        ParameterSet.of({"camera": 1}, stage="render", version=1, tools={}, camera=2)


def test_fingerprint_depends_on_parameters_input_names_and_input_content_only() -> None:
    task = film(2)[1]
    (source,) = task.inputs
    other = ArtifactPath("cache/000001.h5")
    base = task_fingerprint(task, {source: "a", other: "b"})
    assert task_fingerprint(task, {source: "a", other: "changed"}) == base
    assert task_fingerprint(task, {source: "changed", other: "b"}) != base
    assert task_fingerprint(film(2, camera=(9, 9, 9))[1], {source: "a"}) != base
    assert task_fingerprint(dataclasses.replace(task, inputs=(other,)), {other: "a"}) != base
    assert task_fingerprint(dataclasses.replace(task, outputs=(other,)), {source: "a"}) == base


def test_a_longer_simulation_keeps_its_fingerprint() -> None:
    assert task_fingerprint(film(2)[0], {}) == task_fingerprint(film(500)[0], {})


def test_an_input_without_hash_is_an_error() -> None:
    with pytest.raises(KeyError):
        task_fingerprint(film(1)[1], {})
