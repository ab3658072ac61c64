"""Cloths of a job: what is told before any work starts."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from checked_jobs import PLUME, checked, says
from cloth_jobs import BALL, SHEET, errors, warnings

from pipeline.base.errors import JobFileError
from pipeline.kinds.checks.cloth import MANY_SUBSTEPS
from pipeline.kinds.checks.cloth_start import BYTES_PER_NODE
from sim.core.world import MAX_SUBSTEPS_PER_FRAME

SECOND = """
[[cloth]]
name = "second"
shape = { type = "rectangle", size = [0.3, 0.3], counts = [7, 7] }
position = [0.03, 0.0, 0.5]
"""


def test_a_cloth_over_a_ball_is_fine_and_its_nodes_are_counted(tmp_path):
    findings = checked(SHEET + BALL, tmp_path / "drape.toml").findings
    assert (findings.errors, findings.warnings) == ([], [])
    assert findings.elements["cloth"] == 81


KEYFRAMES = "keyframe = [{ time_s = 0.0 }, { time_s = 1.0, offset = [0.1, 0.0, 0.0] }]"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (SHEET.replace("0.5]", "9.5]"), "4 cloth[0]: is wholly outside ... z 9.5..9.5 m, not ... z 0..1 m"),
        (
            SHEET.replace('"x-", ', "").replace("[0.0,", "[-0.4,"),
            "4 cloth[0]: passes through the wall x-, as at (-0.6, -0.2, 0.5) m ... domain.open_faces",
        ),
        (SHEET + BALL.replace("0.3]", "0.45]"), '4 cloth[0]: starts inside "ball", as at (-0.05, -0.05, 0.5) m'),
        (
            # Smaller than a cell of the sheet: no node is inside, but the middle of a triangle is.
            SHEET + BALL.replace("radius = 0.1", "radius = 0.01").replace("0.0, 0.0, 0.3]", "0.0335, 0.0165, 0.5]"),
            '4 cloth[0]: starts inside "ball", as at (0.03333, 0.01667, 0.5) m',
        ),
        (
            # Thinner still, and beside the middle: a needle.
            SHEET + BALL.replace("radius = 0.1", "radius = 0.004").replace("0.0, 0.0, 0.3]", "0.04, 0.005, 0.5]"),
            '4 cloth[0]: starts inside "ball", as at (0.04',
        ),
        (
            SHEET.replace("[9, 9]", "[21, 21]") + "thickness = 0.6",
            "8 cloth[0].thickness: 0.6 m is so much more than the 0.019 m ... that 440 of ... 300 at most; make it",
        ),
        (
            SHEET.replace("[domain]", "[domain]\nmax = [1e5, 1e5, 1e5]"),
            "5 cloth[0]: its positions are rounded to 0.002 m, and its layers keep 0.0005 m; make the domain smaller",
        ),
        (
            SHEET + SECOND + "rotation_deg = [0.0, 90.0, 0.0]",
            '9 cloth[1]: passes through or touches cloth "sheet" at (0.03, -0.15, 0.5) m ... 0.0005 m or more apart',
        ),
        (
            # Nothing passes through anything, and contacts would not know which of the two is above.
            SHEET + SECOND + "rotation_deg = [0.0, 0.0, 27.0]\nthickness = 2e-3",
            '9 cloth[1]: passes through or touches cloth "sheet" at (0.008998, -0.1791, 0.5) m ... 0.002 m or more',
        ),
        (SHEET + "[[cloth.pin]]\nindex = [3, 81]", "8 cloth[0].pin[0]: index 81 does not exist ... 0 to 80"),
        (
            SHEET + '[[cloth.pin]]\nregion = { type = "sphere", position = [0.0, 0.0, 0.9], radius = 0.1 }',
            "8 cloth[0].pin[0]: no node starts in its region ... x -0.2..0.2 y -0.2..0.2 z 0.5..0.5 m",
        ),
        (
            SHEET + '[[cloth.pin]]\nedge = "x-"\n[[cloth.pin]]\ncorner = "x-y-"\n' + KEYFRAMES,
            "10 cloth[0].pin[1]: shares a node with pin[0], and one of them moves",
        ),
        (
            SHEET + SECOND.replace("0.5]", "0.7]") + 'integrator = "explicit"',
            '13 cloth[1].integrator: is "explicit", but "xpbd" in cloth[0]',
        ),
        (
            SHEET.replace('"rectangle", size = [0.4, 0.4], counts = [9, 9]', '"mesh", file = "shawl.ply"'),
            "6 cloth[0].shape.file: no such file: FOLDER/shawl.ply",
        ),
        (SHEET + '[material.sheet]\nlook = "smoke"', '9 material.sheet.look: "smoke" is a look for [[smoke]]'),
        (SHEET + BALL + '[material.ball]\nlook = "denim"', '14 material.ball.look: "denim" is a look for [[cloth]]'),
        (
            SHEET + '[[smoke]]\nname = "cloth"\n[[smoke.source]]\nshape = { type = "sphere", radius = 0.2 }',
            '9 smoke[0].name: "cloth" is what the solver of all [[cloth]] is called',
        ),
        (SHEET + BALL.replace('"ball"', '"sheet"'), '5 cloth[0].name: "sheet" is taken by rigid[0]'),
    ],
)
def test_what_cannot_start_is_refused_with_its_place(text, expected, tmp_path):
    found = errors(text, tmp_path)
    assert any(says(error, f"drape.toml:{expected.replace('FOLDER', str(tmp_path))}") for error in found), found


def test_more_nodes_than_memory_holds_are_refused_with_the_number_that_fits(tmp_path):
    text = SHEET.replace("[9, 9]", "[2000, 2000]")
    (problem,) = errors(text, tmp_path, memory_bytes=10**9)
    assert says(problem, "drape.toml:6 cloth[0].shape.counts: 4 million nodes need ... has 1 GB; at most ... fit")


def test_cloths_that_fit_one_by_one_but_not_together_are_refused(tmp_path):
    text = SHEET + SECOND.replace("0.5]", "0.7]")
    assert errors(text, tmp_path, memory_bytes=BYTES_PER_NODE * (81 + 49)) == []
    (problem,) = errors(text, tmp_path, memory_bytes=BYTES_PER_NODE * (81 + 49) - 1)
    assert says(problem, "drape.toml:11 cloth[1].shape.counts: 49 nodes and 81 of ... 0.00078 GB ... at most 48 fit")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (SHEET + "thickness = 0.06", "8 cloth[0].thickness: 0.06 m is more than the 0.05 m"),
        (SHEET + "wind = [1.0, 0.0, 0.0]\n" + PLUME, '8 cloth[0].wind: does not blow in the box of smoke "plume"'),
        (
            SHEET + '[material.sheet]\nlook = "plastic"\nthread_spacing = 0.001',
            '10 material.sheet.thread_spacing: has no effect on the look "plastic"',
        ),
    ],
)
def test_what_is_worth_a_look_is_said(text, expected, tmp_path):
    assert any(line.startswith(f"drape.toml:{expected}") for line in warnings(text, tmp_path))


def test_cloth_beside_smokes_whose_boxes_overlap_is_refused(tmp_path):
    other = PLUME.replace("plume", "fog").replace("cell_size", "max = [0.5, 0.5, 0.4]\ncell_size")
    apart = other.replace("max = [0.5, 0.5, 0.4]", "min = [0.5, -0.5, 0.0]\nmax = [1.5, 0.5, 1.0]").replace(
        "[0.0,", "[0.8,"
    )
    with pytest.raises(JobFileError, match=r'smoke\[1\]: its box and that of "plume" overlap'):
        warnings(SHEET + PLUME + other, tmp_path)
    assert warnings(SHEET + PLUME + apart, tmp_path) == []


def test_cloths_of_two_airs_beside_smoke_are_refused(tmp_path):
    other = SHEET[SHEET.index("[[cloth]]") :].replace('"sheet"', '"other"')
    thin, none = "air_density = 0.6\n", "air_density = 0.0\n"
    apart = other.replace("0.5]", "0.9]")
    with pytest.raises(JobFileError, match=r'is 0\.6 kg/m³ for "other", but 1\.2 kg/m³ for "sheet"'):
        warnings(SHEET + apart + thin + PLUME, tmp_path)
    assert warnings(SHEET + apart + none + PLUME, tmp_path) == []
    assert warnings(SHEET + apart + thin, tmp_path) == []


def test_cloth_laid_onto_a_box_and_an_edge_pinned_inside_a_pole_are_fine(tmp_path):
    table = BALL.replace('"sphere", radius = 0.1', '"box", size = [0.3, 0.3, 0.2]').replace("0.3]\n", "0.4]\n")
    assert errors(SHEET + table, tmp_path) == []
    pole = BALL.replace('"sphere", radius = 0.1', '"box", size = [0.02, 0.5, 0.5]').replace("[0.0,", "[-0.2,")
    assert len(errors(SHEET + pole.replace("0.3]\n", "0.5]\n"), tmp_path)) == 1
    assert errors(SHEET + '[[cloth.pin]]\nedge = "x-"\n' + pole.replace("0.3]\n", "0.5]\n"), tmp_path) == []


def mesh_job(vertices, faces, folder: Path, suffix: str = "") -> str:
    mesh = trimesh.Trimesh(np.asarray(vertices, dtype=float), np.asarray(faces), process=False)
    mesh.export(folder / "shawl.ply")
    shape = SHEET.replace('"rectangle", size = [0.4, 0.4], counts = [9, 9]', '"mesh", file = "shawl.ply"')
    return shape + suffix


SQUARE = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.2, 0.0], [0.0, 0.2, 0.0]]


def test_a_mesh_of_more_nodes_than_memory_holds_is_refused(tmp_path):
    text = mesh_job(SQUARE, [[0, 1, 2], [0, 2, 3]], tmp_path)
    assert errors(text, tmp_path, memory_bytes=BYTES_PER_NODE * 4) == []
    (problem,) = errors(text, tmp_path, memory_bytes=BYTES_PER_NODE * 3)
    assert says(problem, "drape.toml:6 cloth[0].shape.file: 4 nodes need 2.4e-05 GB ... 1.8e-05 GB; at most 3 fit")


def test_a_mesh_that_passes_through_itself_is_refused_unless_it_need_not_collide_with_itself(tmp_path):
    spike = [[0.05, 0.1, -0.1], [0.15, 0.1, -0.1], [0.1, 0.1, 0.1]]
    text = mesh_job([*SQUARE, *spike], [[0, 1, 2], [0, 2, 3], [4, 5, 6]], tmp_path)
    (problem,) = errors(text, tmp_path)
    assert says(problem, "drape.toml:6 cloth[0].shape: passes through or touches itself at (0, 0, 0.5) m")
    assert errors(text + "self_collision = false", tmp_path) == []


def test_too_few_substeps_for_explicit_springs_are_refused_with_a_number_that_is_accepted(tmp_path):
    def problems(substeps: int) -> list[str]:
        return errors(f'{SHEET}integrator = "explicit"\nsubsteps = {substeps}', tmp_path)

    (problem,) = problems(2)
    place = r"drape\.toml:9 cloth\[0\]\.substeps: 2 substeps a frame are "
    least = int(re.search(place + r".* give substeps = (\d+) or more", problem)[1])
    assert problems(least) == []
    assert len(problems(least - 1)) == 1


def test_explicit_springs_may_ask_for_too_few_substeps_beside_others_that_take_enough(tmp_path):
    """As cloths step together, as often as the one that takes most; it omits them or gives them."""
    sheet = f'{SHEET}integrator = "explicit"\nsubsteps = 2\n'
    other = SECOND.replace("0.5]", "0.7]") + 'integrator = "explicit"\n'
    assert errors(f"{sheet}{other}", tmp_path) == errors(f"{sheet}{other}substeps = 4000", tmp_path) == []
    found = errors(f"{sheet}{other}substeps = 3", tmp_path)
    assert [re.sub(r".*(cloth.*: \d+ substeps a frame) are.*", r"\1", problem) for problem in found] == [
        "cloth[0].substeps: 3 substeps a frame",
        "cloth[1].substeps: 3 substeps a frame",
    ]


def test_explicit_springs_without_substeps_are_told_how_many_they_take(tmp_path):
    def told(found, stiffness: float) -> list[str]:
        keys = f'integrator = "explicit"\nmass_per_area = 0.01\nstretch_stiffness = {stiffness:g}\n'
        lines = found(SHEET + keys, tmp_path)
        return [line for line in lines if "substeps a frame" in line]

    assert told(warnings, 1.0e3) == told(errors, 1.0e7) == []
    (slow,) = told(warnings, 1.0e7)
    taken = int(re.search(r'cloth\[0\]\.integrator: "explicit" takes (\d+) substeps a frame', slow)[1])
    assert taken > MANY_SUBSTEPS
    # They grow with the root of the stiffness.
    (endless,) = told(errors, 1.0e7 * (1.01 * MAX_SUBSTEPS_PER_FRAME / taken) ** 2)
    assert "more than the 200000 at which a run ends: give a softer stretch_stiffness or a coarser sheet" in endless


def test_explicit_springs_need_the_substeps_of_nodes_that_are_let_go_from_the_start(tmp_path):
    """Nodes that are held bear steps of any length."""

    def problems(release: str) -> list[str]:
        pin = f"[[cloth.pin]]\nindex = {list(range(81))}\n{release}"
        return errors(f'{SHEET}integrator = "explicit"\nsubsteps = 20\n{pin}', tmp_path)

    assert problems("") == []
    (problem,) = problems("release_s = 0.5")
    assert re.search(r"cloth\[0\]\.substeps: 20 substeps a frame are .* give substeps = \d+ or more", problem)


def test_bodies_that_fit_between_the_nodes_are_told(tmp_path):
    small = BALL.replace("radius = 0.1", "radius = 0.06")
    (warning,) = warnings(SHEET + small, tmp_path)
    assert warning.startswith(
        'drape.toml:6 cloth[0].shape: "ball" is 0.12 m across, less than two of the longest edges, 0.0707 m each'
    )


def test_of_a_group_that_fits_between_the_nodes_the_thinnest_body_is_told(tmp_path):
    """Ninety leaves made ninety warnings."""
    small = (
        BALL.replace("radius = 0.1", "radius = 0.06") + "count = 5\nspacing = [0.13, 0.13, 0.13]\nscales = [0.5, 1.0]\n"
    )
    (warning,) = [each for each in warnings(SHEET + small, tmp_path) if "longest edges" in each]
    assert "and 4 more of its group are thin" in warning


ROD = """
[[rigid]]
name = "rod"
shape = { type = "cylinder", radius = 0.02, height = 0.5 }
position = [-0.2, 0.0, 0.475]
rotation_deg = [90.0, 0.0, 0.0]
"""


def test_a_rod_that_cloth_is_pinned_along_may_be_thinner_than_two_of_its_edges(tmp_path):
    def told(*tables: str) -> list[str]:
        return [line for line in warnings("".join((SHEET, *tables)), tmp_path) if '"rod" is 0.04 m across' in line]

    pin = '[[cloth.pin]]\nedge = "x-"\n'
    assert told(pin, ROD) == []
    assert told(pin + "release_s = 1.0\n", ROD) == []
    # Without pins it falls onto the rod, held by a corner it may come to it, and so may a sheet held elsewhere.
    assert len(told(ROD)) == len(told(pin.replace('edge = "x-"', 'corner = "x-y-"'), ROD)) == 1
    assert len(told(pin.replace("x-", "x+"), ROD)) == 1
    # Another sheet may come to it too.
    (of_the_other,) = told(pin, SECOND.replace("0.5]", "0.51]"), ROD)
    assert "cloth[1].shape" in of_the_other


LEAVES = "keyframe = [{ time_s = 0.0 }, { time_s = 0.5, offset = [-0.1, 0.0, 0.0] }]\n"
GOES_ALONG = """kind = "kinematic"
keyframe = [
    { time_s = 0.0, position = [-0.2, 0.0, 0.475], rotation_deg = [90.0, 0.0, 0.0] },
    { time_s = 0.5, position = [-0.3, 0.0, 0.475], rotation_deg = [90.0, 0.0, 0.0] },
]
"""


@pytest.mark.parametrize(
    ("pin", "body", "is_told"),
    [
        ('edge = "x-"\n' + LEAVES, ROD + GOES_ALONG, False),
        ('edge = "x-"\n' + LEAVES, ROD, True),
        ('edge = "x-"\nrelease_s = 0.001\n' + LEAVES.replace("0.0 }", "0.0005 }", 1), ROD, False),
        ('edge = "x-"\n', ROD + GOES_ALONG, True),
        ('edge = "x-"\n', ROD + 'kind = "kinematic"\nvelocity = [0.5, 0.0, 0.0]\n', True),
        ('edge = "x-"\n', ROD + 'kind = "kinematic"\n', False),
        ('edge = "x-"\n', ROD + 'kind = "dynamic"\ndensity = 600.0\n', True),
        ("index = [36, 27]\n", ROD, True),  # two nodes in the middle of the edge
        ("index = [0, 72]\n", ROD, True),  # its two ends
        (
            'edge = "x-"\n',
            ROD.replace('"cylinder", radius = 0.02, height = 0.5', '"box", size = [0.5, 0.5, 0.04]')
            .replace("-0.2, 0.0, 0.475", "0.0, 0.0, 0.475")
            .replace("[90.0, 0.0", "[0.0, 0.0"),
            True,
        ),
    ],
    ids=[
        "both move alike",
        "the pin leaves",
        "it lets go before",
        "the rod leaves",
        "it sweeps",
        "it rests",
        "it falls",
        "two neighbours",
        "two ends",
        "a plate",
    ],
)
def test_only_a_rod_that_stays_along_a_pin_may_be_thin(pin, body, is_told, tmp_path):
    told = [line for line in warnings(f"{SHEET}[[cloth.pin]]\n{pin}{body}", tmp_path) if "may show or pass" in line]
    assert len(told) == is_told


@pytest.mark.parametrize(("wall", "is_told"), [(0.001, True), (0.004, False)])
def test_shells_with_thinner_walls_than_cloth_can_feel_are_told(wall, is_told, tmp_path):
    shell = trimesh.creation.icosphere(3, 0.2)
    inner = trimesh.creation.icosphere(3, 0.2 - wall)
    inner.invert()
    trimesh.util.concatenate([shell, inner]).export(tmp_path / "shell.ply")
    body = BALL.replace('"sphere", radius = 0.1', '"mesh", file = "shell.ply"').replace("0.3]", "0.25]")
    told = [line for line in warnings(SHEET + body, tmp_path) if "m or thinner; the finest grid that" in line]
    assert len(told) == is_told


@pytest.mark.parametrize("met_by", [SHEET, 'name = "air"' + PLUME], ids=["cloth", "smoke"])
@pytest.mark.parametrize(("wall", "pieces", "is_told"), [(0.001, 3, True), (0.002, 16, False)])
def test_a_vase_that_breaks_is_told_once_where_the_grids_of_its_pieces_miss_its_walls(
    met_by, wall, pieces, is_told, tmp_path
):
    """A grid of the whole misses both walls, by cells of 1.6 mm; pieces are smaller, and have finer ones."""
    profile = [[0, 0], [0.2, 0], [0.2, 0.4], [0.2 - wall, 0.4], [0.2 - wall, wall], [0, wall]]
    vase = '[[rigid]]\nname = "vase"\nkind = "dynamic"\ndensity = 2500.0\nposition = [0, 0, 0.22]\n'
    vase += f'shape = {{ type = "revolved", profile = {profile} }}\nbreaks = {{ strength = 1e7, pieces = {pieces} }}\n'
    told = [
        line
        for line in checked(met_by + vase, tmp_path / "vase.toml").warnings
        if "m or thinner; the finest grid that" in line
    ]
    assert len(told) == is_told
