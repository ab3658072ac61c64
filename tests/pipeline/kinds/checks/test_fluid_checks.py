"""Jobs whose fluids cannot be meant together, or whose emitters cannot."""

import numpy as np
import pytest
from checked_jobs import checked, says

from pipeline.job.loading import read_job
from pipeline.kinds.checks.fluid_size import MOST_CELLS, particle_room
from pipeline.kinds.checks.jets import check_jets
from pipeline.model.problems import Findings
from sim.fluid.filling import fill_fluids
from sim.fluid.opening import Opening
from sim.shapes.parameters import Placement
from sim.shapes.placement import PlacedSolid, build_solid

HEAD = 'name = "tank"\nframes = 60\n'
WATER = """
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [1.0, 1.0, 0.2] }
position = [0.0, 0.0, 0.1]
"""
OIL = """
[[fluid]]
name = "oil"
particle_radius = 0.02
rest_density = 900.0
[[fluid.block]]
shape = { type = "box", size = [1.0, 1.0, 0.2] }
position = [0.0, 0.0, 0.3]
"""
JET = """
[[fluid]]
name = "jet"
particle_radius = 0.02
[[fluid.emitter]]
shape = { type = "disc", radius = 0.1 }
position = [0.0, 0.0, 0.9]
direction = [0.0, 0.0, -1.0]
speed = 1.0
"""


@pytest.mark.parametrize("text", [HEAD + WATER + OIL, HEAD + JET, HEAD + WATER + JET])
def test_fluids_that_go_together_pass_without_a_word(text, tmp_path):
    errors, warnings, findings = checked(text, tmp_path / "tank.toml")
    assert errors == warnings == []
    assert findings.elements["fluid"] > 300


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (WATER + OIL.replace("0.02", "0.01"), '13 fluid[1].particle_radius: is 0.01, but 0.02 in fluid[0] "water"'),
        (WATER + OIL.replace("900.0", "50.0"), "14 fluid[1].rest_density: is 50 kg/m³, and 1000 kg/m³ in fluid[0]"),
        (
            JET.replace("0.0, -1.0", "0.0, 1.0").replace("0.9]", "1.0]"),
            "7 fluid[0].emitter[0]: 21 of the 21 places of its opening are outside the domain",
        ),
        (JET.replace("radius = 0.1", "radius = 0.01"), "8 fluid[0].emitter[0].shape: is too narrow ... 0.04 m apart"),
        (
            WATER + "[domain]\nmin = [-40, -40, 0]\nmax = [40, 40, 100]",
            "10 domain: has 9.47e+08 cells ... 0.02 m particles, more than 2.68e+08 ... particle_radius 0.032 m",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_a_remedy(text, expected, tmp_path):
    errors, _, _ = checked(HEAD + text, tmp_path / "tank.toml", memory_bytes=10**15)
    assert any(says(error, f"tank.toml:{expected}") for error in errors), errors


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (WATER + OIL.replace("0.3]", "0.22]"), '15 fluid[1].block[0]: shares 40 % ... fluid[0].block[0] ... "water"'),
        (JET + "start_s = 3.0", "12 fluid[0].emitter[0].start_s: starts at 3 s, after the film's end at 1 s"),
        (JET.replace("speed = 1.0", "speed = 1000.0"), "11 fluid[0].emitter[0].speed: 1000 m/s crosses"),
    ],
)
def test_what_is_hardly_meant_is_warned_of(text, expected, tmp_path):
    _, warnings, _ = checked(HEAD + text, tmp_path / "tank.toml")
    assert any(says(warning, f"tank.toml:{expected}") for warning in warnings), warnings


@pytest.mark.parametrize(("thickness", "is_warned_of"), [(0.01, True), (0.08, False)])
def test_a_plate_thinner_than_the_particles_can_hold_is_warned_of(thickness, is_warned_of, tmp_path):
    plate = f'[[rigid]]\nname = "plate"\nshape = {{ type = "box", size = [0.5, 0.5, {thickness}] }}\n'
    errors, warnings, _ = checked(HEAD + WATER + plate + "position = [0, 0, 0.6]\n", tmp_path / "tank.toml")
    assert errors == []
    expected = "tank.toml:12 rigid[0].shape: is 0.01 m thin ... 0.076 m ... particle_radius 0.0026 m"
    assert [says(warning, expected) for warning in warnings] == ([True] if is_warned_of else [])


