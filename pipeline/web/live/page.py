"""The page of a session: its scene and its controls. Callbacks only put requests into the session's queue."""

import math
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


class LivePage:
    """The page of a session, which all browsers share; jobs are saved in the folder. Made in the server's loop."""

    def __init__(self, server: viser.ViserServer, session: Session, recorder: Recorder, folder: Path) -> None:
        self._server, self._session, self._recorder, self._folder = server, session, recorder, folder
        self._written = recorder.loaded.job
        self._sliders: dict[str, tuple[Parameter, Any]] = {}
        self._revision = session.revision
        gui = server.gui
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
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
            for name, (parameter, handle) in self._sliders.items():
                shown = _shown(parameter, self._session.values[name])
                if handle.value != shown:
                    handle.value = shown
                if parameter.widget == "decades":
                    handle.label = _label(parameter, self._session.values[name])

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
            low, high = math.log10(parameter.low), math.log10(parameter.high)
            marks = ((low, f"{parameter.low:.0e}"), (high, f"{parameter.high:.0e}"))
            hint = f"{parameter.name}: the slider has the power of ten"
            label, shown = _label(parameter, start), _shown(parameter, start)
            handle = gui.add_slider(label, low, high, DECADE_STEP, shown, marks=marks, hint=hint)
        else:
            step = 1 if parameter.widget == "whole" else (parameter.high - parameter.low) / 200.0
            handle = gui.add_slider(parameter.label, parameter.low, parameter.high, step, start, hint=parameter.name)

        async def on_update(event: Any) -> None:
            if event.client is not None:  # not what `tell` has set
                value = _meant(parameter, handle.value)
                self._session.ask(self._session.set, parameter.name, value)
                if parameter.widget == "decades":  # the session may refuse it, and `tell` puts it right then
                    handle.label = _label(parameter, value)

        handle.on_update(on_update)
        self._sliders[parameter.name] = (parameter, handle)

    def _dragged(self, kind: str, name: str, event: Any) -> None:
        ask, drags = self._session.ask, self._session.drags
        if event.phase == "start":
            ask(drags.grab, kind, name, event.start_position, event.client_id)
        if event.phase == "end":
            ask(drags.release, kind, name, event.client_id)
        else:
            ask(drags.move, kind, name, event.end_position, event.client_id)


def _shown(parameter: Parameter, value: Value) -> Any:
    """A value as its widget has it: no rounding leads past the ends, which a slider refuses."""
    if parameter.widget != "decades":
        return value
    assert isinstance(value, float)
    return min(max(round(math.log10(max(value, 1e-300)), 2), math.log10(parameter.low)), math.log10(parameter.high))


def _label(parameter: Parameter, value: object) -> str:
    """A parameter's label with its value: a power of ten alone says little."""
    name, bracket, unit = parameter.label.partition(" [")
    assert isinstance(value, float)
    written = f"{float(f'{value:.3g}'):.6g}"
    return f"{name} {written}{' ' if bracket else ''}{unit.rstrip(']')}"


def _meant(parameter: Parameter, shown: Any) -> object:
    """The value of a widget; rounding at the ends is no way out of the range."""
    if parameter.widget == "decades":
        return min(max(float(f"{10.0**shown:.3g}"), parameter.low), parameter.high)
    return tuple(map(float, shown)) if parameter.widget == "vector" else shown


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
