"""A scene that is played with, without a page: knobs and hands change what happens, and a blow-up is no end."""

import threading
import weakref
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from live_jobs import BALL_OVER_SHEET, loaded, session_of

import sim.build
from pipeline.model.job import Job
from pipeline.run.executors.failures import describe
from pipeline.web.live.admission import live_job
from pipeline.web.live.requests import CannotGoOnError
from pipeline.web.live.session import FASTER, FIRST, Session
from pipeline.web.live.soundness import FRAMES_TO_TRUST, Checkpoint
from sim.core.world import World

pytestmark = pytest.mark.usefixtures("taichi")

WITHOUT_BALL = BALL_OVER_SHEET.replace("position = [0.0, 0.0, 0.62]", "position = [0.4, 0.4, 0.08]")


def run(session: Session, frames: int) -> None:
    for _ in range(frames):
        session.meet_requests()
        session.advance()


def blow_up(session: Session) -> None:
    session.world.solvers["rigid"].bodies.velocity[0] = (np.nan, 0.0, 0.0)
    run(session, 1)


def old_checkpoint(session: Session) -> Checkpoint:
    """The state now as if it could be trusted at frame 1."""
    return replace(Checkpoint.of(session.world, session.values), frame=1 - FRAMES_TO_TRUST)


def lowest(session: Session) -> float:
    return float(session.bodies()["sheet"].arrays["position"][:, 2].min())


def place(session: Session, name: str) -> np.ndarray:
    return np.asarray(session.bodies()[name].arrays["position"])


def test_softer_cloth_sags_deeper_and_gravity_can_be_turned_around(tmp_path):
    session = session_of(tmp_path, WITHOUT_BALL)
    session.ask(session.set, "cloth.sheet.stretch_stiffness", 20.0)
    run(session, 12)
    sagged = lowest(session)
    session.ask(session.reset)
    session.ask(session.set, "cloth.sheet.stretch_stiffness", 5000.0)
    run(session, 12)
    assert session.world.frame == 12
    assert sagged < lowest(session) - 0.005
    session.ask(session.set, "gravity", (0.0, 0.0, 20.0))
    run(session, 12)
    assert session.bodies()["sheet"].arrays["position"][:, 2].max() > 0.5005  # above its edges
    assert place(session, "ball")[2] > 0.2


def test_a_heavier_ball_presses_the_sheet_deeper(tmp_path):
    depths = []
    for density in (100.0, 2000.0):
        session = session_of(tmp_path)
        session.set("rigid.ball.density", density)
        run(session, 16)
        depths.append(lowest(session))
    assert depths[1] < depths[0] - 0.01


def test_a_ball_that_is_dragged_down_pushes_the_cloth_and_let_go_is_thrown_back(tmp_path):
    session = session_of(tmp_path)
    session.ask(session.drags.grab, "rigid", "ball", (0.0, 0.0, 0.7), 7)
    run(session, 5)
    assert place(session, "ball")[2] == pytest.approx(0.62, abs=0.005)  # in hand, it does not fall
    session.ask(session.drags.move, "rigid", "ball", (0.0, 0.0, 0.35), 7)
    run(session, 25)
    pressed = place(session, "ball")[2]
    assert pressed < 0.45  # its centre below where the sheet was
    assert lowest(session) < pressed - 0.07  # and the sheet under it, not around it
    session.ask(session.drags.release_all, 7)  # its browser is gone
    heights = []
    for _ in range(15):
        run(session, 1)
        heights.append(place(session, "ball")[2])
    assert not session.drags.held
    assert min(heights) > pressed - 0.002  # it does not sink on
    assert max(heights) > pressed + 0.03


def test_a_body_that_rests_can_be_led_and_stays_where_it_is_let_go(tmp_path):
    session = session_of(tmp_path)
    session.ask(session.drags.grab, "rigid", "post", (0.4, 0.0, 0.1))
    session.ask(session.drags.move, "rigid", "post", (0.5, 0.1, 0.2))
    run(session, 30)
    session.ask(session.drags.release, "rigid", "post")
    run(session, 5)
    np.testing.assert_allclose(place(session, "post"), [0.5, 0.1, 0.15], atol=4e-3)