@pytest.mark.parametrize(("wall", "is_warned_of"), [(0.05, True), (0.1, False)])
def test_a_vessel_whose_wall_is_thinner_than_the_particles_can_hold_is_warned_of(wall, is_warned_of, tmp_path):
    inner = 0.3 - wall
    cup = f"[[0, 0], [0.3, 0], [0.3, 0.5], [{inner}, 0.5], [{inner}, {wall}], [0, {wall}]]"
    vessel = f'[[rigid]]\nname = "cup"\nshape = {{ type = "revolved", profile = {cup} }}\nposition = [0, 0, 0.6]\n'
    errors, warnings, _ = checked(HEAD + WATER + vessel, tmp_path / "tank.toml")
    assert errors == []
    expected = "tank.toml:12 rigid[0].shape: is 0.05 m thin ... 0.076 m ... particle_radius 0.013 m"
    assert [says(warning, expected) for warning in warnings] == ([True] if is_warned_of else [])


def test_the_mass_of_a_block_is_told_beside_that_of_its_volume(tmp_path):
    cube = WATER.replace("[1.0, 1.0, 0.2]", "[0.3, 0.3, 0.3]").replace("0.1]", "0.5]")
    _, _, findings = checked(HEAD + cube, tmp_path / "tank.toml")
    fact = findings.facts[0]
    assert fact.path == ("fluid", 0, "block", 0)
    made = findings.elements["fluid"] * 1000.0 * 0.04**3
    assert fact.message == f"holds {made:.3g} kg of water, 27 kg by its volume"


@pytest.mark.parametrize("size", ["0.3, 0.3, 0.3", "0.47, 0.33, 0.29"])
def test_a_preview_has_the_same_mass(size, tmp_path):
    path = tmp_path / "tank.toml"
    path.write_text(HEAD + WATER.replace("1.0, 1.0, 0.2", size).replace("0.1]", "0.5]"))
    masses = []
    for preview in (False, True):
        job = read_job(path, preview=preview).job
        (block,) = fill_fluids(job.fluid, job.domain, []).phase.shape
        masses.append(block * job.fluid[0].lattice_volume)
    assert masses[1] == pytest.approx(masses[0], rel=0.01)


def test_an_emitter_in_a_solid_body_is_refused(tmp_path):
    ball = '[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.2 }\nposition = [0.0, 0.0, 0.9]\n'
    errors, _, _ = checked(HEAD + ball + JET, tmp_path / "tank.toml")
    assert any("places of its opening are in a solid body; move it out" in error for error in errors)


def test_emitters_in_each_others_way_are_refused_at_load(tmp_path):
    again = JET.split("[[fluid.emitter]]")[1]
    same = "[[fluid.emitter]]" + again
    errors, _, _ = checked(HEAD + JET + same, tmp_path / "tank.toml")
    assert [error.split("emitter[1]")[1] for error in errors] == [
        ": is the same opening as fluid[0].emitter[0], at the same time; let one start when the other has ended"
    ]
    moved = same.replace("[0.0, 0.0, 0.9]", "[0.15, 0.0, 0.9]")
    errors, _, _ = checked(HEAD + JET + moved, tmp_path / "tank.toml")
    assert len(errors) == 1
    assert "its opening overlaps that of fluid[0].emitter[0], at the same time" in errors[0]
    errors, _, _ = checked(HEAD + JET + "end_s = 0.5\n" + same + "start_s = 0.5\n", tmp_path / "tank.toml")
    assert errors == []


def emitter(position: str, direction: str, *, speed: float = 2.0, more: str = "") -> str:
    return f"""
[[fluid.emitter]]
shape = {{ type = "disc", radius = 0.1 }}
position = {position}
direction = {direction}
speed = {speed}
{more}
"""


