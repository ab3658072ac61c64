"""Cloths that a job describes badly: every line that `check` says has the place, the reason and the remedy."""

import numpy as np
import pytest
from checked_jobs import says
from cloth_jobs import BALL, SHEET, errors, warnings

from pipeline.base.errors import JobFileError

FILM = "frames = 60\n" + SHEET
"""One second."""
EDGE = '[[cloth.pin]]\nedge = "x-"\n'


def without_line(problem: str) -> str:
    """A problem without the file and the line that it begins with."""
    return problem.partition(" ")[2]


def pin_path(first_s: float, last_s: float, offset: str = "[0.1, 0.0, 0.0]") -> str:
    return f"keyframe = [{{ time_s = {first_s} }}, {{ time_s = {last_s}, offset = {offset} }}]"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (EDGE + "release_s = 0", "cloth[0].pin[0].release_s: must be > 0 s, got 0"),
        (EDGE + "release_s = 0.2\n" + pin_path(0.3, 0.5), "cloth[0].pin[0]: release_s is 0.2 s ... starts at 0.3 s"),
        (EDGE + "keyframe = [{ time_s = 0.0 }]", "cloth[0].pin[0]: keyframe: a path needs two keyframes"),
        (
            '[[cloth.pin]]\nregion = { type = "box", min = [-1.0, 0.2, 0.0], max = [1.0, -0.2, 1.0] }',
            "cloth[0].pin[0].region: max must not be below min along y, got 0.2 m to -0.2 m",
        ),
        ("mass_per_area = 0.0", "cloth[0].mass_per_area: must be > 0 kg/m², got 0"),
        ("stretch_stiffness = -1.0", "cloth[0].stretch_stiffness: must be > 0 N/m, got -1"),
    ],
)
def test_what_no_cloth_can_be_is_refused_where_it_is_written(text, expected, tmp_path):
    with pytest.raises(JobFileError) as refused:
        errors(FILM + text, tmp_path)
    (problem,) = refused.value.problems
    assert says(without_line(problem), expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("velocity = [0.0, 0.0, -2e4]", "cloth[0].velocity: must be below 10000 m/s, got 20000 m/s"),
        ("wind = [1e4, 0.0, 0.0]", "cloth[0].wind: must be below 10000 m/s, got 10000 m/s"),
        (
            BALL.replace("0.3]", "0.5]").replace("0.1", "0.45"),
            'cloth[0]: starts inside "ball" ... (-0.2, -0.2, 0.5)',
        ),
        (
            'integrator = "explicit"\nsubsteps = 20\nstretch_stiffness = 1e6',
            "cloth[0].substeps: 20 substeps a frame are 0.000833 s ... 9.58e-06 s; give substeps = 1739",
        ),
    ],
)
def test_what_cannot_be_simulated_is_refused(text, expected, tmp_path):
    (problem,) = errors(FILM + text, tmp_path)
    assert says(without_line(problem), expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (EDGE + "release_s = 1.0", "cloth[0].pin[0].release_s: lets go at 1 s, after the film's end at 1 s"),
        (EDGE + pin_path(2.0, 3.0), "cloth[0].pin[0].keyframe: starts to move at 2 s, after the film's end at 1 s"),
        (EDGE + pin_path(0.0, 0.5, "[0.0, 0.0, 0.0]"), "cloth[0].pin[0].keyframe: never moves"),
        (
            # 0.3 m in 2 ms at a constant speed; a substep of 1/1200 s; cells of 5 cm have diagonals of 7.07 cm.
            EDGE + pin_path(0.0, 0.002, "[0.3, 0.0, 0.0]") + '\ninterpolation = "linear"',
            "cloth[0].pin[0].keyframe: moves at up to 150 m/s, 0.125 m in a substep, further than the 0.0707 m",
        ),
        ("wind = [5.0, 0.0, 0.0]\nair_density = 0.0", "cloth[0].wind: has no effect without air_density"),
        (
            "wind = [5.0, 0.0, 0.0]\ndrag = 0.0\nskin_drag = 0.0",
            "cloth[0].wind: has no effect without drag",
        ),
    ],
)
def test_what_the_film_will_not_show_is_told(text, expected, tmp_path):
    (warning,) = warnings(FILM + text, tmp_path)
    assert says(without_line(warning), expected)


@pytest.mark.parametrize("substeps", ["", "substeps = 400\n"], ids=["as many as springs need", "given"])
def test_a_fast_pin_of_explicit_springs_is_judged_by_the_substeps_that_are_given(substeps, tmp_path):
    """0.3 m in 2 ms are 6 mm in a substep of 1/24000 s; how long steps of explicit springs are is not known here."""
    path = pin_path(0.0, 0.002, "[0.3, 0.0, 0.0]") + "\ninterpolation = 'linear'"
    assert warnings(f'{FILM}integrator = "explicit"\n{substeps}{EDGE}{path}', tmp_path) == []