def test_cloth_is_pulled_up_by_a_node_and_pins_can_be_moved(tmp_path):
    session = session_of(tmp_path, WITHOUT_BALL)
    session.ask(session.drags.grab, "cloth", "sheet", (0.0, 0.0, 0.5))
    session.ask(session.drags.move, "cloth", "sheet", (0.0, 0.0, 0.6))
    run(session, 25)
    assert session.bodies()["sheet"].arrays["position"][144, 2] == pytest.approx(0.6, abs=5e-3)
    session.ask(session.drags.release, "cloth", "sheet")
    session.ask(session.drags.grab, "cloth", "sheet", (0.0, -0.2, 0.5))  # a node of the first pin: the whole pin
    session.ask(session.drags.move, "cloth", "sheet", (0.0, -0.15, 0.55))
    run(session, 25)
    session.ask(session.drags.release, "cloth", "sheet")
    run(session, 5)
    edge = session.bodies()["sheet"].arrays["position"][:17]
    np.testing.assert_allclose(edge[:, 2], 0.55, atol=2e-3)
    np.testing.assert_allclose(edge[:, 1], -0.15, atol=2e-3)
    assert session.bodies()["sheet"].arrays["position"][144, 2] < 0.56


def test_a_blow_up_goes_back_to_what_was_sound_and_names_what_was_turned(tmp_path):
    session = session_of(tmp_path, BALL_OVER_SHEET[: BALL_OVER_SHEET.index("[[cloth]]")])
    run(session, FRAMES_TO_TRUST + 32)
    sound = place(session, "ball")
    session.set("gravity", (0.0, 0.0, -20.0))
    run(session, 2)
    session.world.solvers["rigid"].bodies.velocity[0] = (0.0, 0.0, 1e6)
    run(session, 1)
    assert session.world.frame == 30
    assert session.values["gravity"] == (0.0, 0.0, -9.81)
    assert "blew up" in session.message
    assert "Changed last: gravity = (0.0, 0.0, -20.0)" in session.message
    run(session, FRAMES_TO_TRUST + 2)  # and it goes on, as it had gone
    np.testing.assert_allclose(place(session, "ball"), sound, atol=1e-9)
    session.reset()
    # Before anything can be trusted: from the start, and it stands still.
    run(session, 10)
    session.world.solvers["rigid"].bodies.velocity[0] = (np.nan, 0.0, 0.0)
    run(session, 1)
    assert session.world.frame == 0
    assert session.is_paused
    assert "Nothing had been changed" in session.message


def test_after_a_blow_up_live_names_what_it_had_given_up_itself_and_how_to_have_it_back(tmp_path):
    written = loaded(tmp_path).job
    five = "Differs from the job: 5 substeps a frame instead of 8. The controls take that back"
    for gave_up, remedy in ((True, ", and so does --as-written."), (False, ".")):  # or --substeps 5 was asked for
        session = Session(live_job(written, substeps=5), written=written, gave_up=gave_up)
        run(session, 1)
        blow_up(session)
        assert f'"ball" is not finite. Nothing had been changed. {five}{remedy} Back at the start' in session.message
        # What was turned since is not live's; what is gone back to is.
        session.set("cloth.substeps", 4)
        blow_up(session)
        assert f"Changed last: cloth.substeps = 4. {five}{remedy} Back at the start" in session.message


@pytest.mark.parametrize("substeps", [4, 30])
def test_after_a_blow_up_live_does_not_take_for_its_own_what_was_turned_long_ago(tmp_path, substeps):
    written = loaded(tmp_path).job
    session = Session(live_job(written), written=written)
    session.set("cloth.substeps", substeps)
    run(session, 1)
    session._checkpoints.append(old_checkpoint(session))
    session._changes.clear()
    blow_up(session)
    assert session.values["cloth.substeps"] == substeps
    assert "Nothing had been changed. The job may need more substeps. Back at" in session.message


def test_substeps_are_told_beside_those_that_their_frame_was_asked_for_and_not_after_a_jump(tmp_path):
    session = session_of(tmp_path)
    run(session, 1)
    taken = session.substeps["cloth"]
    session.set("cloth.substeps", 6)
    assert (session.substeps["cloth"], session.substeps_asked) == (taken, 8)
    session.reset()
    assert session.report is None
    assert (session.substeps, session.substeps_asked) == ({}, None)
    run(session, 1)
    assert session.substeps_asked == 6
    blow_up(session)
    assert (session.substeps, session.substeps_asked) == ({}, None)


