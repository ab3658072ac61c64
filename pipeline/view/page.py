"""The page of `pipeline view`: controls, what they mean, and the loop that shows frames.

Controls only say that something changed; one loop reads them all and decides. So no callback waits for a file, and two
browsers cannot make it inconsistent: they share the controls and see the same frame.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from html import escape
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from pipeline.cache import read_numbers
from pipeline.errors import InvalidArtifactError, PipelineError
from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.view.colors import css_ramp
from pipeline.view.committed import CommittedFrames, Stamp, artifacts_of_frame, stamp_of
from pipeline.view.drawing import Drawing, camera_orientation, vertical_fov
from pipeline.view.frames import SPEED, Particles, ShownFrame, read_shown_frame
from pipeline.view.loaded import LoadedFrames
from pipeline.view.numbers import SolverSeries, label, plot, table
from pipeline.view.playback import Playback
from pipeline.view.scene import (
    CAMERA,
    PLAIN,
    POINTS,
    SLICE,
    SURFACES,
    Extents,
    JobScene,
    Shown,
)

if TYPE_CHECKING:
    from render.camera_path import View

RATES = (120, 60, 30, 24, 15, 10, 5, 2, 1)
LOOK_S = 0.5
"""How often new frames are looked for."""
NUMBERS_S = 0.05
"""So long numbers of frames are read before the page gets its turn again: a long film has thousands of frames."""
NOTHING = "no frame yet"
ASIDE, FARTHER = np.radians(24.0), 1.3
"""Where a page looks from at first: turned about the vertical [rad] from the film's camera, and farther away."""


