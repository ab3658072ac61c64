"""Knobs and the page that has them, without a browser: whatever a job has is a place where its knobs can start."""

import pytest
from live_jobs import BALL_OVER_SHEET, loaded, page_of

from pipeline.base.errors import PipelineError
from pipeline.job.loading import load_job
from pipeline.web.drawing.colors import BODY, CLOTH, PIN, srgb
from pipeline.web.live.admission import live_job, require_small
from pipeline.web.live.parameters import parameters_of
from pipeline.web.live.saving import save_job
from pipeline.web.live.scene import LiveScene
from pipeline.web.live.session import Session
from pipeline.web.serving import page_server

ODD = (
    "stretch_stiffness = 3e5",
    "bend_stiffness = 2e-9",
    "bend_stiffness = 0.0",
    "friction = 3.0",
    "damping = 0.7",
    "wind = [0.0, -55.0, 1.0]",
    "mass_per_area = 1e-3",
)


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("substeps", [1, 5, 100])
def test_a_knob_may_stay_where_the_job_has_it(tmp_path, odd: str, substeps: int):
    text = BALL_OVER_SHEET.replace("stretch_stiffness = 500.0   # soft", odd)
    for knob in parameters_of(live_job(loaded(tmp_path, text).job, substeps=substeps)):
        assert knob.checked(knob.start) == knob.start


@pytest.mark.parametrize("asked", [1, 80])
def test_what_the_job_asks_for_can_be_had_again_after_live_has_cut_it(tmp_path, asked: int):
    written = loaded(tmp_path, BALL_OVER_SHEET.replace("substeps = 8", f"substeps = {asked}")).job
    job = live_job(written, substeps=6)
    (knob,) = (knob for knob in parameters_of(job, written=written) if knob.name == "cloth.substeps")
    assert (knob.start, knob.checked(asked), knob.checked(2), knob.checked(60)) == (6, asked, 2, 60)


BODIES = BALL_OVER_SHEET[: BALL_OVER_SHEET.index("[[cloth]]")]
WATER = """
name = "drape"
[domain]
min = [-0.1, -0.1, 0.0]
max = [0.1, 0.1, 0.2]
[[fluid]]
name = "water"
solver = "dfsph"
particle_radius = 0.01
[[fluid.block]]
shape = { type = "box", size = [0.1, 0.1, 0.1] }
position = [0.0, 0.0, 0.05]
"""

POOL = """
name = "pool"
[domain]
min = [0.0, 0.0, 0.0]
max = [0.4, 0.2, 0.4]
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.16, 0.16, 0.2] }
position = [0.1, 0.1, 0.12]
"""


@pytest.mark.usefixtures("taichi")
def test_bodies_alone_have_their_surfaces_as_knobs_and_a_saved_job_has_them(tmp_path):
    read = loaded(tmp_path, BODIES)
    session = Session(live_job(read.job))
    surfaces = {f"rigid.{name}.{key}": 0.75 for name in ("ball", "post") for key in ("friction", "restitution")}
    assert set(session.parameters) == {"gravity", "rigid.ball.density", *surfaces}
    for name, value in surfaces.items():
        session.set(name, value)
    with pytest.raises(ValueError, match="between 0 and 1"):
        session.set("rigid.ball.restitution", 1.5)
    session.reset()
    assert session.world.solvers["rigid"].surfaces.friction.tolist() == [0.75, 0.75]
    session.advance()
    saved = load_job(save_job(read, session.values, tmp_path)[0])
    assert [(body.friction, body.restitution) for body in saved.rigid] == [(0.75, 0.75)] * 2
    assert saved.rigid[1].kind == "static"


@pytest.mark.usefixtures("taichi")
def test_cloth_feels_how_rough_a_body_has_been_made_also_one_that_rests(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET.replace('kind = "dynamic"\ndensity = 500.0\n', ""))
    session = Session(live_job(read.job))
    assert "rigid.post.restitution" not in session.parameters  # nothing rebounds
    session.set("rigid.post.friction", 1.5)
    (coupling,) = session.world._couplings
    assert coupling._contacts.rigid.colliding.friction.to_numpy().tolist() == [0.5, 1.5]
    saved = load_job(save_job(read, session.values, tmp_path)[0])
    assert [body.friction for body in saved.rigid] == [0.5, 1.5]