JETS = JET.partition("[[fluid.emitter]]")[0]
ACROSS = emitter("[-0.45, 0.0, 0.5]", "[1, 0, 0]", speed=5.0)
FOUNTAIN = emitter("[0.0, 0.0, 0.16]", "[0.17365, 0, 0.98481]", speed=3.0)


@pytest.mark.parametrize(
    ("text", "arrival"),
    [
        # Straight ahead at 5 m/s to the edge of the other, 0.8 m away, and from above by a fall of half a metre.
        (emitter("[0.45, 0.0, 0.5]", "[-1, 0, 0]", speed=5.0, more="start_s = 0.2") + ACROSS, "0.15"),
        (emitter("[0.1, 0.0, 0.25]", "[0, 0, -1]") + emitter("[0.1, 0.0, 0.9]", "[0, 0, -1]"), "0.2"),
        # On a parabola over 0.6 m, which is 9 cm lower there than a straight line.
        (emitter("[0.3, 0.0, 0.22]", "[0, 0, -1]") + emitter("[-0.4, 0.0, 0.55]", "[1, 0, 0]", speed=3.0), "0.2"),
        # Up at 80 degrees and down again after 2 v sin(80°)/g = 0.60 s, 0.31 m away: 1.6 times as long as it would
        # take to the far corner without gravity. The core is there a little sooner.
        (emitter("[0.3, 0.0, 0.16]", "[0, 0, 1]", more="start_s = 0.9") + FOUNTAIN, "0.58"),
    ],
    ids=["head-on", "from above", "on a parabola", "fountain"],
)
def test_a_jet_that_runs_into_another_opening_is_warned_of(text, arrival, tmp_path):
    errors, warnings, _ = checked(HEAD + JETS + text, tmp_path / "tank.toml")
    assert errors == []
    hits = [warning for warning in warnings if "its jet runs into the opening of fluid[0].emitter[0]" in warning]
    assert len(hits) == 1
    seconds = float(hits[0].partition("emitter[0] ")[2].partition(" s ")[0])
    assert seconds == pytest.approx(float(arrival), abs=0.05)


@pytest.mark.parametrize(
    "text",
    [
        emitter("[-0.2, 0.0, 0.9]", "[0, 0, -1]") + emitter("[0.2, 0.0, 0.9]", "[0, 0, -1]"),
        # It would meet the other one without the pool between, or without the post.
        emitter("[0.1, 0.0, 0.1]", "[0, 0, 1]")
        + emitter("[0.1, 0.0, 0.9]", "[0, 0, -1]")
        + WATER.replace("0.1]", "0.35]").replace('name = "water"', 'name = "pool"'),
        emitter("[0.45, 0.0, 0.5]", "[-1, 0, 0]")
        + emitter("[-0.45, 0.0, 0.5]", "[1, 0, 0]")
        + '[[rigid]]\nname = "post"\nshape = { type = "box", size = [0.1, 0.4, 0.9] }\nposition = [0, 0, 0.5]\n',
        # It falls below the other one before it is there.
        emitter("[0.4, 0.0, 0.6]", "[-1, 0, 0]", more="start_s = 0.9")
        + emitter("[-0.4, 0.0, 0.6]", "[1, 0, 0]", speed=1.0),
    ],
    ids=["side by side", "pool between", "post between", "too slow"],
)
def test_jets_that_meet_something_else_first_pass_without_a_word(text, tmp_path):
    errors, warnings, _ = checked(HEAD + JETS + text, tmp_path / "tank.toml")
    assert errors == []
    assert not [warning for warning in warnings if "its jet" in warning or "before its opening" in warning]


