"""The page of a session: what can be dragged, and the knobs. Callbacks only put requests into its queue."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pipeline.live.drawing import SceneDrawing
from pipeline.live.knobs import Knob, Value
from pipeline.live.pace import told_pace
from pipeline.live.saving import Saved
from pipeline.live.session import Session, Status
from pipeline.live.take import Recorder

if TYPE_CHECKING:
    import viser

    from pipeline.job.models import Job

DECADE_STEP = 0.02
"""Of sliders over the powers of ten: 5 %."""


class LivePage:
    """All that browsers see of a session; they share it.

    Args:
        server: viser's.
        session: the scene.
        save: writes the job with the present values.
        recorder: makes takes.
        written: the job as it was read: it has the camera, and what differs from it for the sake of speed is told.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        *,
        save: Callable[[], Saved],
        recorder: Recorder,
        written: Job,
    ) -> None:
        self._written = written
        self._server, self._session = server, session
        self._save, self._recorder = save, recorder
        self._sliders: dict[str, tuple[Knob, Any]] = {}
        self._revision = session.revision
        self._said = self._noticed = ""
        gui = server.gui
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._notice = gui.add_markdown("")
        self._state = gui.add_markdown("")
        self._pace = gui.add_markdown("")
        self._add_clock(gui)
        folders: dict[str, list[Knob]] = {}
        for knob in session.knobs.values():
            folders.setdefault(knob.folder, []).append(knob)
        for label, knobs in folders.items():
            with gui.add_folder(label):
                for knob in knobs:
                    self._add_knob(gui, knob)
        self._drawing = SceneDrawing(server, session.job, written.placed_camera, self._dragged)

        @server.on_client_disconnect
        async def _(client: Any) -> None:
            session.ask(session.let_go_all, client.client_id)

    # --- from the session's thread ----------------------------------------------------------------------------------

    def show(self) -> None:
        """Show where the scene is."""
        self._drawing.show(self._session.bodies(), self._session.pins)

    def tell(self, status: Status) -> None:
        """Show how it goes, and where knobs are after something other than the page has turned them."""
        self._pace.content = _plain(told_pace(self._written, self._session.values))
        self._pause.label = "Go on" if status.is_paused else "Pause"
        self._record.label = "Stop recording" if self._recorder.is_recording else "Record"
        written = _written(status, self._session.speed)
        if written != self._said:
            self._said = written
            self._state.content = written
        if status.message != self._noticed:
            self._noticed = status.message
            self._notice.content = f"**{_plain(status.message)}**" if status.message else ""
        if self._session.revision != self._revision:
            self._revision = self._session.revision
            for name, (knob, handle) in self._sliders.items():
                shown = _shown(knob, self._session.values[name])
                if handle.value != shown:
                    handle.value = shown
                if knob.kind == "decades":
                    handle.label = _label(knob, self._session.values[name])

    # --- what it is made of -----------------------------------------------------------------------------------------

    def _add_clock(self, gui: Any) -> None:
        session = self._session
        self._pause = gui.add_button("Pause")
        self._pause.on_click(lambda _: session.ask(lambda: session.pause(not session.is_paused)))
        gui.add_button("Step").on_click(lambda _: session.ask(session.step))
        gui.add_button("Reset").on_click(lambda _: session.ask_reset())
        speed = gui.add_slider("speed", 0.05, 1.0, 0.05, 1.0, hint="1: real time, where the machine keeps up")
        speed.on_update(lambda _: session.ask(session.set_speed, float(speed.value)))
        gui.add_button("Save as job").on_click(lambda _: session.ask(self._do_save))
        self._record = gui.add_button("Record")
        self._record.on_click(lambda _: session.ask(self._recorder.toggle))

    def _do_save(self) -> None:
        path, note = self._save()
        self._session.message = f"wrote {path}{note}"

    def _add_knob(self, gui: Any, knob: Knob) -> None:
        start = self._session.values[knob.name]
        if knob.kind == "switch":
            hint = "Layers that cross while it is off hang together once it is on: reset then"
            handle = gui.add_checkbox(knob.label, bool(start), hint=hint)
        elif knob.kind == "vector":
            handle = gui.add_vector3(
                knob.label, start, min=(knob.low,) * 3, max=(knob.high,) * 3, step=0.1 if knob.high <= 100.0 else 1.0
            )
        elif knob.kind == "decades":
            low, high = math.log10(knob.low), math.log10(knob.high)
            marks = ((low, f"{knob.low:.0e}"), (high, f"{knob.high:.0e}"))
            handle = gui.add_slider(
                _label(knob, start), low, high, DECADE_STEP, _shown(knob, start), marks=marks,
                hint=f"{knob.name}: the slider has the power of ten",
            )  # fmt: skip
        else:
            step = 1 if knob.kind == "whole" else (knob.high - knob.low) / 200.0
            handle = gui.add_slider(knob.label, knob.low, knob.high, step, start, hint=knob.name)

        async def on_update(event: Any) -> None:
            if event.client is not None:  # not what `tell` has set
                value = _meant(knob, handle.value)
                self._session.ask(self._session.turn, knob.name, value)
                if knob.kind == "decades":  # the session may refuse it, and `tell` puts it right then
                    handle.label = _label(knob, value)

        handle.on_update(on_update)
        self._sliders[knob.name] = (knob, handle)

    def _dragged(self, kind: str, name: str, event: Any) -> None:
        session = self._session
        if event.phase == "start":
            if kind == "pin":
                session.ask(session.grab_pin, int(name), event.client_id)
            else:
                grab = session.grab_body if kind == "body" else session.grab_cloth
                session.ask(grab, name, event.start_position, event.client_id)
        if event.phase == "end":
            session.ask(session.let_go, kind, name, event.client_id)
        else:
            session.ask(session.drag, kind, name, event.end_position, event.client_id)


