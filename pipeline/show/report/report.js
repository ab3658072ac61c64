// Draws the charts of a report: the element `charts` has one for each figure.
"use strict";
(() => {
  const HEIGHT = 230; // pixels
  const COLORS = 8; // `--c0` to `--c7` of report.css, then from the start again
  const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [14, 4], [4, 4, 1, 4]]; // of lines of one colour, in order

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const short = (value) => String(Number(value.toPrecision(9)));
  const told = (value) => (value == null ? "–" : String(Number(value.toPrecision(5))));

  // A piece of a line for the legend: its dashes as a background.
  const swatch = (stroke, dash) => {
    if (!dash.length) return stroke;
    let end = 0;
    const stops = dash.map((length, index) => {
      const paint = index % 2 ? "transparent" : stroke;
      const from = end;
      end += length;
      return `${paint} ${from}px ${end}px`;
    });
    return `repeating-linear-gradient(90deg, ${stops.join(", ")})`;
  };

  const draw = (panel, figure) => {
    const strokes = panel.lines.map((line) => colour(`--c${line.color % COLORS}`));
    const dashes = panel.lines.map((line) => DASHES[line.dash % DASHES.length]);
    const axis = { stroke: colour("--soft"), grid: { stroke: colour("--rule"), width: 1 }, ticks: { show: false } };
    const values = (_, splits) => splits.map((value) => (value == null ? "" : short(value)));
    const room = (_, labels) => 16 + 7 * Math.max(3, ...(labels || []).map((label) => label.length));
    const options = {
      width: figure.clientWidth,
      height: HEIGHT,
      padding: [8, 12, 0, 0],
      scales: { x: { time: false }, y: { distr: panel.logarithmic ? 3 : 1 } },
      axes: [{ ...axis, values, size: 28 }, { ...axis, values, size: room }],
      series: [
        { label: panel.x_label, value: (_, value) => told(value) },
        ...panel.lines.map((line, index) => ({
          label: line.label,
          stroke: strokes[index],
          dash: dashes[index],
          width: 1.8,
          points: { size: 5, fill: strokes[index] },
          value: (_, value) => told(value),
        })),
      ],
      legend: { markers: { width: 0, fill: (_, index) => swatch(strokes[index - 1], dashes[index - 1]) } },
      focus: { alpha: 0.35 },
      cursor: { sync: { key: "time" }, focus: { prox: 20 }, y: false },
    };
    return new uPlot(options, uPlot.join(panel.lines.map((line) => [line.x, line.y])), figure);
  };

  const panels = JSON.parse(document.getElementById("charts").textContent);
  const figures = [...document.querySelectorAll("figure")];
  let charts = [];
  const drawAll = () => {
    charts.forEach((chart) => chart.destroy());
    charts = panels.map((panel, index) => draw(panel, figures[index]));
  };
  drawAll();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  addEventListener("resize", () =>
    charts.forEach((chart, index) => chart.setSize({ width: figures[index].clientWidth, height: HEIGHT })),
  );
})();