def test_a_pin_that_rests_moves_and_lets_go_within_the_film_is_fine(tmp_path):
    path = pin_path(0.2, 0.5) + "\nrelease_s = 0.4"
    assert warnings(FILM + EDGE + path, tmp_path) == []


# --- meshes --------------------------------------------------------------------------------------------------------

SQUARE = ("0 0 0", "0.2 0 0", "0.2 0.2 0", "0 0.2 0")


def mesh_job(folder, vertices, faces, suffix="") -> str:
    """A job with an OBJ of these vertices, and of faces that count from 1."""
    (folder / "shawl.obj").write_text(
        "\n".join([*(f"v {each}" for each in vertices), *(f"f {each}" for each in faces)])
    )
    return SHEET.replace('"rectangle", size = [0.4, 0.4], counts = [9, 9]', '"mesh", file = "shawl.obj"') + suffix


RECTANGLE = [f"{x} {y} 0" for x, y in ((0, 0), (400, 0), (400, 300), (0, 300))]


@pytest.mark.parametrize(
    ("vertices", "faces", "expected"),
    [
        ([*SQUARE, "0.1 0 0"], ["1 2 3 4", "1 2 5"], "1 triangles ... no area ... (0, -0.1, 0) m ... 0, 1 and 4"),
        (
            [*SQUARE, "0.1 0.1 0.1"],
            ["1 2 3", "1 3 4", "1 3 5"],
            "1 edges ... three triangles or more, the first at (0, 0, -0.05) m between vertices 0 and 2",
        ),
        (["nan 0 0", *SQUARE[1:]], ["1 2 3 4"], 'vertex 0 of "shawl.obj" is not finite'),
        (["1 1 1"] * 3, ["1 2 3"], '"shawl.obj" is 0 m across, which must be between 1e-06 m and 1e+06 m'),
        ([f"{x} 0 0" for x in range(3)], ["1 2 3"], '1 triangles of "shawl.obj" have no area'),
        (SQUARE, [], '"shawl.obj" has no triangles'),
    ],
)
def test_a_mesh_that_is_no_sheet_is_refused_and_its_vertices_are_named(vertices, faces, expected, tmp_path):
    (problem,) = errors(mesh_job(tmp_path, vertices, faces), tmp_path)
    assert says(problem, f"drape.toml:6 cloth[0].shape: shape.file: {expected}")


@pytest.mark.parametrize(
    ("vertices", "faces", "expected"),
    [
        ([*SQUARE, *SQUARE], ["1 2 3", "5 7 8"], ["merged 4 split or unused vertices"]),
        (SQUARE, ["1 2 3 4", "1 1 2"], ["dropped 1 collapsed or repeated triangles"]),
        (SQUARE, ["1 2 3", "1 3 4", "3 2 1", "4 3 1"], ["dropped 2 collapsed or repeated triangles"]),
        (SQUARE, ["1 2 3", "1 4 3"], ["turned 1 of 2 triangles"]),
        # So far away that vertices of the sheet would be merged, if it counted for its size.
        ([*SQUARE, "5e6 nan 0"], ["1 2 3 4"], ["merged 1 split or unused vertices"]),
        (RECTANGLE, ["1 2 3 4"], ["is 400 m across, the domain 1 m"]),
        ([*SQUARE, *(each[:-1] + "0.1" for each in SQUARE)], ["1 2 3 4", "8 7 6 5"], []),
    ],
)
def test_a_mesh_that_can_be_repaired_is_and_it_is_said(vertices, faces, expected, tmp_path):
    told = warnings(mesh_job(tmp_path, vertices, faces), tmp_path)
    assert len(told) == len(expected)
    assert all(part in line for part, line in zip(expected, told, strict=True))


def test_pins_mean_the_vertices_of_the_file_whatever_its_seams(tmp_path):
    """Two squares side by side; texture coordinates, materials and objects differ where they meet."""
    from pipeline.job.loading import read_job
    from sim.cloth.sheet import build_sheet
    from sim.cloth.start import pins_of, start_positions

    places = [[0, 0, 0], [0.2, 0, 0], [9, 9, 9], [0, 0.2, 0], [0.2, 0.2, 0], [0.4, 0, 0], [0.4, 0.2, 0]]
    faces = ["1/1/1 2/2/1 5/3/1 4/4/1\no right\nusemtl blue", "2/5/1 6/6/1 7/7/1 5/8/1"]
    seams = "".join(f"vt {k / 8} 0\n" for k in range(8)) + "vn 0 0 1\no left\nusemtl red"
    text = mesh_job(
        tmp_path, [*(" ".join(map(str, place)) for place in places)], [], "[[cloth.pin]]\nindex = [1, 4, 6]\n"
    )
    with (tmp_path / "shawl.obj").open("a") as file:
        file.write("\n".join(["", seams, *(f"f {face}" for face in faces)]))
    assert errors(text, tmp_path) == []
    (cloth,) = read_job(tmp_path / "drape.toml").job.cloth
    sheet = build_sheet(cloth.shape)
    position = start_positions(cloth, sheet)
    (nodes,) = pins_of(cloth)
    held = position[nodes]
    # The box of 0.4 x 0.2 m is centred at (0, 0, 0.5).
    expected = np.array(places)[[1, 4, 6]] + [-0.2, -0.1, 0.5]
    np.testing.assert_allclose(sorted(held.tolist()), sorted(expected.tolist()), atol=1e-12)

    (problem,) = errors(text.replace("[1, 4, 6]", "[2]"), tmp_path)
    assert problem.endswith("index 2 is a vertex that no triangle of the mesh uses; pin another")
    (problem,) = errors(text.replace("[1, 4, 6]", "[7]"), tmp_path)
    assert problem.endswith("index 7 does not exist; the mesh has vertices 0 to 6")