@pytest.mark.usefixtures("taichi")
def test_a_fluid_alone_has_viscosity_and_steps_and_a_saved_job_has_them(tmp_path):
    read = loaded(tmp_path, WATER)
    session = Session(live_job(read.job))
    assert set(session.parameters) == {"fluid.water.viscosity", "fluid.cfl"}
    session.set("fluid.water.viscosity", 1.0e-4)
    session.set("fluid.cfl", 0.5)
    with pytest.raises(ValueError, match="viscosity would be implicit, which is decided at the start"):
        session.set("fluid.water.viscosity", 1.0)
    session.advance()
    session.reset()
    assert session.message == ""
    assert session.values == {"fluid.water.viscosity": 1.0e-4, "fluid.cfl": 0.5}
    tank = session.world.solvers["water"]
    assert (tank.phases.viscosities.tolist(), tank.parameters.cfl) == ([1.0e-4], 0.5)
    saved = load_job(save_job(read, session.values, tmp_path)[0])
    assert (saved.fluid[0].viscosity, saved.fluid[0].cfl) == (1.0e-4, 0.5)
    fixed = loaded(tmp_path, WATER.replace("particle_radius", "dt = 1e-3\nparticle_radius")).job
    assert [knob.name for knob in parameters_of(fixed)] == ["fluid.water.viscosity"]


SOFT = """\
name = "heaps"
[domain]
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.5]
[[soft]]
name = "jelly"
material = "jelly"
cell_size = 0.04
[[soft.block]]
shape = { type = "box", size = [0.16, 0.16, 0.16] }
position = [-0.15, 0.0, 0.09]
[[soft]]
name = "sand"
material = "sand"
young_modulus = 5e4
cell_size = 0.04
[[soft.block]]
shape = { type = "box", size = [0.16, 0.16, 0.16] }
position = [0.15, 0.0, 0.09]
"""


@pytest.mark.usefixtures("taichi")
def test_soft_matter_alone_has_what_it_is_made_of_and_gravity_and_a_saved_job_has_them(tmp_path):
    read = loaded(tmp_path, SOFT)
    session = Session(live_job(read.job))
    knobs = {
        "soft.jelly.young_modulus",
        "soft.sand.young_modulus",
        "soft.sand.friction_angle_deg",
        "soft.sand.cohesion",
    }
    assert set(session.parameters) == {"gravity", *knobs}
    assert session.values["soft.jelly.young_modulus"] == 1.0e4  # the material's
    heights = []
    for stiffness in (1.0e4, 2.0e3):
        session.reset()
        session.set("soft.jelly.young_modulus", stiffness)
        heights.append([])
        for _ in range(10):
            session.advance()
            heights[-1].append(session.bodies()["jelly"].arrays["position"][:, 2].mean())
    assert min(heights[1]) < min(heights[0]) - 0.005  # softer, it sags deeper
    with page_server() as server:
        page_of(server, read, session, tmp_path).show()
        jelly = session.bodies()["jelly"].arrays["position"]
        assert server.scene.get_handle_by_name("/soft/jelly").points.shape == jelly.shape
    session.set("gravity", (0.0, 0.0, 9.81))
    for _ in range(12):
        session.advance()
    assert session.bodies()["sand"].arrays["position"][:, 2].mean() > 0.12
    assert session.message == ""
    saved = load_job(save_job(read, session.values, tmp_path)[0])
    assert (saved.soft[0].young_modulus, saved.gravity) == (2.0e3, (0.0, 0.0, 9.81))
    with pytest.raises(ValueError, match="density of soft matter cannot change"):
        session.world.solvers["soft"].change("jelly", density=2.0)


