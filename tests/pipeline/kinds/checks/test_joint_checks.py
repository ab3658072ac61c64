"""Joints that cannot be are refused with the job, each at its line."""

from checked_jobs import checked

BODIES = """name = "a"
frames = 2
device = "cpu"

[[rigid]]
name = "post"
shape = { type = "box", size = [0.1, 0.1, 0.4] }
position = [0.0, 0.0, 0.2]

[[rigid]]
name = "arm"
kind = "dynamic"
density = 500.0
shape = { type = "box", size = [0.3, 0.1, 0.1] }
position = [0.15, 0.0, 0.3]
"""

NAIL = """
[[joint]]
name = "nail"
kind = "fixed"
between = ["arm", "post"]
"""


def test_bodies_that_a_joint_holds_may_overlap(tmp_path):
    assert not checked(BODIES + NAIL, tmp_path / "job.toml").errors
    (line,) = checked(BODIES, tmp_path / "job.toml").errors
    assert "m deep in each other" in line
    (line,) = checked(BODIES + NAIL + "contacts = true\n", tmp_path / "job.toml").errors
    assert "m deep in each other" in line


def test_every_wrong_joint_is_told_at_its_line(tmp_path):
    text = BODIES + NAIL + NAIL.replace("post", "pole").replace("nail", "peg") + NAIL.replace('"nail"', '"bolt"')
    errors = checked(text, tmp_path / "job.toml").errors
    assert errors == [
        'job.toml:25 joint[1].between: names no rigid body with "pole"; rigid bodies are post, arm',
        'job.toml:30 joint[2].between: are held by joint "nail" already, and two that hold the same bodies fight; '
        "remove one, or use ball joints alone",
    ]


def test_a_joint_of_a_body_that_breaks_is_told_so_by_whatever_name(tmp_path):
    group = BODIES + "count = 2\nspacing = [0.0, 0.2, 0.0]\nbreaks = { strength = 1e6, pieces = 3 }\n"
    for name, what in (("arm", "a body"), ("arm_1", "a body"), ("arm_1_2", "a piece of a body")):
        (line,) = [
            each for each in checked(group + NAIL.replace("arm", name), tmp_path / "job.toml").errors if "joint" in each
        ]
        assert line.endswith(
            f'between: holds "{name}", {what} that breaks, which no joint can; remove the joint or breaks'
        )
    told = checked(group + NAIL.replace("arm", "arn"), tmp_path / "job.toml").errors
    assert any(line.endswith('names no rigid body with "arn"; rigid bodies are post') for line in told)


def test_a_joint_far_from_its_body_is_told(tmp_path):
    far = NAIL.replace('"fixed"', '"ball"') + "anchor = [20.0, 0.0, 0.3]\n"
    lines = [line for line in checked(BODIES + far, tmp_path / "job.toml").warnings if "joint" in line]
    assert [line.split("; ")[0] for line in lines] == [
        'job.toml:17 joint[0]: is 19.7 m away from "arm", as if an arm without mass held it',
        'job.toml:17 joint[0]: is 19.9 m away from "post", as if an arm without mass held it',
    ]


BANNER = """
[[cloth]]
name = "banner"
shape = { type = "rectangle", size = [0.4, 0.4], resolution = 0.05 }
position = [0.15, 0.0, 0.6]

[[cloth.pin]]
edge = "x-"

[[joint]]
name = "hook"
kind = "ball"
between = ["arm", "banner"]
anchor = [0.15, 0.0, HEIGHT]
"""


def test_a_joint_off_its_cloth_is_told_at_its_line(tmp_path):
    def told(height):
        return checked(BODIES + NAIL + BANNER.replace("HEIGHT", height), tmp_path / "job.toml")

    assert not told("0.6").errors
    assert told("0.8").errors == [
        'job.toml:34 joint[1].anchor: is 0.2 m off the cloth "banner", whose nodes are at most 0.0707 m apart; move it '
        "to the nearest one, at [0.15, 0, 0.6], or another"
    ]


def test_a_body_that_is_joined_to_cloth_may_be_in_it(tmp_path):
    inside = (BODIES + NAIL + BANNER).replace("[0.15, 0.0, 0.6]", "[0.15, 0.0, 0.33]").replace("HEIGHT", "0.33")
    assert not [line for line in checked(inside, tmp_path / "job.toml").errors if '"arm"' in line]
    errors = checked(inside + "contacts = true\n", tmp_path / "job.toml").errors
    assert any('starts inside "arm"' in line for line in errors)


def test_joints_of_a_job_without_bodies_are_refused(tmp_path):
    text = 'name = "a"\nframes = 2\n' + NAIL
    errors = checked(text, tmp_path / "job.toml").errors
    assert any('names no rigid body with "arm"; add [[rigid]]' in line for line in errors)


def test_a_joint_that_would_turn_a_point_of_cloth_is_refused_by_name(tmp_path):
    sheet = '[[cloth]]\nname = "sheet"\nshape = { type = "rectangle", size = [0.1, 0.1], counts = [3, 3] }\n'
    sheet += "position = [0.0, 0.0, 0.9]\n"
    errors = checked(BODIES + NAIL.replace("post", "sheet") + sheet, tmp_path / "job.toml").errors
    assert any('is a fixed at the cloth "sheet", a point of which has no directions; use a ball' in e for e in errors)
