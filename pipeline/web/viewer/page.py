"""The page of `pipeline view`: its controls, and the loop that shows frames.

Controls only say that something changed; one loop reads them all and decides. So no callback waits for a file, and two
browsers cannot make it inconsistent: they share the controls and see the same frame.
"""

import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
import viser

from pipeline.base.errors import InvalidArtifactError, PipelineError
from pipeline.base.files import stamp_of
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.stages.render_scene import camera_path
from pipeline.store.cache import read_numbers
from pipeline.web.bounded_cache import BoundedCache
from pipeline.web.drawing.bodies import Extents, Look
from pipeline.web.drawing.canvas import Canvas, begin_at, camera_orientation, vertical_fov
from pipeline.web.serving import in_its_loop
from pipeline.web.viewer.committed import CommittedFrames, Stamp, artifacts_of_frame
from pipeline.web.viewer.controls import Controls
from pipeline.web.viewer.frames import ShownFrame, read_shown_frame
from pipeline.web.viewer.numbers import SolverSeries, table
from pipeline.web.viewer.playback import Playback
from pipeline.web.viewer.scene import CAMERA, SURFACES, JobScene
from pipeline.web.viewer.texts import lacking, legend, notice, thinned, title
from render.camera_path import View

LOOK_S = 0.5
"""Time between two looks for new frames [s]."""
NUMBERS_S = 0.05
"""Time that numbers of frames are read before the page gets its turn again [s]: long films have thousands."""
ASIDE = np.radians(24.0)
"""Angle from the film's camera to the first view of a page, about the vertical [rad]."""