def test_cloth_with_values_that_are_no_numbers_goes_back_too(tmp_path):
    session = session_of(tmp_path)
    run(session, 1)
    session.set("cloth.sheet.bend_stiffness", 1.0e-3)
    cloth = session.world.solvers["cloth"]
    spoilt = cloth.state.velocity.to_numpy()
    spoilt[100] = np.nan
    cloth.state.velocity.from_numpy(spoilt)
    run(session, 1)
    assert "Changed last: cloth.sheet.bend_stiffness = 0.001" in session.message
    run(session, 2)
    assert np.isfinite(session.bodies()["sheet"].arrays["position"]).all()


def test_what_cannot_be_is_refused_with_a_message_and_changes_nothing(tmp_path):
    session = session_of(tmp_path)
    for request in (
        (session.set, "cloth.sheet.friction", -1.0),
        (session.set, "cloth.sheet.friction", float("nan")),
        (session.set, "nothing", 1.0),
        (session.drags.grab, "rigid", "nobody", (0.0, 0.0, 0.0)),
        (session.set_speed, 0.0),
    ):
        session.message = ""
        session.ask(*request)
        session.meet_requests()
        assert session.message
    session.ask(session.drags.move, "rigid", "ball", (0.0, 0.0, 0.0))  # in no hand: nothing happens
    session.meet_requests()
    assert session.values == {name: knob.start for name, knob in session.parameters.items()}


def test_a_single_step_stands_still_after_it(tmp_path):
    session = session_of(tmp_path)
    session.ask(session.step)
    session.meet_requests()
    assert session.world.frame == 1
    assert session.is_paused
    assert session.real_time == 0.0


EXPLICIT = WITHOUT_BALL.replace("substeps = 8", 'integrator = "explicit"\nsubsteps = 100\nmass_per_area = 0.2')


def test_values_that_bear_each_other_outlive_a_reset_in_whatever_order(tmp_path):
    session = session_of(tmp_path, EXPLICIT)
    stiff = 40.0 * session.values["cloth.sheet.stretch_stiffness"]
    with pytest.raises(ValueError, match="substeps"):
        session.set("cloth.sheet.stretch_stiffness", stiff)  # too stiff for its mass
    session.set("cloth.sheet.mass_per_area", 8.0)
    session.set("cloth.sheet.stretch_stiffness", stiff)
    session.set("cloth.sheet.friction", 1.5)
    turned = dict(session.values)
    session.reset()
    assert session.values == turned
    assert session.message == ""


def test_a_value_that_is_refused_at_a_reset_is_told_and_leaves_the_others(tmp_path):
    session = session_of(tmp_path, EXPLICIT)
    session.values["cloth.sheet.stretch_stiffness"] = 9.0e4  # as if it had been borne once
    session.set("cloth.sheet.friction", 1.5)
    session.world.solvers["rigid"].bodies.velocity[0] = (np.nan, 0.0, 0.0)
    session.ask(session.reset)
    session.meet_requests()
    assert session.values["cloth.sheet.friction"] == 1.5
    assert session.values["cloth.sheet.stretch_stiffness"] == 500.0
    assert "Not taken over: cloth.sheet.stretch_stiffness = 90000.0 (" in session.message
    run(session, 1)
    assert session.world.frame == 1


def test_nobody_moves_or_drops_what_another_browser_holds(tmp_path):
    session = session_of(tmp_path, WITHOUT_BALL)
    first, second = (0.0, -0.2, 0.5), (0.0, 0.2, 0.5)
    session.drags.grab("cloth", "sheet", first, 1)  # both got hold of a pin
    session.drags.grab("cloth", "sheet", second, 2)
    session.drags.move("cloth", "sheet", (0.0, 0.2, 0.6), 2)
    session.drags.release("cloth", "sheet", 3)
    run(session, 25)
    assert session.drags.held
    heights = session.bodies()["sheet"].arrays["position"][:, 2]
    assert heights[:17].max() < 0.505
    assert heights[-17:].min() > 0.59
    session.drags.release("cloth", "sheet", 2)
    assert session.drags.held  # the first one's
    session.drags.release("cloth", "sheet", 1)
    assert not session.drags.held


class Clock:
    """Goes on by so much at every look [s], and does something at one of them."""

    def __init__(self, step_s: float = 1e-3) -> None:
        self.now, self.step_s, self.looks = 0.0, step_s, 0
        self.at_look: dict[int, Callable[[], object]] = {}

    def __call__(self) -> float:
        self.now += self.step_s
        self.looks += 1
        self.at_look.get(self.looks, lambda: None)()
        return self.now