def test_a_body_out_of_a_jets_way_is_not_asked_for_distances(tmp_path, monkeypatch):
    """Those of a mesh take long, and thousands of places are looked at."""
    path = tmp_path / "tank.toml"
    path.write_text(HEAD + JET)
    job = read_job(path).job
    box = {"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}}
    below, far = (build_solid(Placement(**box, position=each)) for each in ((0.0, 0.0, 0.3), (0.4, 0.4, 0.5)))
    asked = []
    distance = PlacedSolid.signed_distance

    def record(solid, points):
        asked.append(solid)
        return distance(solid, points)

    monkeypatch.setattr(PlacedSolid, "signed_distance", record)
    opening = Opening.of(job.fluid[0].emitter[0], 0.04, 0.04**3)
    solids = {("rigid", 0): below, ("rigid", 1): far}
    check_jets(job, solids, {("fluid", 0, "emitter", 0): opening}, 0.04, Findings())
    assert set(map(id, asked)) == {id(below)}


PLATE = '[[rigid]]\nname = "plate"\nshape = {{ type = "box", size = [0.5, 0.5, 0.02] }}\nposition = [0, 0, {height}]\n'


@pytest.mark.parametrize(
    ("text", "room"),
    [
        (emitter("[0.0, 0.0, 0.07]", "[0, 0, -1]"), "0.07"),  # the floor
        (emitter("[0.0, 0.0, 0.9]", "[0, 0, -1]") + PLATE.format(height=0.82), "0.07"),
        (emitter("[0.44, 0.0, 0.5]", "[1, 0, 0]"), "0.06"),
    ],
    ids=["floor", "plate", "side wall"],
)
def test_an_opening_right_before_a_wall_is_warned_of(text, room, tmp_path):
    errors, warnings, _ = checked(HEAD + JETS + text, tmp_path / "tank.toml")
    assert errors == []
    (warning,) = (each for each in warnings if "before its opening" in each)
    assert float(warning.partition("body is ")[2].partition(" m ")[0]) == pytest.approx(float(room), abs=0.02)


@pytest.mark.parametrize(
    "text",
    [
        emitter("[0.0, 0.0, 0.12]", "[0, 0, -1]"),  # a layer of 4 cm, and a quarter of its width
        emitter("[0.0, 0.0, 0.9]", "[0, 0, -1]") + PLATE.format(height=0.7),
        # A thin post takes less than half of the jet.
        emitter("[0.0, 0.0, 0.9]", "[0, 0, -1]") + PLATE.format(height=0.75).replace("0.5, 0.5", "0.05, 0.5"),
        emitter("[0.44, 0.0, 0.5]", "[1, 0, 0]") + '[domain]\nopen_faces = ["x+"]\n',
    ],
    ids=["high enough", "plate below", "thin", "open"],
)
def test_an_opening_with_room_before_it_passes_without_a_word(text, tmp_path):
    errors, warnings, _ = checked(HEAD + JETS + text, tmp_path / "tank.toml")
    assert errors == []
    assert not [warning for warning in warnings if "before its opening" in warning]


BOTTLED = JET.replace("direction =", 'follow = "bottel"\ndirection =')
BOTTLE = '[[rigid]]\nname = "bottle"\nkind = "kinematic"\nshape = { type = "box", size = [0.1, 0.1, 0.1] }\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOTTLED, '10 fluid[0].emitter[0].follow: no rigid body is named "bottel"; add [[rigid]]'),
        (BOTTLE + BOTTLED, '14 fluid[0].emitter[0].follow: no rigid body is named "bottel"; did you mean "bottle"?'),
        (
            JET + "total_volume = 2.0e-5",
            "12 fluid[0].emitter[0].total_volume: makes 2e-05 m³ in all, less than half a particle of 6.4e-05 m³ ... "
            "particle_radius 0.017 m",
        ),
        (JET + "end_s = 2.0e-4", "12 fluid[0].emitter[0].end_s: makes 6.3e-06 m³ in all"),
        (
            JET.replace('{ type = "disc", radius = 0.1 }', '{ type = "mesh", file = "gone.obj" }'),
            "8 fluid[0].emitter[0].shape.file: no such file",
        ),
    ],
)
def test_what_an_emitter_cannot_be_is_refused_with_the_number_that_decides(text, expected, tmp_path):
    errors, _, _ = checked(HEAD + text, tmp_path / "tank.toml")
    assert [error for error in errors if says(error, f"tank.toml:{expected}")], errors


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            JET.replace("speed = 1.0", "flow_rate = 1.0"),
            "11 fluid[0].emitter[0].flow_rate: 1 m³/s through 0.031 m² is a jet of 31.8 m/s ... within 10 frames; use "
            "an opening of 0.097 m², or 0.32 m³/s",
        ),
        (
            JET + "ramp = [{ time_s = 1.0, strength = 0.0 }, { time_s = 2.0, strength = 1.0 }]",
            "12 fluid[0].emitter[0].ramp: is 0 whenever it emits in the film's 1 s: it emits nothing",
        ),
        (
            WATER.replace("[1.0, 1.0, 0.2]", "[1.0, 1.0, 0.8]").replace("0.1]", "0.4]") + JET.replace("1.0\n", "8.0\n"),
            "14 fluid[1].emitter[0]: overfills the domain: with it 1.05 m³ are in by 1 s, and there is room for 1 m³; "
            "use total_volume = 0.2",
        ),
    ],
)
def test_what_an_emitter_hardly_means_is_warned_of_with_the_number_that_decides(text, expected, tmp_path):
    _, warnings, _ = checked(HEAD + text, tmp_path / "tank.toml")
    assert [warning for warning in warnings if says(warning, f"tank.toml:{expected}")], warnings