class ViewPage:
    """A job in the browsers of a server.

    Args:
        server: what pages connect to.
        layout: the job's folder, which is only read.
        most_particles: of a fluid that are drawn.
        most_bytes: of frames that are kept in memory.

    Raises:
        PipelineError: the job file cannot be used.
    """

    def __init__(self, server: viser.ViserServer, layout: JobLayout, *, most_particles: int, most_bytes: int) -> None:
        self._server, self._layout, self._most_particles = server, layout, most_particles
        self._commands: SimpleQueue[Callable[[float], None]] = SimpleQueue()
        self._wake = threading.Event()
        self._job_stamp = stamp_of(layout.job_file)
        self._job = load_job(layout.job_file)
        self._committed = CommittedFrames(layout)
        self._scene = JobScene(self._job, layout, self._committed)
        self._loaded = LoadedFrames(most_bytes)
        self._series, self._extents = SolverSeries(), Extents()
        self._spoilt: dict[int, str] = {}
        self._job_trouble = ""
        self._drawing = Drawing(server)
        self.playback = Playback(rate=float(min(self._job.fps, 60)))
        self._drawn: tuple[object, ...] = ()
        self._panel: tuple[object, ...] = ()
        self._next_look = -np.inf
        self._shown: ShownFrame | None = None
        self._build()

    @property
    def frame(self) -> int | None:
        """The frame that is drawn."""
        return None if self._shown is None else self._shown.numbers.frame

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames that can be seen."""
        return self._committed.numbers

    @property
    def things(self) -> frozenset[str]:
        """Names of all that is drawn."""
        return self._drawing.names

    def run(self, stop: threading.Event) -> None:
        """Show frames until told to stop."""
        while not stop.is_set():
            wait = self.turn(time.monotonic())
            self._wake.wait(min(wait, 0.1))  # no longer, as `stop` does not wake it
            self._wake.clear()

    def turn(self, now: float) -> float:
        """Do what is due at a time [s]; returns how long there is nothing more to do [s]."""
        while True:
            try:
                command = self._commands.get_nowait()
            except Empty:
                break
            command(now)
        if now >= self._next_look:
            self._look()
            self._next_look = now + LOOK_S
        pending = self._read_numbers(time.monotonic() + NUMBERS_S)
        frame = self.playback.advance(now)
        self._show(frame)
        due = self.playback.wait(now)
        waits = [self._next_look - now, *([] if due is None else [due]), *([0.0] if pending else [])]
        return max(0.0, min(waits))

    # --- what there is ---

    def _look(self) -> None:
        """Look for new frames, and for a job file that was replaced by a new submission."""
        stamp = stamp_of(self._layout.job_file)
        if stamp != self._job_stamp:
            self._job_stamp = stamp
            try:
                self._job = load_job(self._layout.job_file)
                self._job_trouble = ""
                self._scene = JobScene(self._job, self._layout, self._committed)
                self._loaded.clear()
                self._drawn = ()
                self._offer_layers()
            except (PipelineError, OSError) as error:
                self._job_trouble = f"{self._layout.job_file}: {error}; shown as it was before"
        if self._committed.update():
            frames = self._committed.numbers
            self.playback.offer(frames, follow=self._follow.value)
            self._series.keep(frames)
            self._spoilt = {frame: text for frame, text in self._spoilt.items() if frame in frames}
            self._slider.max = max(frames[-1] if frames else 1, 1)
            self._slider.disabled = not frames
            if self.playback.frame is not None and not self.playback.plays:
                self._slider.value = self.playback.frame

    def _read_numbers(self, until: float) -> bool:
        """Read numbers of frames that are new; returns whether there are more."""
        changed = False
        for frame in self._committed.numbers:
            if self._series.has(frame) or frame in self._spoilt:
                continue
            if time.monotonic() >= until:
                return True
            try:
                self._series.put(read_numbers(self._layout.path(self._layout.frame_cache(frame))))
                changed = True
            except InvalidArtifactError as error:
                self._spoilt[frame] = str(error)
        if changed:
            self._offer_numbers()
        return False

    def _load(self, frame: int, stamp: Stamp) -> ShownFrame | None:
        shown = self._loaded.get(frame, stamp)
        if shown is None:
            try:
                shown = read_shown_frame(
                    self._job, self._layout, self._committed, frame, most_particles=self._most_particles
                )
            except (InvalidArtifactError, OSError) as error:
                self._spoilt[frame] = str(error)
                return None
            self._spoilt.pop(frame, None)
            self._loaded.put(frame, stamp, shown)
            self._extents.see(shown)
        return shown

    # --- what is seen ---

    def _show(self, frame: int | None) -> None:
        settings = self._settings()
        top_speed = self._series.largest("max_speed")
        stamp = self._committed.stamp(artifacts_of_frame(self._job, self._layout, frame))
        wanted = (frame, stamp, settings, top_speed)
        if wanted != self._drawn:
            shown = None if frame is None else self._load(frame, stamp)
            self._scene.draw(self._drawing, shown, settings, self._extents, top_speed=top_speed)
            self._shown, self._drawn = shown, wanted
            if frame is not None and self.playback.plays:
                self._slider.value = frame
            self._offer_values()
        self._tell(frame, top_speed)

    def _settings(self) -> Shown:
        return Shown(
            layers=frozenset(layer for layer, box in self._layers.items() if box.value),
            color_by=self._color_by.value,
            smoke_as=self._smoke_as.value,
            slice_axis=self._slice_axis.value,
            slice_share=float(self._slice_share.value),
        )

    def _tell(self, frame: int | None, top_speed: float) -> None:
        """Text and plot; sent only where it differs."""
        self._title.content = _title(self._job.name, self._shown, frame, self._committed.numbers, self._job.frame_count)
        self._notice.content = _notice(self._troubles(frame), self._thinned())
        self._legend.content = self._legend_html(top_speed)
        self._play.label = "Pause" if self.playback.plays else "Play"
        numbers = self._series.numbers(frame)
        panel = (frame, self._plotted.value, self._series.version)
        if panel != self._panel:
            self._panel = panel
            chosen = self._choices.get(self._plotted.value)
            values = self._series.of(*chosen) if chosen is not None else ([], [])
            self._plot.content = plot(*values, current=frame, last=self._job.frame_count - 1)
            self._table.content = "" if numbers is None else table(numbers)

    def _troubles(self, frame: int | None) -> list[str]:
        troubles = [self._job_trouble] if self._job_trouble else []
        if frame is None:
            where = f"{self._layout.root} has no frame yet; they appear here as soon as they are simulated"
            return [*troubles, where]
        if frame in self._spoilt:
            troubles.append(f"frame {frame} cannot be read, see: pipeline verify ({self._spoilt[frame]})")
        if self._shown is not None:
            troubles += self._shown.troubles
            if self._layers.get(SURFACES) is not None and self._layers[SURFACES].value and not self._shown.surfaces:
                troubles.append(f"frame {frame} has no surface yet")
            if self._layers[CAMERA].value and self._shown.view is None:
                troubles.append("where the camera is follows when the whole film is simulated")
        return [*troubles, *self._scene.troubles]

    def _thinned(self) -> list[str]:
        clouds: dict[str, Particles] = {}
        if self._shown is not None:
            clouds.update(self._shown.fluids)
            clouds.update({f"whitewater of {name}": of for name, of in self._shown.whitewater.items()})
        return [
            f"{name}: {len(cloud.position):,} of {cloud.count:,} particles are drawn"
            for name, cloud in clouds.items()
            if len(cloud.position) < cloud.count
        ]

    def _legend_html(self, top_speed: float) -> str:
        name = self._color_by.value
        cloud = None
        if self._shown is not None:
            cloud = next((of for of in self._shown.fluids.values() if name in of.values), None)
        if cloud is None:
            return ""
        span = self._extents.range(name, cloud, top_speed=top_speed)
        unit = {SPEED: " m/s", "density": " kg/m³"}.get(name, "")
        return (
            f'<div style="padding:0 .8em;font-size:12px"><div style="height:8px;border-radius:4px;'
            f'background:{css_ramp(around=span.around)}"></div><div style="display:flex;justify-content:space-between">'
            f"<span>{span.low:.4g}{unit}</span><span>{span.high:.4g}{unit}</span></div></div>"
        )

    # --- controls ---

    def _build(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)  # a machine without a GPU draws thrice as fast
        self._look_from_afar()
        waits = not any(self._committed.folder.glob("*.h5.json"))
        self._title, self._notice = gui.add_html(""), gui.add_html("")
        # As Any: the properties of viser's controls can be set, which their types do not tell.
        self._slider: Any = gui.add_slider("Frame", 0, 1, 1, 0, disabled=True)
        self._play = gui.add_button("Play")
        steps = gui.add_button_group("Step", ("first", "back", "on", "last"))
        self._plotted: Any = gui.add_dropdown("Plot", (NOTHING,), initial_value=NOTHING)
        self._plot = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Shown"):
            self._layer_folder = gui.add_folder("Things")
            self._color_by: Any = gui.add_dropdown("Particles by", (SPEED, PLAIN), initial_value=SPEED)
            self._color_by.visible = bool(self._job.fluid)
            self._legend = gui.add_html("")
            with gui.add_folder("Smoke", visible=bool(self._job.smoke)):
                self._smoke_as = gui.add_dropdown("As", (POINTS, SLICE), initial_value=POINTS)
                self._slice_axis = gui.add_dropdown("Across", ("x", "y", "z"), initial_value="y")
                self._slice_share = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5, hint="share of the smoke's box")
            through = gui.add_button("Look through the camera")
        with tabs.add_tab("Numbers"):
            self._table = gui.add_html("")
        with tabs.add_tab("Playing"):
            rate = int(self.playback.rate)
            rates = tuple(str(each) for each in sorted({*RATES, rate}, reverse=True))
            hint = f"the film has {self._job.fps:g}"
            self._rate = gui.add_dropdown("Frames a second", rates, initial_value=str(rate), hint=hint)
            self._repeat = gui.add_checkbox("Repeat", initial_value=True)
            self._follow = gui.add_checkbox("Follow the newest", initial_value=waits, hint="while the job runs")
        self._layers: dict[str, Any] = {}
        self._choices: dict[str, tuple[str, str]] = {}
        self._offer_layers()

        self._slider.on_update(self._when_used(lambda _: self.playback.seek(int(self._slider.value))))
        self._play.on_click(self._when_used(self._play_or_pause))
        steps.on_click(self._when_used(lambda _: self._step(steps.value)))
        self._rate.on_update(self._when_used(lambda now: self.playback.set_rate(float(self._rate.value), now)))
        self._repeat.on_update(self._when_used(lambda _: setattr(self.playback, "repeats", self._repeat.value)))
        self._follow.on_update(self._when_used(lambda _: self._go_to_newest()))
        for control in (self._color_by, self._smoke_as, self._slice_axis, self._slice_share, self._plotted):
            control.on_update(self._when_used(lambda _: None))
        through.on_click(self._look_through)

    def _when_used(self, command: Callable[[float], None]) -> Callable[[Any], None]:
        """What a control calls: have it done by the loop, but only if a person used it."""

        def use(event: Any) -> None:
            if event.client_id is not None:
                self._commands.put(command)
                self._wake.set()

        return use

    def _play_or_pause(self, now: float) -> None:
        if self.playback.plays:
            self.playback.pause(now)
        else:
            self.playback.play(now)

    def _step(self, where: str) -> None:
        far = len(self.frames)
        self.playback.step({"first": -far, "back": -1, "on": 1, "last": far}[where])
        if self.playback.frame is not None:
            self._slider.value = self.playback.frame

    def _go_to_newest(self) -> None:
        if self._follow.value:
            self._step("last")

    def _offer_layers(self) -> None:
        """A box for each kind of thing that the job has."""
        layers = self._scene.layers
        for name in [name for name in self._layers if name not in layers]:
            self._layers.pop(name).remove()
        with self._layer_folder:
            for name in layers:
                if name not in self._layers:
                    box = self._server.gui.add_checkbox(name, initial_value=name != SURFACES)
                    box.on_update(self._when_used(lambda _: None))
                    self._layers[name] = box

    def _offer_values(self) -> None:
        """What particles can be coloured by, as the cache has it."""
        found = {name for cloud in self._shown.fluids.values() for name in cloud.values} if self._shown else set()
        options = (SPEED, *sorted(found - {SPEED}), PLAIN)
        if set(options) - set(self._color_by.options):
            self._color_by.options = options

    def _offer_numbers(self) -> None:
        """What can be plotted."""
        choices = {label(*each): each for each in self._series.names()}
        if choices.keys() == self._choices.keys() or not choices:
            return
        self._choices = choices
        chosen = self._plotted.value
        self._plotted.options = tuple(choices)
        if chosen not in choices:
            first = self._series.first_choice()
            assert first is not None
            self._plotted.value = label(*first)

    # --- where it is seen from ---

    def _first_view(self) -> View:
        from pipeline.stages.render import camera_path

        return camera_path(self._job).first()

    def _look_from_afar(self) -> None:
        """Begin beside the film's camera and behind it, so that it is in the picture itself."""
        view = self._first_view()
        target = np.array(view.look_at)
        x, y, z = np.array(view.position) - target
        cosine, sine = np.cos(ASIDE), np.sin(ASIDE)
        camera = self._server.initial_camera
        camera.look_at = target
        camera.position = target + FARTHER * np.array([cosine * x - sine * y, sine * x + cosine * y, z])
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = 0.75

    def _look_through(self, event: Any) -> None:
        """Put the camera of the page whose button it was where the film's is."""
        view = self._shown.view if self._shown is not None and self._shown.view is not None else self._first_view()
        width, height = self._job.render.resolution
        camera = event.client.camera
        with event.client.atomic():
            camera.fov = vertical_fov(view, width / height)
            camera.wxyz = camera_orientation(view)
            camera.position = view.position
            camera.look_at = view.look_at


