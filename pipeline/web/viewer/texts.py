"""The texts of the viewer's page, as HTML. Pure."""

from collections.abc import Sequence
from html import escape

from pipeline.web.drawing.bodies import PRESSURE, SPEED, Range
from pipeline.web.drawing.colors import css_ramp
from pipeline.web.viewer.frames import ShownFrame

NO_FRAME = "no frame yet"
_UNITS = {SPEED: " m/s", "density": " kg/m³", PRESSURE: " Pa"}


def title(name: str, shown: ShownFrame | None, frame: int | None, *, done: int, count: int) -> str:
    """The job, the frame and how many there are."""
    where = NO_FRAME
    if frame is not None:
        time_s = f" · {shown.numbers.time_s:.3f} s" if shown is not None else ""
        where = f"frame {frame}{time_s}"
    return (
        f'<div style="padding:.2em .8em 0"><div style="font-size:17px;font-weight:600">{escape(name)}</div>'
        f'<div style="font-variant-numeric:tabular-nums">{where}</div>'
        f'<div style="opacity:.65;font-size:12px">{done} of {count} frames simulated</div></div>'
    )


def notice(troubles: Sequence[str], remarks: Sequence[str]) -> str:
    """Troubles, and below them remarks."""
    lines = [f'<div style="color:#f0a050">{escape(text)}</div>' for text in troubles]
    lines += [f'<div style="opacity:.65">{escape(text)}</div>' for text in remarks]
    return f'<div style="padding:0 .8em;font-size:12px;overflow-wrap:anywhere">{"".join(lines)}</div>' if lines else ""


def thinned(shown: ShownFrame) -> list[str]:
    """Numbers of drawn particles, where not all are."""
    made = {"drops": shown.drops, "whitewater": shown.whitewater}
    clouds = {**shown.clouds, **{f"{kind} of {name}": of[name] for kind, of in made.items() for name in of}}
    return [
        f"{name}: {len(cloud.position):,} of {cloud.count:,} particles are drawn"
        for name, cloud in clouds.items()
        if len(cloud.position) < cloud.count
    ]


def lacking(shown: ShownFrame) -> list[str]:
    """Values that caches of earlier versions do not have."""
    return [
        f"{name}: the cache holds no pressures, as an earlier version simulated this frame"
        for name, cloud in shown.clouds.items()
        if cloud.kind == "fluid" and PRESSURE not in cloud.values
    ]


def legend(name: str, span: Range) -> str:
    """Legend of the colours of particles."""
    unit = _UNITS.get(name, "")
    return (
        '<div style="padding:0 .8em;font-size:12px"><div style="height:8px;border-radius:4px;'
        f'background:{css_ramp(around=span.around)}"></div><div style="display:flex;justify-content:space-between">'
        f"<span>{span.low:.4g}{unit}</span><span>{span.high:.4g}{unit}</span></div></div>"
    )