@pytest.mark.parametrize(("litres", "is_warned_of"), [(1.2, False), (2.2, True)])
def test_a_vessel_that_would_be_overfilled_is_warned_of(litres, is_warned_of, tmp_path):
    import trimesh

    # A floor and four walls of 20 mm, 80 mm deep: 0.14 x 0.14 x 0.08 m³ are 1.57 l.
    parts = [([0.18, 0.18, 0.02], [0.0, 0.0, 0.01])]
    parts += [([0.02, 0.18, 0.1], [x, 0.0, 0.05]) for x in (-0.08, 0.08)]
    parts += [([0.18, 0.02, 0.1], [0.0, y, 0.05]) for y in (-0.08, 0.08)]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    trimesh.util.concatenate(boxes).export(tmp_path / "cup.stl")
    cup = '[[rigid]]\nname = "cup"\nshape = { type = "mesh", file = "cup.stl" }\nposition = [0.0, 0.0, 0.05]\n'
    text = (
        HEAD + cup + JET.replace("0.1 }", "0.05 }").replace("0.02\n", "0.01\n") + f"total_volume = {litres / 1000.0}\n"
    )
    errors, warnings, _ = checked(text, tmp_path / "tank.toml")
    assert errors == []
    overfilled = [each for each in warnings if "overfills rigid[0]: 2.2 l come in by 1 s, and it holds 1." in each]
    assert [bool(each) for each in overfilled] == ([True] if is_warned_of else [])
    if is_warned_of:
        assert 0.0015 <= float(overfilled[0].rpartition(" = ")[2]) <= 0.0016


def test_memory_counts_what_emitters_may_add(tmp_path):
    # The domain of 1 m³ holds 15,625 particles of 4 cm, and an endless jet may fill it.
    for text, is_refused in ((JET, True), (JET.replace("[[fluid.e", "max_particles = 3000\n[[fluid.e"), False)):
        errors, _, _ = checked(HEAD + text, tmp_path / "tank.toml", memory_bytes=8_000_000)
        assert any("or give emitters an end_s, or the fluid max_particles" in error for error in errors) == is_refused


def test_the_room_is_that_of_the_simulation(tmp_path):
    _, _, _ = checked(HEAD + JET + "end_s = 0.5", tmp_path / "tank.toml")
    job = read_job(tmp_path / "tank.toml").job
    # 1 m/s through pi 0.1² m² for half a second, in particles of 0.04³ m³.
    assert particle_room(job, 0, 0.0) == pytest.approx(np.pi * 0.01 * 0.5 / 0.04**3, abs=1)


def test_the_limit_is_that_of_the_simulation():
    from sim.core.cells import MAX_CELLS

    assert MOST_CELLS == MAX_CELLS


def test_an_emitter_that_runs_dry_is_counted(tmp_path):
    """A ramp that ends at 0, without end_s, had no number of particles."""
    text = HEAD + JET + "ramp = [{ time_s = 0.0, strength = 1.0 }, { time_s = 0.5, strength = 0.0 }]"
    errors, _, _ = checked(text, tmp_path / "tank.toml")
    assert errors == []
    job = read_job(tmp_path / "tank.toml").job
    assert particle_room(job, 0, 0.0) == pytest.approx(np.pi * 0.01 * 0.25 / 0.04**3, abs=1)