class ViewPage:
    """A job in the browsers of a server; its folder is only read, and kept frames take `most_bytes` of memory.

    Raises PipelineError: the job file cannot be used.
    """

    def __init__(self, server: viser.ViserServer, layout: JobLayout, *, most_particles: int, most_bytes: int) -> None:
        self._server, self._layout, self._most_particles = server, layout, most_particles
        self._commands: SimpleQueue[Callable[[float], None]] = SimpleQueue()
        self._wake = threading.Event()
        self._job_stamp = stamp_of(layout.job_file)
        self._job = load_job(layout.job_file)
        self._committed = CommittedFrames(layout)
        self._scene = JobScene(self._job, layout, self._committed)
        self._loaded: BoundedCache[int, ShownFrame] = BoundedCache(most_bytes, lambda shown: shown.bytes)
        self._series, self._extents = SolverSeries(), Extents()
        self._spoilt: dict[int, tuple[str, str]] = {}  # by frame: the hash it should have, and what is wrong
        self._job_trouble = self._files_trouble = ""
        self.playback = Playback(rate=float(min(self._job.fps, 60)))
        self._drawn: tuple[object, ...] = ()
        self._panel: tuple[object, ...] = ()
        self._next_look = -np.inf
        self._shown: ShownFrame | None = None
        waits = not any(self._committed.folder.glob("*.h5.json"))
        self._in_its_loop(self._lay_out, waits)

    @property
    def frame(self) -> int | None:
        """The frame that is drawn."""
        return None if self._shown is None else self._shown.numbers.frame

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames that can be seen."""
        return self._committed.numbers

    def run(self, stop: threading.Event) -> None:
        """Show frames until told to stop."""
        while not stop.is_set():
            wait = self.advance(time.monotonic())
            self._wake.wait(min(wait, 0.1))  # no longer, as `stop` does not wake it
            self._wake.clear()

    def advance(self, now: float) -> float:
        """Do everything that is due at a time [s]; returns how long there is nothing more to do [s]."""
        while not self._commands.empty():  # nobody else takes any
            self._commands.get_nowait()(now)
        try:
            if now >= self._next_look:
                self._next_look = now + LOOK_S
                self._look()
            pending = self._read_numbers(time.monotonic() + NUMBERS_S)
            frame = self.playback.advance(now)
            self._files_trouble = ""
            self._show(frame)
        except OSError as error:  # a right that was taken away, or a server of files that is gone: it may come back
            self._files_trouble = f"{self._layout.root} cannot be read now: {error}"
            self._in_its_loop(self._tell, self.playback.frame, self.controls.look())
            return LOOK_S
        due = self.playback.wait(now)
        waits = [self._next_look - now, *([] if due is None else [due]), *([0.0] if pending else [])]
        return max(0.0, min(waits))

    def _in_its_loop(self, act: Callable[..., None], *arguments: object) -> None:
        """Have the server's loop do what talks to the pages: canvas and controls."""
        in_its_loop(self._server, act, *arguments)

    def _lay_out(self, waits: bool) -> None:
        self.canvas = Canvas(self._server)
        self._look_from_aside()
        self.controls = Controls(
            self._server.gui,
            self._job,
            rate=int(self.playback.rate),
            waits=waits,
            changed=self._when_used(lambda _: None),
        )
        self.controls.offer_layers(self._scene.layers)
        self._wire()

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
                self._in_its_loop(self.controls.offer_layers, self._scene.layers)
            except (PipelineError, OSError) as error:
                self._job_trouble = f"{self._layout.job_file}: {error}; shown as it was before"
        if self._committed.update():
            frames = self._committed.numbers
            self.playback.offer(frames, follow=self.controls.follow.value)
            self._series.keep(frames)
            self._spoilt = {frame: told for frame, told in self._spoilt.items() if frame in frames}
            self._in_its_loop(self.controls.offer_frames, frames)
            if not self.playback.plays:
                self._in_its_loop(self.controls.go_to, self.playback.frame)

    def _read_numbers(self, until: float) -> bool:
        """Read numbers of frames that are new; returns whether there are more."""
        changed = False
        for frame in self._committed.numbers:
            source = self._committed.receipt(frame).hash
            if self._series.has(frame, source=source) or self._is_spoilt(frame):
                continue
            if time.monotonic() >= until:
                return True
            try:
                numbers = read_numbers(self._layout.path(self._layout.frame_cache(frame)))
                self._series.put(numbers, source=source)
                changed = True
            except InvalidArtifactError as error:
                self._spoilt[frame] = (source, str(error))
        if changed:
            self._in_its_loop(self.controls.offer_numbers, self._series)
        return False

    def _is_spoilt(self, frame: int) -> bool:
        """Whether a frame could not be read, and was not simulated anew since."""
        return frame in self._spoilt and self._spoilt[frame][0] == self._committed.receipt(frame).hash

    def _load(self, frame: int, stamp: Stamp, *, surfaces: bool) -> ShownFrame | None:
        state = (stamp, surfaces)
        shown = self._loaded.get(frame, state)
        if shown is None:
            try:
                shown = read_shown_frame(
                    self._job,
                    self._layout,
                    self._committed,
                    frame,
                    most_particles=self._most_particles,
                    surfaces=surfaces,
                )
            except (InvalidArtifactError, OSError) as error:
                self._spoilt[frame] = (self._committed.receipt(frame).hash, str(error))
                return None
            self._spoilt.pop(frame, None)
            self._loaded.put(frame, state, shown)
            self._extents.see(shown.bodies)
        return shown

    # --- what is seen ---

    def _show(self, frame: int | None) -> None:
        look = self.controls.look()
        self._extents.top_speed = self._series.largest("max_speed")
        stamp = self._committed.stamp(artifacts_of_frame(self._job, self._layout, frame))
        wanted = (frame, stamp, look, self._extents.top_speed)
        if wanted != self._drawn:
            shown = None if frame is None else self._load(frame, stamp, surfaces=SURFACES in look.layers)
            self._in_its_loop(self._scene.draw, self.canvas, shown, look, self._extents)
            self._shown, self._drawn = shown, wanted
            if self.playback.plays:
                self._in_its_loop(self.controls.go_to, frame)
            if shown is not None:
                values = {name for cloud in shown.clouds.values() for name in cloud.values}
                self._in_its_loop(self.controls.offer_values, values)
        self._in_its_loop(self._tell, frame, look)

    def _tell(self, frame: int | None, look: Look) -> None:
        """Text and plot; viser sends only what differs."""
        controls, shown = self.controls, self._shown
        # A recording that goes on has more frames than its job asks for, until it ends.
        count = max(self._job.frame_count, 1 + max(self.frames, default=0))
        controls.title.content = title(self._job.name, shown, frame, done=len(self.frames), count=count)
        remarks = [*thinned(shown), *lacking(shown)] if shown is not None else []
        controls.notice.content = notice(self._troubles(frame, look), remarks)
        controls.legend.content = self._legend(look.color_by)
        controls.play.label = "Pause" if self.playback.plays else "Play"
        chosen = controls.chosen_numbers()
        panel = (frame, chosen, self._series.version, count)
        if panel != self._panel:
            self._panel = panel
            controls.show_plot(self._series, frame, last=count - 1)
            numbers = self._series.numbers(frame)
            controls.table.content = "" if numbers is None else table(numbers)

    def _troubles(self, frame: int | None, look: Look) -> list[str]:
        troubles = [trouble for trouble in (self._job_trouble, self._files_trouble) if trouble]
        if frame is None:
            where = f"{self._layout.root} has no frame yet; they appear here as soon as they are simulated"
            return [*troubles, where]
        if self._is_spoilt(frame):
            troubles.append(f"frame {frame} cannot be read, see: pipeline verify ({self._spoilt[frame][1]})")
        if self._shown is not None:
            troubles += self._shown.troubles
            if SURFACES in look.layers and not self._shown.surfaces:
                troubles.append(f"frame {frame} has no surface yet")
            if CAMERA in look.layers and self._shown.view is None:
                troubles.append("where the camera is follows when the whole film is simulated")
        return [*troubles, *self._scene.troubles]

    def _legend(self, color_by: str) -> str:
        clouds = self._shown.clouds.values() if self._shown is not None else ()
        cloud = next((of for of in clouds if color_by in of.values), None)
        return "" if cloud is None else legend(color_by, self._extents.range(color_by, cloud))

    # --- controls ---

    def _wire(self) -> None:
        controls = self.controls
        controls.slider.on_update(self._when_used(lambda _: self.playback.seek(int(controls.slider.value))))
        controls.play.on_click(self._when_used(self._play_or_pause))
        controls.steps.on_click(self._when_used(lambda _: self._step(controls.steps.value)))
        controls.rate.on_update(self._when_used(lambda now: self.playback.set_rate(float(controls.rate.value), now)))
        controls.repeat.on_update(self._when_used(lambda _: setattr(self.playback, "repeats", controls.repeat.value)))
        controls.follow.on_update(self._when_used(lambda _: self._go_to_newest()))
        controls.through.on_click(self._look_through)

    def _when_used(self, command: Callable[[float], None]) -> Callable[[Any], None]:
        """A callback of a control: has a command done by the loop, but only if a person used it."""

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
        self.playback.step({"first": -far, "back": -1, "next": 1, "last": far}[where])
        self._in_its_loop(self.controls.go_to, self.playback.frame)

    def _go_to_newest(self) -> None:
        if self.controls.follow.value:
            self._step("last")

    # --- where it is seen from ---

    def _first_view(self) -> View:
        return camera_path(self._job).first()

    def _look_from_aside(self) -> None:
        """Begin beside the film's camera."""
        view = self._first_view()
        target = np.array(view.look_at)
        x, y, z = np.array(view.position) - target
        cosine, sine = np.cos(ASIDE), np.sin(ASIDE)
        aside = np.array([cosine * x - sine * y, sine * x + cosine * y, z])
        begin_at(self._server, target + aside, target, fov=0.75)

    async def _look_through(self, event: Any) -> None:  # a coroutine, as these are run in the server's loop
        """Put the camera of the page whose button it was where the film's is."""
        view = self._shown.view if self._shown is not None and self._shown.view is not None else self._first_view()
        width, height = self._job.render.resolution
        camera = event.client.camera
        with event.client.atomic():
            camera.fov = vertical_fov(view, width / height)
            camera.wxyz = camera_orientation(view)
            camera.position = view.position
            camera.look_at = view.look_at