FINE = """
name = "fine"
frames = 60
domain = { min = [-1.0, -1.0, 0.0], max = [1.0, 1.0, 1.0] }

[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [1.0, 1.0], counts = [COUNT, COUNT] }
position = [0.0, 0.0, 0.5]
"""
CORNERS = '[[cloth.pin]]\ncorner = "x-y-"\n[[cloth.pin]]\ncorner = "x+y-"\n'


@pytest.mark.parametrize(
    ("count", "text", "said"),
    [
        # 128² / 2 nodes g dt² are 56 mm, at 7.9 mm between them: 7.09 times.
        (128, CORNERS, "or substeps = 76"),
        (128, "substeps = 76\n" + CORNERS, None),
        (128, EDGE, None),
        (32, CORNERS, None),
        (128, CORNERS.replace("corner", "release_s = 0.2\ncorner"), None),
    ],
    ids=["corners", "short steps", "edge", "coarse", "let go"],
)
def test_fine_cloth_on_single_nodes_is_warned_of_with_the_steps_that_do(count, text, said, tmp_path):
    found = [
        line for line in warnings(FINE.replace("COUNT", str(count)) + text, tmp_path) if "pinned nodes hold" in line
    ]
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


BLOCK = """
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.8]
"""
WATER = """
[[fluid]]
name = "water"
particle_radius = 0.01
"""
JET = (
    WATER
    + """[[fluid.emitter]]
shape = { type = "disc", radius = 0.05 }
position = [0.0, 0.0, 0.9]
direction = [0.0, 0.0, -1.0]
speed = 1.0
"""
)


@pytest.mark.parametrize(
    ("water", "said"),
    [
        # 7.9 kg in a second are 52 times the sheet: 32²/2 nodes g dt² / 3.2 cm is 0.11, and 53 times that 5.9.
        (JET, "2 pinned nodes hold 1024 and fluid of 5"),
        (JET.replace("0.9]", "0.4]"), None),
        (JET.replace("[0.0, 0.0, 0.9]", "[0.8, 0.0, 0.9]"), None),
        # Thrown aside: 0.35 s down to the sheet, with 3 m/s.
        (JET.replace("[0.0, 0.0, -1.0]", "[1.0, 0.0, 0.0]").replace("speed = 1.0", "speed = 3.0"), None),
        (JET.replace("particle_radius", "max_particles = 100\nparticle_radius"), None),
        (WATER + BLOCK, "and fluid of 53 times their mass"),
        (WATER + BLOCK.replace("0.8]", "0.2]"), None),
        (WATER + BLOCK.replace("[0.0, 0.0", "[0.9, 0.0"), None),
    ],
    ids=["jet", "jet below", "jet beside", "jet thrown aside", "few particles", "block", "block below", "block beside"],
)
def test_water_over_cloth_weighs_on_its_pins(water, said, tmp_path):
    text = FINE.replace("COUNT", "32") + CORNERS + water
    found = [line for line in warnings(text, tmp_path) if "pinned nodes hold" in line]
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


def test_loose_cloth_that_weighs_what_it_displaces_is_told_to_go_with_the_water(tmp_path):
    def told(**keys: float) -> list[str]:
        lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
        text = FINE.replace("COUNT", "9") + lines + JET.replace('"water"', '"water"\nsolver = "dfsph"')
        return [line for line in warnings(text, tmp_path) if "mass_per_area" in line]

    # Cotton of 0.15 kg/m² displaces 0.5 kg/m²; 1.2 kg/m² is what particles of 2 cm tell apart.
    (warning,) = told()
    assert '0.15 kg/m², and the "water" that its thickness displaces 0.5 kg/m²: ' in warning
    assert "they must differ by 1.2 kg/m² for it to sink or float" in warning
    assert told(mass_per_area=1.75) == told(thickness=1.4e-3) == []
    pinned = FINE.replace("COUNT", "9") + EDGE + JET
    assert not [line for line in warnings(pinned, tmp_path) if "displaces" in line]
