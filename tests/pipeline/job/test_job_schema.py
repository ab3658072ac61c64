"""The schema that editors use, and the reference that is made of it."""

import json
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from checked_jobs import load_checked_job
from places import PROJECT

from pipeline.job.loading import load_job
from pipeline.job.reference import reference, with_reference
from pipeline.job.schema import job_schema, node_at
from sim.cloth.parameters import MATERIALS
from sim.soft.materials import Law


def properties(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for table in (schema, *schema["$defs"].values()):
        for key, node in table.get("properties", {}).items():
            yield f"{table.get('title')}.{key}", node


def test_schema_is_of_a_dialect_that_editors_read_and_refuses_unknown_keys():
    schema = job_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["required"] == ["name"]
    assert schema["additionalProperties"] is False
    assert all(table["additionalProperties"] is False for table in schema["$defs"].values())


def test_every_key_says_what_it_means():
    # A table whose key is described in the words of the table itself has them there only; a constant says itself.
    silent = [key for key, node in properties(job_schema()) if not {"description", "const", "$ref"} & set(node)]
    assert silent == []


def test_every_number_has_a_unit():
    """Counts, seeds and encoder settings excepted, whose names say all."""
    plain = {"f_stop", "seed", "samples", "crf", "playback_fps"}
    kinds = {"number", "integer"}
    lacking = [
        key
        for key, node in properties(job_schema())
        if {node.get("type"), *(option.get("type") for option in node.get("anyOf", []))} & kinds
        and "[" not in node["description"]
        and key.rpartition(".")[2] not in plain
    ]
    assert lacking == []


def test_unit_of_a_key_is_found_through_lists_tables_and_alternatives():
    for path, unit in {
        ("fluid", 3, "rest_density"): "kg/m³",
        ("fluid", 0, "dt"): "s",
        ("rigid", 0, "position", 2): "m",
        ("fluid", 0, "block", 1, "shape", "radius"): "m",
        ("material", "anything", "density"): "",
        ("fps",): "",
    }.items():
        assert node_at(path).unit == unit
    assert node_at(("fluid", 0, "no_such_key")).alternatives == node_at(("gravity", 3)).alternatives == ()


def test_examples_in_the_documentation_are_valid_jobs(tmp_path):
    document = (PROJECT / "docs" / "guide" / "job-file.md").read_text(encoding="utf-8")
    examples = re.findall(r"```toml\n(.*?)```", document, re.DOTALL)
    example, many, hammer, vase, led, pouring, joints, forces, sinking, cloth, smoke, soft, limits = examples
    (tmp_path / "drop.toml").write_text(example)
    assert load_job(tmp_path / "drop.toml").frame_count == 90
    (tmp_path / "limited.toml").write_text(f"{example}{limits}")
    assert load_job(tmp_path / "limited.toml").limits_of("render").attempts == 5
    (tmp_path / "castle.toml").write_text(f'name = "castle"\nframes = 2\n{soft}')
    assert load_job(tmp_path / "castle.toml").soft[0].row.law == Law.SAND
    (tmp_path / "many.toml").write_text(f'name = "many"\n{many}')
    assert Counter(body.group for body in load_job(tmp_path / "many.toml").rigid) == {
        "brick": 40,
        "domino": 40,
        "stone": 200,
    }
    (tmp_path / "sinking.toml").write_text(f'name = "sinking"\nframes = 2\n{sinking}')
    assert load_job(tmp_path / "sinking.toml").rigid[0].air_drag == 1.0
    (tmp_path / "led.toml").write_text(f'name = "led"\nframes = 2\n{led}')
    assert load_job(tmp_path / "led.toml").rigid[0].shape.type == "animation"
    (tmp_path / "broken.toml").write_text(f'name = "broken"\n{hammer}{vase}')
    assert Counter(body.group for body in load_job(tmp_path / "broken.toml").rigid) == {"hammer": 1, "vase": 80}
    jug = '[[rigid]]\nname = "jug"\nkind = "kinematic"\nshape = { type = "capsule", radius = 0.035, height = 0.11 }\n'
    poured = example.replace("[[rigid]]", f"{pouring}\n{jug}\n[[rigid]]", 1)
    (tmp_path / "poured.toml").write_text(poured)
    assert load_job(tmp_path / "poured.toml").fluid[0].emitter[0].follow == "jug"
    bodies = [
        f'[[rigid]]\nname = "{name}"\nkind = "dynamic"\ndensity = 500.0\n'
        f'shape = {{ type = "sphere", radius = 0.1 }}\nposition = [{x}, 0.0, {z}]\n'
        for name, x, z in (("wheel", -0.3, 0.24), ("car", 0.1, 0.24), ("trailer", 0.4, 0.24), ("lamp", 0.0, 0.8))
    ]
    awning = (
        '[[cloth]]\nname = "awning"\nshape = { type = "rectangle", size = [0.4, 0.4], resolution = 0.05 }\n'
        'position = [0.0, 0.0, 0.9]\npin = [{ edge = "x-" }, { edge = "x+" }]\n'
    )
    (tmp_path / "joined.toml").write_text(f'name = "joined"\n{joints}{"".join(bodies)}{awning}')
    loaded, findings = load_checked_job(tmp_path / "joined.toml")
    assert [joint.name for joint in loaded.job.joint] == ["axle", "tow", "hook"]
    assert findings.warnings == []
    plume = '[[smoke]]\nname = "smoke"\n[[smoke.source]]\nshape = { type = "sphere", radius = 0.1 }\n'
    plume += "position = [0.0, 0.0, 0.3]\n"
    (tmp_path / "windy.toml").write_text(f'name = "windy"\nduration = 4.0\n{forces}{bodies[0]}{plume}')
    loaded, findings = load_checked_job(tmp_path / "windy.toml")
    assert len(loaded.job.force) == 6
    assert findings.warnings == []
    (tmp_path / "flag.toml").write_text(f'name = "flag"\n{cloth}')
    assert len(load_job(tmp_path / "flag.toml").cloth[0].pin) == 2
    car = '[[rigid]]\nname = "car"\nshape = { type = "box", size = [0.4, 0.2, 0.1] }\nposition = [0.0, 0.2, 0.1]\n'
    (tmp_path / "torch.toml").write_text(f'name = "torch"\nframes = 120\n{smoke}{car}')
    _, findings = load_checked_job(tmp_path / "torch.toml")
    assert findings.warnings == []


def test_reference_in_the_documentation_is_current():
    document = (PROJECT / "docs" / "guide" / "job-file.md").read_text(encoding="utf-8")
    assert with_reference(document) == document, "run: python -m pipeline.job.reference docs/guide/job-file.md"


def test_the_reference_has_all_digits_of_bounds_as_messages_do():
    assert "`seed`</a> | whole number ≥ 0 and < 2147483648 |" in reference()
    assert "`max_particles`</a> | whole number ≥ 1 and ≤ 2147483647 |" in reference()


def test_each_key_in_the_reference_has_an_anchor_of_its_own():
    rows = re.findall(r"^\| (?!key |---|material |\")(.*?) \|", reference(), re.MULTILINE)
    found = [re.fullmatch(r'<a id="(.+?)" href="#\1">`(.+)`</a>', row) for row in rows]
    assert len(rows) > 200
    assert all(match and match[1].split(".")[-1] == match[2] for match in found)
    anchors = [match[1] for match in found]
    assert len(set(anchors)) == len(anchors)
    assert {"name", "fluid.block.position", "shape.box.size", "cloth.shape.rectangle.counts", "material.look"} <= set(
        anchors
    )


def test_the_reference_has_what_each_material_of_cloth_gives():
    lines = reference().splitlines()
    rows = {line.split('"')[1]: line.split(" | ")[1:] for line in lines if line.startswith('| "')}
    assert rows.keys() == MATERIALS.keys()
    for material, numbers in MATERIALS.items():
        assert [float(cell) for cell in rows[material][: len(numbers)]] == pytest.approx(
            list(numbers.values()), rel=1e-4
        )
    # Those of cotton are no defaults of another material.
    (mass,) = (line for line in lines if "`mass_per_area`</a> |" in line)
    assert "| the material's |" in mass


def test_the_schema_that_the_sample_jobs_name_is_current():
    stored = json.loads((PROJECT / "docs" / "job.schema.json").read_text(encoding="utf-8"))
    assert stored == job_schema(), "run: pipeline schema > docs/job.schema.json"