def test_a_frame_that_takes_too_long_goes_back_and_names_what_was_turned(tmp_path):
    clock = Clock()
    session = Session(live_job(loaded(tmp_path).job), longest_frame_s=1.0, clock=clock)
    run(session, 2)
    session.set("cloth.sheet.stretch_stiffness", 10.0)
    clock.step_s, clock.looks = 0.4, 0
    run(session, 1)
    assert clock.looks == 5  # as the frame began, as its substeps did, and after three
    assert " diverged at frame 3, t = " in session.message
    assert ": a frame takes longer than 1 s. Changed last: cloth.sheet.stretch_stiffness = 10.0." in session.message
    assert (session.world.frame, session.values["cloth.sheet.stretch_stiffness"]) == (0, 500.0)
    clock.step_s = 1e-3
    run(session, 2)
    assert session.world.frame == 2


def test_a_slow_frame_that_nobody_caused_is_told_what_makes_frames_faster_and_no_more_substeps(tmp_path):
    written, clock = loaded(tmp_path).job, Clock()
    session = Session(live_job(written, substeps=5), written=written, gave_up=True, longest_frame_s=1.0, clock=clock)
    run(session, 1)
    clock.step_s = 0.4
    run(session, 1)
    assert f"a frame takes longer than 1 s. Nothing had been changed.{FASTER} Back at the start" in session.message
    clock.step_s = 1e-3
    blow_up(session)
    assert "Differs from the job: 5 substeps a frame instead of 8." in session.message


@pytest.mark.parametrize("is_over", [False, True])
def test_a_reset_and_the_end_do_not_wait_for_the_frame(tmp_path, is_over):
    clock = Clock()
    session = Session(live_job(loaded(tmp_path).job), clock=clock)
    run(session, 2)
    before = place(session, "ball")
    ended = threading.Event()
    session.ends = ended.is_set
    clock.at_look[clock.looks + 4] = ended.set if is_over else session.ask_reset  # after two substeps of nine
    looks = clock.looks
    session.advance()
    assert (session.world.frame, clock.looks - looks) == (2, 4)
    ended.clear()
    run(session, 1)
    if not is_over:
        assert session.world.frame == 1
        assert place(session, "ball")[2] > before[2]
        assert session.message == ""


def raises(error: BaseException) -> Callable[[], None]:
    """Raises an error anew, without what it was raised from before."""

    def fails() -> None:
        raise type(error)(*error.args)

    return fails


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OverflowError("more than 268435456 pairs"), "It blew up: more than 268435456 pairs. "),
        (ZeroDivisionError("float division by zero"), "It blew up: float division by zero. "),
        (MemoryError("Unable to allocate 9 GiB"), "No memory was left: MemoryError: Unable to allocate 9 GiB. "),
        (RuntimeError("[cuda] CUDA_ERROR_OUT_OF_MEMORY: out of memory"), "No memory was left: RuntimeError: [cuda] "),
    ],
)
def test_too_many_pairs_and_too_little_memory_go_back_too(tmp_path, error, told):
    session = session_of(tmp_path)
    run(session, 1)
    session.world.advance_frame = raises(error)
    session.advance()
    assert session.message.startswith(told)
    assert "Nothing had been changed." in session.message
    assert ("substeps" in session.message) == isinstance(error, ZeroDivisionError)
    run(session, 2)
    assert session.world.frame == 2


def built(monkeypatch: pytest.MonkeyPatch, session: Session, *errors: BaseException | None) -> list[bool]:
    """Whether the cloth of before is still in memory, of each time that a scene is built; each fails as is said."""
    cloth, kept = weakref.ref(session.world.solvers["cloth"]), []
    outcomes = iter(errors)

    def build(job: Job, *, frames_per_second: float) -> World:
        kept.append(cloth() is not None)
        if (error := next(outcomes)) is not None:
            raise error
        return build_world(job, frames_per_second=frames_per_second)

    build_world = sim.build.build_world
    monkeypatch.setattr(sim.build, "build_world", build)
    return kept


def out_of_memory() -> str | None:
    raise MemoryError("Unable to allocate 9 GiB")


def test_the_old_scene_is_gone_before_one_is_built_after_too_little_memory(tmp_path, monkeypatch):
    session = session_of(tmp_path)
    run(session, 30)
    session.drags.grab("cloth", "sheet", (0.0, 0.0, 0.5))
    session.world.watch = out_of_memory
    kept = built(monkeypatch, session, None)
    session.advance()
    assert kept == [False]
    assert session.message.startswith("No memory was left: MemoryError: Unable to allocate 9 GiB. In hand: ")
    run(session, 1)
    assert session.world.frame == 1