def _shown(knob: Knob, value: Value) -> Any:
    """How a widget has a value: no rounding leads past the ends, which a slider refuses."""
    if knob.kind != "decades":
        return value
    assert isinstance(value, float)
    return min(max(round(math.log10(max(value, 1e-300)), 2), math.log10(knob.low)), math.log10(knob.high))


def _label(knob: Knob, value: object) -> str:
    """What is turned and where it is: a power of ten alone says little."""
    name, bracket, unit = knob.label.partition(" [")
    assert isinstance(value, float)
    written = f"{float(f'{value:.3g}'):.6g}"
    return f"{name} {written}{' ' if bracket else ''}{unit.rstrip(']')}"


def _meant(knob: Knob, shown: Any) -> object:
    """The value that a widget means; rounding at the ends is no way out of the range."""
    if knob.kind == "decades":
        return min(max(float(f"{10.0**shown:.3g}"), knob.low), knob.high)
    return tuple(map(float, shown)) if knob.kind == "vector" else shown


def _written(status: Status, speed: float) -> str:
    """How it goes."""
    asked = status.substeps_asked
    counts = [
        f"{name} {count}{f' ({asked} asked for)' if name == 'cloth' and asked not in (None, count) else ''}"
        for name, count in status.substeps.items()
    ]
    substeps = ", ".join(counts) or "none yet"
    wanted = "" if speed == 1.0 else f" (slow motion, {speed:g} wanted)"
    going = "paused" if status.is_paused else f"{status.real_time:.2f} × real time{wanted}"
    return (
        f"frame **{status.frame}** · {status.time_s:.2f} s · {going}\n\n"
        f"{status.frame_ms:.0f} ms a frame · substeps: {substeps}"
    )


def _plain(text: str) -> str:
    """Text without what Markdown would take for marks."""
    return "".join(f"\\{sign}" if sign in "*_`[]<>#" else sign for sign in text)
