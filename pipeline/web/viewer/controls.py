"""The controls of `pipeline view` and their values. They decide nothing."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import viser

from pipeline.model.job import Job
from pipeline.web.drawing.bodies import PLAIN, POINTS, SLICE, SPEED, Look, has_form
from pipeline.web.viewer.numbers import SolverSeries, label, plot_data, plot_series
from pipeline.web.viewer.scene import SURFACES
from pipeline.web.viewer.texts import NO_FRAME

RATES = (120, 60, 30, 24, 15, 10, 5, 2, 1)


class Controls:
    """The panel beside the scene, at first with so many frames a second; `changed` is called when something is chosen.

    `waits`: there is no frame yet, so that the newest is to be followed.
    """

    def __init__(self, gui: viser.GuiApi, job: Job, *, rate: int, waits: bool, changed: Callable[[Any], None]) -> None:
        self._gui, self._changed = gui, changed
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        self.title, self.notice = gui.add_html(""), gui.add_html("")
        # As Any: the properties of viser's controls can be set, which their types do not tell.
        self.slider: Any = gui.add_slider("Frame", 0, 1, 1, 0, disabled=True)
        self.play = gui.add_button("Play")
        self.steps = gui.add_button_group("Step", ("first", "back", "next", "last"))
        self.plotted: Any = gui.add_dropdown("Plot", (NO_FRAME,), initial_value=NO_FRAME)
        self.plot: Any = gui.add_uplot(plot_data((), (), None), plot_series(""), height=200, visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Shown"):
            self._layer_folder = gui.add_folder("Things")
            self._color_by: Any = gui.add_dropdown("Particles by", (SPEED, PLAIN), initial_value=SPEED)
            self.legend = gui.add_html("")
            with gui.add_folder("Smoke", visible=has_form(job, "density")):
                self._smoke_as = gui.add_dropdown("As", (POINTS, SLICE), initial_value=POINTS)
                self._slice_axis = gui.add_dropdown("Across", ("x", "y", "z"), initial_value="y")
                self._slice_share = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5, hint="share of the smoke's box")
            self.through = gui.add_button("Look through the camera")
        with tabs.add_tab("Numbers"):
            self.table = gui.add_html("")
        with tabs.add_tab("Playing"):
            rates = tuple(str(each) for each in sorted({*RATES, rate}, reverse=True))
            hint = f"the film has {job.fps:g}"
            self.rate = gui.add_dropdown("Frames a second", rates, initial_value=str(rate), hint=hint)
            self.repeat = gui.add_checkbox("Repeat", initial_value=True)
            self.follow = gui.add_checkbox("Follow the newest", initial_value=waits, hint="while the job runs")
        self._color_by.visible = has_form(job, "points")
        self._layers: dict[str, Any] = {}
        self._choices: dict[str, tuple[str, str]] = {}
        for control in (self._color_by, self._smoke_as, self._slice_axis, self._slice_share, self.plotted):
            control.on_update(changed)

    def look(self) -> Look:
        """The chosen look."""
        return Look(
            layers=frozenset(layer for layer, box in self._layers.items() if box.value),
            color_by=self._color_by.value,
            smoke_as=self._smoke_as.value,
            slice_axis=self._slice_axis.value,
            slice_share=float(self._slice_share.value),
        )

    def chosen_numbers(self) -> tuple[str, str] | None:
        """Solver and name of the plotted number."""
        return self._choices.get(self.plotted.value)

    def show_plot(self, series: SolverSeries, frame: int | None, *, last: int) -> None:
        """Plot the chosen number with a mark at the frame, on an axis up to the last one; a zoom of a page stays."""
        chosen = self.chosen_numbers()
        self.plot.visible = chosen is not None
        if chosen is not None:
            self.plot.series = plot_series(label(*chosen))
            self.plot.scales = {"x": {"time": False, "range": (0, max(last, 1))}}
            self.plot.data = plot_data(*series.of(*chosen), frame)

    def go_to(self, frame: int | None) -> None:
        """Put the slider at a frame."""
        if frame is not None:
            self.slider.value = frame

    def offer_frames(self, frames: Sequence[int]) -> None:
        """Let the slider reach all frames."""
        self.slider.max = max(frames[-1] if frames else 1, 1)
        self.slider.disabled = not frames

    def offer_layers(self, layers: Sequence[str]) -> None:
        """A box for each kind of thing that the job has."""
        for name in [name for name in self._layers if name not in layers]:
            self._layers.pop(name).remove()
        with self._layer_folder:
            for name in layers:
                if name not in self._layers:
                    self._layers[name] = self._gui.add_checkbox(name, initial_value=name != SURFACES)
                    self._layers[name].on_update(self._changed)

    def offer_values(self, names: Collection[str]) -> None:
        """Offer the values that particles can be coloured by."""
        options = (SPEED, *sorted(set(names) - {SPEED}), PLAIN)
        if set(options) - set(self._color_by.options):
            self._color_by.options = options

    def offer_numbers(self, series: SolverSeries) -> None:
        """Offer the numbers that can be plotted."""
        choices = {label(*each): each for each in series.names()}
        if choices.keys() == self._choices.keys() or not choices:
            return
        self._choices = choices
        chosen = self.plotted.value
        self.plotted.options = tuple(choices)
        first = series.first_choice()
        if chosen not in choices and first is not None:
            self.plotted.value = label(*first)