def test_soft_matter_that_is_too_large_to_steer_is_told_what_fits(tmp_path):
    with pytest.raises(PipelineError, match=r"about 500,000 particles of soft matter at \d+ steps .* of them fit"):
        require_small(live_job(loaded(tmp_path, SOFT).job), 0, 500_000, cores=2, on_gpu=False)


@pytest.mark.usefixtures("taichi")
def test_a_small_fluid_runs_and_is_drawn(tmp_path):
    read = loaded(tmp_path, POOL)
    session = Session(live_job(read.job))
    with page_server() as server:
        page = page_of(server, read, session, tmp_path)
        for _ in range(20):
            session.advance()
        page.show()
        page.tell()
        assert "substeps: water" in page._state.content
        water = session.bodies()["water"].arrays["position"]
        assert server.scene.get_handle_by_name("/fluid/water").points.shape == water.shape
    assert water[:, 0].max() > 0.2  # it has run out over the floor


@pytest.mark.usefixtures("taichi")
def test_a_page_has_odd_values_and_tells_what_happens_while_time_stands_still(tmp_path):
    odd = "stretch_stiffness = 3e5\nbend_stiffness = 2e-9\nfriction = 3.0"
    read = loaded(tmp_path, BALL_OVER_SHEET.replace("stretch_stiffness = 500.0   # soft", odd))
    session = Session(live_job(read.job, substeps=1))
    session.is_paused = True
    with page_server(port=0, label="drape") as server:
        page = page_of(server, read, session, tmp_path)
        session.advance()
        page.tell()
        assert "substeps: cloth 9 (1 asked for), rigid 9" in page._state.content  # as many as the ball asks for
        session.message = "something new"
        page.tell()
        assert "something new" in page._notice.content
        session.message = ""
        page.tell()
        assert page._notice.content == ""
        assert tuple(server.initial_camera.up) == (0.0, 0.0, 1.0)


@pytest.mark.usefixtures("taichi")
def test_a_scene_has_the_colours_of_the_viewer(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET + '\n[material.post]\nlook = "metal"\ncolor = [0.5, 0.1, 0.0]\n')
    session = Session(live_job(read.job))
    with page_server(port=0, label="drape") as server:
        drawn = LiveScene(server, session.job, read.job.placed_camera, lambda *_: None)
        drawn.show(session.bodies(), session.drags.pins)
        nodes = server.scene._handle_from_node_name
        expected = {
            "/rigid/ball/body": BODY,
            "/cloth/sheet": CLOTH,
            "/pin/0": PIN,
            "/rigid/post/body": srgb((0.5, 0.1, 0)),
        }
        assert {name: tuple(nodes[name].color) for name in expected} == expected


@pytest.mark.usefixtures("taichi")
def test_the_ball_of_a_pin_goes_when_the_pin_lets_go(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET.replace('edge = "y-"', 'edge = "y-"\nrelease_s = 0.02'))
    session = Session(live_job(read.job))
    with page_server(port=0, label="drape") as server:
        drawn = LiveScene(server, session.job, read.job.placed_camera, lambda *_: None)
        balls = []
        for _ in range(3):
            drawn.show(session.bodies(), session.drags.pins)
            balls.append([name for name in server.scene._handle_from_node_name if name.startswith("/pin/")])
            session.advance()
        assert balls == [["/pin/0", "/pin/1"], ["/pin/0", "/pin/1"], ["/pin/1"]]


@pytest.mark.usefixtures("taichi")
def test_the_page_begins_with_the_camera_of_the_film_that_looks_at_a_body_at_rest(tmp_path):
    camera = '\n[camera]\nposition = [0.0, -1.2, 1.3]\nlook_at = "post"\n'
    read = loaded(tmp_path, BALL_OVER_SHEET + camera)
    session = Session(live_job(read.job))
    with page_server(port=0, label="drape") as server:
        page_of(server, read, session, tmp_path)
        view = server.initial_camera
        assert (tuple(view.position), tuple(view.look_at)) == ((0.0, -1.2, 1.3), (0.4, 0.0, 0.05))