@pytest.mark.parametrize("error", [MemoryError("no 9 GiB"), RuntimeError("[cuda] out of memory")])
def test_a_state_that_there_is_no_memory_to_keep_or_to_record_leads_back(tmp_path, monkeypatch, error):
    session = session_of(tmp_path)
    session.world.checkpoint = raises(error)
    run(session, 29)
    session.advance()
    assert (session.message.partition(":")[0], session.world.frame) == ("No memory was left", 0)
    assert describe(error) in session.message
    session.on_frame = lambda _report, _bodies: None
    session.world.snapshots = raises(error)
    session.advance()
    assert (session.message.partition(":")[0], session.world.frame) == ("No memory was left", 0)


def test_a_scene_goes_back_where_there_is_no_memory_to_show_it(tmp_path, monkeypatch):
    session = session_of(tmp_path)
    run(session, 1)
    session._checkpoints.append(old_checkpoint(session))
    kept = built(monkeypatch, session, None)
    session.free_memory("MemoryError: no 9 GiB")
    assert kept == [False]
    assert session.message.startswith("No memory was left: MemoryError: no 9 GiB. Nothing had been changed.")
    assert (session.world.frame, session.is_paused) == (1 - FRAMES_TO_TRUST, False)


@pytest.mark.parametrize("error", [MemoryError("no 9 GiB"), RuntimeError("CUDA: out of memory"), ValueError("no mesh")])
def test_a_scene_that_cannot_be_built_again_ends_live_with_a_line(tmp_path, monkeypatch, error):
    session = session_of(tmp_path)
    run(session, 1)
    session.world.watch = out_of_memory
    built(monkeypatch, session, error)
    session.ask(session.step)
    with pytest.raises(CannotGoOnError, match=f"^drape cannot begin anew: {describe(error)}$"):
        session.meet_requests()


def test_a_reset_with_memory_for_one_scene_only_lets_the_old_one_go_and_a_refused_one_does_not(tmp_path, monkeypatch):
    session = session_of(tmp_path)
    session.set("cloth.sheet.friction", 1.5)
    session.drags.grab("rigid", "ball", (0.0, 0.0, 0.62))
    run(session, 2)
    kept = built(monkeypatch, session, ValueError("no mesh"), MemoryError("no 9 GiB"), None)
    session.ask(session.reset)
    session.meet_requests()
    assert (session.message, session.world.frame) == ("no mesh", 2)
    assert (session.values["cloth.sheet.friction"], bool(session.drags.held)) == (1.5, True)  # as the world has it
    session.set("cloth.sheet.friction", 1.4)
    session.ask(session.reset)
    session.meet_requests()
    assert kept == [True, True, False]
    assert (session.message, session.world.frame, session.values["cloth.sheet.friction"]) == ("", 0, 1.4)


@pytest.mark.parametrize("error", [TypeError("no"), RuntimeError("generator raised StopIteration"), KeyError("no")])
def test_errors_of_the_program_are_no_blow_ups(tmp_path, error):
    session = session_of(tmp_path)
    session.world.advance_frame = raises(error)
    with pytest.raises(type(error)):
        session.advance()


def test_pins_that_have_let_go_are_gone_but_for_those_that_a_hand_has_taken(tmp_path):
    session = session_of(tmp_path, WITHOUT_BALL.replace('edge = "y-"', 'edge = "y-"\nrelease_s = 0.1'))
    assert sorted(session.drags.pins) == [0, 1]
    run(session, 6)
    assert sorted(session.drags.pins) == [1]
    session.ask(session.drags.grab, "pin", "0")
    run(session, 6)
    assert (session.message, bool(session.drags.held)) == ("pin 0 has been released", False)
    corner = session.bodies()["sheet"].arrays["position"][8]
    session.ask(session.drags.grab, "cloth", "sheet", tuple(map(float, corner)))
    session.ask(session.drags.move, "cloth", "sheet", (0.0, -0.2, 0.6))
    run(session, 40)
    raised = session.bodies()["sheet"].arrays["position"][8, 2]
    assert raised > 0.55
    session.ask(session.drags.release, "cloth", "sheet")
    run(session, 20)
    assert session.bodies()["sheet"].arrays["position"][8, 2] < raised - 0.1  # it falls, as no pin holds it
    session.reset()
    assert sorted(session.drags.pins) == [0, 1]
    session.drags.grab("pin", "0")
    session.drags.release("pin", "0")
    run(session, 12)
    assert sorted(session.drags.pins) == [0, 1]  # it stays where the hand has left it
    np.testing.assert_allclose(session.bodies()["sheet"].arrays["position"][:17, 2], 0.5, atol=1e-6)