def show_job(
    layout: JobLayout,
    *,
    host: str,
    port: int,
    most_particles: int,
    most_bytes: int,
    say: Callable[[str], None],
    stop: threading.Event,
) -> None:
    """Serve a job's page until told to stop.

    Args:
        layout: the job's folder, which is only read.
        host, port: where; see `serving.page_server`.
        most_particles, most_bytes: see `ViewPage`.
        say: is told the page's address.
        stop: ends it.

    Raises:
        PipelineError: the job file cannot be used, or the address cannot be had.
    """
    from pipeline.view.serving import address, page_server

    with page_server(host=host, port=port, label="pipeline view") as server:
        page = ViewPage(server, layout, most_particles=most_particles, most_bytes=most_bytes)
        say(address(server))
        page.run(stop)


def _title(name: str, shown: ShownFrame | None, frame: int | None, frames: tuple[int, ...], count: int) -> str:
    where = NOTHING
    if frame is not None:
        time_s = f" · {shown.numbers.time_s:.3f} s" if shown is not None else ""
        where = f"frame {frame}{time_s}"
    done = f"{len(frames)} of {count} frames simulated"
    return (
        f'<div style="padding:.2em .8em 0"><div style="font-size:17px;font-weight:600">{escape(name)}</div>'
        f'<div style="font-variant-numeric:tabular-nums">{where}</div>'
        f'<div style="opacity:.65;font-size:12px">{done}</div></div>'
    )


def _notice(troubles: list[str], remarks: list[str]) -> str:
    lines = [f'<div style="color:#f0a050">{escape(text)}</div>' for text in troubles]
    lines += [f'<div style="opacity:.65">{escape(text)}</div>' for text in remarks]
    return f'<div style="padding:0 .8em;font-size:12px;overflow-wrap:anywhere">{"".join(lines)}</div>' if lines else ""