def test_a_block_thinner_than_a_particle_has_its_mass_and_not_its_shape(tmp_path):
    for thin, is_warned_of in ((0.01, True), (0.04, False)):
        text = HEAD + WATER.replace("[1.0, 1.0, 0.2]", f"[1.0, 1.0, {thin}]")
        errors, warnings, _ = checked(text, tmp_path / "tank.toml")
        told = "fluid[0].block[0]: is 0.01 m thin and particles are 0.04 m apart: they have its mass, not its shape"
        assert errors == []
        assert any(f"{told}; use a particle_radius of 0.005 m or less" in each for each in warnings) == is_warned_of


@pytest.mark.parametrize(("cap", "is_warned_of"), [("", True), ("max_particles = 600\n", False)])
def test_the_cap_of_a_fluid_is_of_all_its_emitters(cap, is_warned_of, tmp_path):
    """Two of 0.031 m³ each, or of 0.038 m³ in all, where there is room for 0.05."""
    water = WATER.replace("[1.0, 1.0, 0.2]", "[1.0, 1.0, 0.95]").replace("0.1]", "0.475]")
    head, emitter = JET.replace("0.0, 0.0, 0.9", "-0.25, 0.0, 0.98").split("[[fluid.emitter]]")
    emitters = [emitter, emitter.replace("-0.25", "0.25")]
    text = HEAD + water + head + cap + "".join("[[fluid.emitter]]" + each for each in emitters)
    _, warnings, _ = checked(text, tmp_path / "tank.toml")
    assert any("overfills the domain" in warning for warning in warnings) == is_warned_of


POOL = """
[domain]
min = [-0.2, -0.2, 0.0]
max = [0.2, 0.2, 0.6]
[[fluid]]
name = "water"
particle_radius = 0.01
[[fluid.block]]
shape = { type = "box", size = [0.4, 0.4, 0.24] }
position = [0.0, 0.0, 0.12]
"""


def floater(shape: str, height: float, density: float, *, more: str = "") -> str:
    return f"""
[[rigid]]
name = "floater"
kind = "dynamic"
density = {density}
shape = {{ {shape} }}
position = [0.0, 0.0, {height}]
{more}"""


BOX, TALL = ('type = "box", size = [0.1, 0.1, 0.08]', 'type = "box", size = [0.1, 0.1, 0.4]')
TILTED = 'type = "box", size = [0.4, 0.1, 0.027]'
BALL = 'type = "sphere", radius = 0.05'


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (floater(BOX, 0.04, 300.0), "0.24 m of fluid"),
        (floater(BOX, 0.05, 300.0), "or use particle_radius 0.005 m"),  # half a spacing: measured, it stays as well
        (floater(BOX, 0.06, 300.0), None),  # a spacing: measured, it rises
        (floater(BOX, 0.04, 1200.0), None),  # which lies there by its weight
        (floater(BALL, 0.05, 300.0), None),  # measured, it rises
        (floater(BOX, 0.04, 300.0, more="rotation_deg = [0.0, 30.0, 0.0]"), None),  # on an edge: below the floor
        (floater(TALL, 0.2, 300.0), "0.24 m of fluid"),
        # Tilted by 10 degrees: of an underside 0.1 m wide 0.02 / tan(10) = 0.113 m are less than a spacing up.
        (floater(TILTED, 0.0481, 300.0, more="rotation_deg = [0.0, 10.0, 0.0]"), "on 0.011 m²"),
    ],
)
def test_a_light_body_that_starts_flush_on_the_floor_is_told_that_it_stays_there(body, told, tmp_path):
    _, warnings, _ = checked(HEAD + POOL + body, tmp_path / "pool.toml")
    pressed = [line for line in warnings if "stays on the floor" in line]
    assert len(pressed) == (told is not None)
    assert told is None or told in pressed[0]