def test_a_pin_with_keyframes_follows_the_hand_that_takes_it_and_stays_where_it_is_let_go(tmp_path):
    keys = 'interpolation = "linear"\nkeyframe = [{ time_s = 0.0 }, { time_s = 2.0, offset = [0.0, 0.0, 0.2] }]'
    session = session_of(tmp_path, WITHOUT_BALL.replace('edge = "y-"', f'edge = "y-"\n{keys}'))
    run(session, 3)
    session.ask(session.drags.grab, "pin", "0")
    session.ask(session.drags.move, "pin", "0", (0.0, -0.25, 0.45))
    run(session, 30)
    session.ask(session.drags.release, "pin", "0")
    run(session, 10)
    assert session.message == ""
    edge = session.bodies()["sheet"].arrays["position"][:17]
    np.testing.assert_allclose(edge[:, 1:], np.broadcast_to([-0.25, 0.45], (17, 2)), atol=2e-3)
    session.reset()
    run(session, 3)
    assert session.bodies()["sheet"].arrays["position"][8, 2] > 0.502  # on its path again


@pytest.mark.parametrize(
    ("kind", "name", "point", "told"),
    [
        ("rigid", "ball", (0.0, 0.0, 0.62), 'another browser holds "ball"'),
        ("pin", "0", (0.0, 0.0, 0.0), 'another browser holds pin 0 of "sheet"'),
        ("cloth", "sheet", (0.0, 0.0, 0.5), 'another browser holds "sheet" there'),
    ],
)
def test_nobody_takes_away_what_another_browser_holds(tmp_path, kind, name, point, told):
    session = session_of(tmp_path)
    session.drags.grab(kind, name, point, 1)
    session.ask(session.drags.grab, kind, name, point, 2)
    session.ask(session.drags.move, kind, name, (0.3, 0.0, 0.5), 2)
    session.meet_requests()
    assert session.message == told
    session.drags.release_all(2)
    assert session.drags.held
    session.drags.release(kind, name, 1)
    assert not session.drags.held
    session.ask(session.drags.grab, kind, name, point, 2)
    session.meet_requests()
    assert (session.message, bool(session.drags.held)) == (FIRST, True)


def test_two_browsers_hold_two_places_of_one_cloth(tmp_path):
    session = session_of(tmp_path, WITHOUT_BALL)
    places = {1: (-0.1, 0.0, 0.5), 2: (0.1, 0.0, 0.5)}
    for holder, place_of_it in places.items():
        session.drags.grab("cloth", "sheet", place_of_it, holder)
    session.drags.move("cloth", "sheet", (-0.1, 0.0, 0.57), 1)
    session.drags.move("cloth", "sheet", (0.1, 0.0, 0.54), 2)
    run(session, 25)
    heights = session.bodies()["sheet"].arrays["position"][[140, 148], 2]
    np.testing.assert_allclose(heights, [0.57, 0.54], atol=5e-3)
    session.drags.release_all(1)
    run(session, 10)
    heights = session.bodies()["sheet"].arrays["position"][[140, 148], 2]
    assert heights[0] < 0.56
    assert heights[1] == pytest.approx(0.54, abs=5e-3)


def test_a_refusal_goes_with_the_next_request_that_is_met_and_a_result_stays(tmp_path):
    session = session_of(tmp_path)
    run(session, 1)
    session.message = "wrote drape-live.toml"
    session.ask(session.set, "cloth.sheet.friction", -1.0)
    session.ask(session.drags.move, "rigid", "ball", (0.0, 0.0, 0.0))  # of what is in no hand, which no one waits for
    session.ask(session.drags.release_all, 3)
    session.meet_requests()
    assert "cloth.sheet.friction must lie between" in session.message
    session.ask(session.set, "cloth.sheet.friction", 0.4)
    session.meet_requests()
    assert session.message == "wrote drape-live.toml"
    session.ask(session.pause, True)
    session.meet_requests()
    assert session.message == "wrote drape-live.toml"
