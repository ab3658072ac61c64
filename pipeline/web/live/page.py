"""The page of a session: its scene and its controls. Callbacks only put requests into the session's queue."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import viser

from pipeline.kinds.live_parameters import Parameter, Value
from pipeline.web.live.admission import told_changes
from pipeline.web.live.recording import Recorder
from pipeline.web.live.saving import save_job
from pipeline.web.live.scene import LiveScene
from pipeline.web.live.session import Session
from pipeline.web.serving import in_its_loop

DECADE_STEP = 0.02
"""Of sliders over the powers of ten: 5 %."""

NO_POWERS = (
    "<style>form .mantine-Slider-root + *, form .mantine-Slider-label { display: none }"
    " form .mantine-Slider-root { margin-bottom: 0.6rem }</style>"
)
"""Hides the numbers that viser puts beside and above a slider: here they are powers of ten. The form has the value."""


class LivePage:
    """The page of a session, which all browsers share; jobs are saved in the folder. Made in the server's loop."""

    def __init__(self, server: viser.ViserServer, session: Session, recorder: Recorder, folder: Path) -> None:
        self._server, self._session, self._recorder, self._folder = server, session, recorder, folder
        self._written = recorder.loaded.job
        self._show_value: dict[str, Callable[[Value], None]] = {}
        self._revision = session.revision
        gui = server.gui
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_html(NO_POWERS)
        self._notice = gui.add_markdown("")
        self._state = gui.add_markdown("")
        self._changes = gui.add_markdown("")
        self._add_clock(gui)
        folders: dict[str, list[Parameter]] = {}
        for parameter in session.parameters.values():
            folders.setdefault(parameter.folder, []).append(parameter)
        for label, parameters in folders.items():
            with gui.add_folder(label):
                for parameter in parameters:
                    self._add_parameter(gui, parameter)
        self._scene = LiveScene(server, session.job, self._written.placed_camera, self._dragged)

        @server.on_client_disconnect
        async def _(client: Any) -> None:
            session.ask(session.drags.release_all, client.client_id)

    # --- from the session's thread ---

    def show(self) -> None:
        """Show where the scene is."""
        in_its_loop(self._server, self._scene.show, self._session.bodies(), self._session.drags.pins)

    def tell(self) -> None:
        """Show how it goes, and parameters that something other than the page has changed; only news are sent."""
        in_its_loop(self._server, self._tell)

    def _tell(self) -> None:
        self._changes.content = _plain(told_changes(self._written, self._session.values))
        self._pause.label = "Go on" if self._session.is_paused else "Pause"
        self._record.label = "Stop recording" if self._recorder.is_recording else "Record"
        self._state.content = _written(self._session)
        self._notice.content = f"**{_plain(self._session.message)}**" if self._session.message else ""
        if self._session.revision != self._revision:
            self._revision = self._session.revision
            for name, show in self._show_value.items():
                show(self._session.values[name])

    # --- what it is made of ---

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
        path, note = save_job(self._recorder.loaded, self._session.values, self._folder)
        self._session.message = f"wrote {path}{note}"

    def _add_parameter(self, gui: Any, parameter: Parameter) -> None:
        start = self._session.values[parameter.name]
        if parameter.widget == "switch":
            hint = "Layers that cross while it is off hang together once it is on: reset then"
            handle = gui.add_checkbox(parameter.label, bool(start), hint=hint)
        elif parameter.widget == "vector":
            handle = gui.add_vector3(
                parameter.label,
                start,
                min=(parameter.low,) * 3,
                max=(parameter.high,) * 3,
                step=0.1 if parameter.high <= 100.0 else 1.0,
            )
        elif parameter.widget == "decades":
            self._add_decades(gui, parameter, start)
            return
        else:
            step = 1 if parameter.widget == "whole" else (parameter.high - parameter.low) / 200.0
            handle = gui.add_slider(parameter.label, parameter.low, parameter.high, step, start, hint=parameter.name)

        async def on_update(event: Any) -> None:
            if event.client is not None:  # not what `tell` has set
                shown = handle.value
                value = tuple(map(float, shown)) if parameter.widget == "vector" else shown
                self._session.ask(self._session.set, parameter.name, value)

        handle.on_update(on_update)
        self._show_value[parameter.name] = partial(_put, handle)

    def _add_decades(self, gui: Any, parameter: Parameter, start: Value) -> None:
        """A field with the value, which is taken with Enter, over a slider of its power of ten."""
        low, high = math.log10(parameter.low), math.log10(parameter.high)
        marks = ((low, f"{parameter.low:g}"), (high, f"{parameter.high:g}"))
        with gui.add_form(None) as form:
            text = gui.add_text(parameter.label, f"{start:g}", hint=f"{parameter.name}: Enter takes what is typed")
            slider = gui.add_slider("", low, high, DECADE_STEP, _power(parameter, start), marks=marks)

        def show(value: Value) -> None:
            _put(text, f"{value:g}")
            _put(slider, _power(parameter, value))

        async def on_slide(event: Any) -> None:
            if event.client is not None:
                # rounding at the ends is no way out of the range
                value = min(max(float(f"{10.0**slider.value:.3g}"), parameter.low), parameter.high)
                _put(text, f"{value:g}")  # the session may refuse it, and `tell` puts it right then
                self._session.ask(self._session.set, parameter.name, value)

        def take(typed: str) -> None:
            self._session.set(parameter.name, _number(typed))
            in_its_loop(self._server, show, self._session.values[parameter.name])

        async def on_enter(_: Any) -> None:
            self._session.ask(take, text.value)

        slider.on_update(on_slide)
        form.on_submit(on_enter)
        self._show_value[parameter.name] = show

    def _dragged(self, kind: str, name: str, event: Any) -> None:
        ask, drags = self._session.ask, self._session.drags
        if event.phase == "start":
            ask(drags.grab, kind, name, event.start_position, event.client_id)
        if event.phase == "end":
            ask(drags.release, kind, name, event.client_id)
        else:
            ask(drags.move, kind, name, event.end_position, event.client_id)


def _put(handle: Any, shown: Any) -> None:
    """Have a widget show something; only news are sent."""
    if handle.value != shown:
        handle.value = shown


def _power(parameter: Parameter, value: Value) -> float:
    """The power of ten of a value: no rounding leads past the ends of the range, which a slider refuses."""
    assert isinstance(value, float)
    return min(max(round(math.log10(max(value, 1e-300)), 2), math.log10(parameter.low)), math.log10(parameter.high))


def _number(typed: str) -> float | str:
    """A typed number; what is none is left for the session to refuse."""
    try:
        return float(typed)
    except ValueError:
        return typed


def _written(session: Session) -> str:
    """How a scene goes, in two lines."""
    asked = session.substeps_asked
    counts = [
        f"{name} {count}{f' ({asked} asked for)' if name == 'cloth' and asked not in (None, count) else ''}"
        for name, count in session.substeps.items()
    ]
    substeps = ", ".join(counts) or "none yet"
    wanted = "" if session.speed == 1.0 else f" (slow motion, {session.speed:g} wanted)"
    going = "paused" if session.is_paused else f"{session.real_time:.2f} × real time{wanted}"
    return (
        f"frame **{session.world.frame}** · {session.world.time_s:.2f} s · {going}\n\n"
        f"{session.frame_ms:.0f} ms a frame · substeps: {substeps}"
    )


def _plain(text: str) -> str:
    """Text without what Markdown would take for marks."""
    return "".join(f"\\{sign}" if sign in "*_`[]<>#" else sign for sign in text)
