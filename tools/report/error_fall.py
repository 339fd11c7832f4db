"""Draw the one picture of a falling error: the error above the noise before and after each step of a model.

The README, the tutorial, the pages of `socast add` and `socast history` and the workbench show the SVG of
`draw_error_fall`, and the terminal the bars of `print_error_fall`, both of the same steps
(`socast.core.diagnose.add.error_fall`).
"""

from collections.abc import Callable, Sequence
from html import escape
from itertools import chain
from math import ceil, floor, isfinite, log10
from typing import Final, NamedTuple

from rich.console import Console
from rich.text import Text

from socast.core.diagnose.add.error_fall import ErrorFall, ErrorStep, Share, Spread
from socast.core.formatting import format_count, format_minus

WH: Final = 1000.0
"""Wh of a kWh."""
PANELS: Final = (("held_out", "held-out days"), ("final", "final hold-out"))
"""Field of a step and the name of its rides."""
TITLE: Final = "Error of a ride above the measurement noise [Wh]"
TOTAL_TITLE: Final = "Mean absolute error of a ride, with its noise, which is unknown [Wh]"
CAPTION: Final = (
    "Mean absolute error of a ride less the error that measurement noise alone causes: at 0, a model is as good as the "
    "measurement. Bars are 95 % intervals by vehicle-day. A step is evaluated on the same rides before and after, so it "
    "is the interval of the share that shows whether the error fell. The final hold-out decides nothing."
)
REMOVED: Final = "Share removed of the error that noise does not explain, with its 95 % interval"
WIDTH: Final = 640
LEFT, RIGHT, GAP, TOP, HEIGHT = 58, 626, 44, 96, 200
"""Edges of the panels, the space between them, and their height. [px]"""
NAMED: Final = 100
"""Width of a step from which the picture has its values. [px]"""
STYLE: Final = """
.error-fall { --paper: #ffffff; --ink: #12202a; --soft: #4a5a66; --grid: #d5dde3; --noise: #e9edf1;
  --held-out: #0072b2; --final: #c24e00; font-family: Helvetica, Arial, sans-serif; }
@media (prefers-color-scheme: dark) { .error-fall { --paper: #10181e; --ink: #e8eff4; --soft: #a5b5c1; --grid: #2b3b47;
  --noise: #1d2a33; --held-out: #4fa8e0; --final: #ff8a4c; } }
.error-fall .paper { fill: var(--paper); } .error-fall .noise { fill: var(--noise); }
.error-fall .ink { fill: var(--ink); } .error-fall .soft { fill: var(--soft); }
.error-fall .grid { stroke: var(--grid); } .error-fall .zero { stroke: var(--soft); }
.error-fall .held_out { fill: var(--held-out); } .error-fall .final { fill: var(--final); }
.error-fall .held_out-line { stroke: var(--held-out); } .error-fall .final-line { stroke: var(--final); }
.error-fall .open { fill: var(--paper); }
"""
"""Colours in light and dark. A page whose own colours change by a button defines the same classes itself."""
COLOURS: Final = {"ink": "#12202a", "soft": "#4a5a66", "held_out": "#0072b2", "final": "#c24e00"}
"""Colours of text where no style applies."""
COLUMNS: Final = 30
"""Length of the longest bar in the terminal."""
CERTAIN, LIKELY, POSSIBLE = "█", "▓", "░"


class _Panel(NamedTuple):
    """Hold the place of the steps on one kind of rides."""

    key: str
    name: str
    falls: tuple[ErrorFall, ...]
    left: float
    width: float


def describe_share(fall: ErrorFall) -> str:
    """Return which share of the error above the noise a step removed, or why that is unknown.

    Examples
    --------
    >>> spread = Spread(0.01, 0.002)
    >>> fall = ErrorFall(9, 9, 0.03, 0.025, 0.2, spread, 0.02, spread, Spread(0.005, 0.002), Share(0.5, 0.38, 0.61))
    >>> describe_share(fall)
    '50 % (38 to 61 %)'
    """
    share = fall.removed
    if isfinite(share.value):
        text = f"{_percent(min(share.value, 1.0))} ({_number(share.low)} to {_percent(min(share.high, 1.0))})"
        return f"{text}; nothing beyond noise remains" if fall.is_noise_reached else text
    if not fall.is_noise_known:
        return "unknown, as the noise is"
    if fall.is_noise_overestimated:
        return "unknown: the estimated noise exceeds the error"
    return "nothing beyond noise to remove"


def describe_step(step: ErrorStep) -> str:
    """Return a sentence about the share of the error above the noise that a step removed."""
    parts = [f"{describe_share(fall)} on {name}" for _, name, fall in _list_falls(step)]
    done = "" if step.action == "add" else f" ({step.action})"
    return f"{name_step(step)}{done} removes of what noise does not explain: {', '.join(parts)}." if parts else ""


def name_step(step: ErrorStep) -> str:
    """Return the effect of a step with its scope."""
    return step.effect if step.scope == "all" else f"{step.effect} ({step.scope})"


def draw_error_fall(steps: Sequence[ErrorStep], *, standalone: bool = True) -> str:
    """Return the picture as SVG; empty where no step has an error.

    Parameters
    ----------
    steps : sequence of ErrorStep
        Steps of a model, the oldest first.
    standalone : bool
        Whether the picture brings its own colours, for light and dark. A page with the classes of `STYLE` does not
        need them.
    """
    shown = [step for step in steps if _list_falls(step)]
    if not shown:
        return ""
    panels = _place_panels(shown)
    falls = list(chain.from_iterable(panel.falls for panel in panels))
    is_above = all(fall.is_noise_known for fall in falls if fall.rides)
    low, high, tick = _find_range(falls, is_above=is_above)

    def place(value: float) -> float:
        return TOP + HEIGHT * (high - value) / (high - low)

    height = TOP + HEIGHT + 66 + 44 * len(shown)
    title = TITLE if is_above else TOTAL_TITLE
    words = " ".join(filter(None, map(describe_step, shown)))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="error-fall" viewBox="0 0 {WIDTH} {height}" role="img" '
        f'font-size="15" aria-label="{escape(f"{title}. {words}")}">',
        f"<style>{STYLE}</style>" if standalone else "",
        f'<rect class="paper" width="{WIDTH}" height="{height}" fill="#ffffff"/>',
        _text(16, 28, title, size=18, weight="bold"),
        _text(16, 52, f"○ before   ● after{_describe_noise(panels) if is_above else ''}", "soft"),
    ]
    for panel in panels:
        parts += _draw_grid(panel, place, (low, high, tick), is_above=is_above)
        for i, (step, fall) in enumerate(zip(shown, panel.falls, strict=True)):
            parts += _draw_step(panel, i, step, fall, place, is_above=is_above)
    parts += _draw_shares(shown, panels)
    return "".join((*parts, "</svg>\n"))


def _place_panels(steps: Sequence[ErrorStep]) -> list[_Panel]:
    """Return the panels that have something to show, side by side."""
    falls = {key: tuple(getattr(step, key) for step in steps) for key, _ in PANELS}
    used = [(key, name) for key, name in PANELS if any(fall.rides for fall in falls[key])]
    width = (RIGHT - LEFT - GAP * (len(used) - 1)) / len(used)
    return [_Panel(key, name, falls[key], LEFT + i * (width + GAP), width) for i, (key, name) in enumerate(used)]


def _get_errors(fall: ErrorFall, *, is_above: bool) -> tuple[Spread, Spread]:
    """Return the errors before and after, above the noise if it is known. [Wh]"""
    pair = (fall.above_before_kwh, fall.above_after_kwh)
    if not is_above:
        pair = (Spread(fall.mae_before_kwh, 0.0), Spread(fall.mae_after_kwh, 0.0))
    before, after = (Spread(WH * each.value, WH * each.ci95 if isfinite(each.ci95) else 0.0) for each in pair)
    return before, after


def _find_range(falls: Sequence[ErrorFall], *, is_above: bool) -> tuple[float, float, float]:
    """Return the ends of the axis and the distance of its ticks. [Wh]"""
    errors = [each for fall in falls if fall.rides for each in _get_errors(fall, is_above=is_above)]
    high = max([each.value + each.ci95 for each in errors] + [1e-3])
    low = min([each.value - each.ci95 for each in errors] + [0.0])
    rough = (high - low) / 5.0
    unit = 10.0 ** floor(log10(rough))
    tick = next(unit * step for step in (1.0, 2.0, 5.0, 10.0) if unit * step >= rough)
    return min(floor(low / tick), -0.5) * tick, ceil(1.04 * high / tick) * tick, tick


def _draw_grid(
    panel: _Panel, place: Callable[[float], float], axis: tuple[float, float, float], *, is_above: bool
) -> list[str]:
    """Return the axis of a panel, and the noise below zero."""
    low, high, tick = axis
    x, end, zero = panel.left, panel.left + panel.width, place(0.0)
    rides = max(fall.rides for fall in panel.falls)
    parts = [
        _text(x, TOP - 14, panel.name, panel.key, weight="bold"),
        _text(end, TOP - 14, format_count(rides, "ride"), "soft", anchor="end"),
    ]
    if is_above:
        parts.append(
            f'<rect class="noise" x="{x:.1f}" y="{zero:.1f}" width="{panel.width:.1f}" '
            f'height="{TOP + HEIGHT - zero:.1f}" fill="#e9edf1"/>'
        )
    for k in range(ceil(low / tick), round(high / tick) + 1):
        y, kind = place(k * tick), "zero" if k == 0 else "grid"
        width = 2 if k == 0 else 1
        parts.append(
            f'<line class="{kind}" x1="{x:.1f}" x2="{end:.1f}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="{"#4a5a66" if k == 0 else "#d5dde3"}" stroke-width="{width}"/>'
        )
        parts.append(_text(x - 8, y + 5, format_minus(f"{k * tick:g}"), "soft", anchor="end"))
    return parts


def _draw_step(
    panel: _Panel, i: int, step: ErrorStep, fall: ErrorFall, place: Callable[[float], float], *, is_above: bool
) -> list[str]:
    """Return the error before and after a step, with the line on which it falls."""
    wide = panel.width / len(panel.falls)
    middle, apart = panel.left + wide * (i + 0.5), min(0.24 * wide, 60.0)
    number = _text(middle, TOP + HEIGHT + 20, f"{i + 1}", "soft", anchor="middle")
    if not fall.rides:
        return [number]
    pair, xs = _get_errors(fall, is_above=is_above), (middle - apart, middle + apart)
    ys = [place(each.value) for each in pair]
    line = f'class="{panel.key}-line" stroke="{COLOURS[panel.key]}"'
    dashed = "" if step.action == "add" else ' stroke-dasharray="5 5"'
    parts = [
        f'<line {line} stroke-width="3.5"{dashed} x1="{xs[0]:.1f}" y1="{ys[0]:.1f}" x2="{xs[1]:.1f}" y2="{ys[1]:.1f}"/>'
    ]
    for x, y, each, name in zip(xs, ys, pair, ("before", "after"), strict=True):
        top, bottom = place(each.value + each.ci95), place(each.value - each.ci95)
        parts.append(
            f'<line {line} stroke-width="2" x1="{x:.1f}" x2="{x:.1f}" y1="{top:.1f}" y2="{bottom:.1f}"/>'
            f'<circle class="{"open" if name == "before" else panel.key} {panel.key}-line" cx="{x:.1f}" cy="{y:.1f}" '
            f'r="6" fill="{"#ffffff" if name == "before" else COLOURS[panel.key]}" stroke="{COLOURS[panel.key]}" '
            'stroke-width="3"/>'
        )
        if wide >= NAMED:
            side, anchor = (-12, "end") if name == "before" else (12, "start")
            parts.append(_text(x + side, y + 5, format_minus(f"{each.value:.1f}"), panel.key, anchor=anchor))
    return [*parts, number]


def _draw_shares(steps: Sequence[ErrorStep], panels: Sequence[_Panel]) -> list[str]:
    """Return the share that each step removed, below its panel."""
    y = TOP + HEIGHT + 48
    parts = [_text(16, y, f"{REMOVED}:", "soft", size=14)]
    for i, step in enumerate(steps):
        y += 22
        done = "" if step.action == "add" else f", {step.action}"
        parts.append(_text(16, y, f"{i + 1} {name_step(step)}{done}", weight="bold"))
        y += 22
        parts += [
            _text(panel.left, y, describe_share(panel.falls[i]), panel.key, weight="bold")
            for panel in panels
            if panel.falls[i].rides
        ]
    return parts


def _describe_noise(panels: Sequence[_Panel]) -> str:
    """Return a clause about the noise that the axis leaves out."""
    noise = [panel.falls[-1].noise_kwh for panel in panels if panel.falls[-1].rides]
    values = " and ".join(dict.fromkeys(f"{WH * each:.1f}" for each in noise))
    return f"   0 is a perfect model: noise alone causes {values} Wh" if noise else ""


def _text(
    x: float, y: float, words: str, kind: str = "ink", *, anchor: str = "start", weight: str = "normal", size: int = 15
) -> str:
    return (
        f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" fill="{COLOURS[kind]}" text-anchor="{anchor}" '
        f'font-weight="{weight}" font-size="{size}" xml:space="preserve">{escape(words)}</text>'
    )


def print_error_fall(steps: Sequence[ErrorStep], console: Console) -> None:
    """Print the picture with bars of block characters, within 80 columns; nothing where no step has an error."""
    shown = [(i, step) for i, step in enumerate(steps, start=1) if _list_falls(step)]
    if not shown:
        return
    falls = [fall for _, step in shown for _, _, fall in _list_falls(step)]
    is_above = all(fall.is_noise_known for fall in falls)
    _, high, _ = _find_range(falls, is_above=is_above)
    console.print()
    console.print(Text(TITLE if is_above else TOTAL_TITLE, style="bold"))
    for i, step in shown:
        done = "" if step.action == "add" else f", {step.action}"
        console.print(Text(f" {i}. {name_step(step)}{done}"))
        for key, name, fall in _list_falls(step):
            for word, each in zip(("before", "after"), _get_errors(fall, is_above=is_above), strict=True):
                label = f"{name if word == 'before' else '':<15} {word:<6} {format_minus(f'{each.value:.1f}'):>6} "
                spread = f"± {each.ci95:<5.1f}" if each.ci95 else " " * 7
                bar = Text(f"    {label}{spread}")
                bar.append(_draw_bar(each, high), style="blue" if key == "held_out" else "yellow")
                console.print(bar)
            console.print(Text(f"{'':20}removed {describe_share(fall)}"))
    if is_above:
        noise = " and ".join(dict.fromkeys(f"{WH * fall.noise_kwh:.1f}" for fall in falls))
        ends = f"{CERTAIN} up to the 95 % interval, {LIKELY} up to the value, {POSSIBLE} up to the end of the interval"
        console.print(Text(f"Noise alone causes {noise} Wh; removed: share of what noise does not explain."))
        console.print(Text(f"{ends}."))


def _draw_bar(error: Spread, high: float) -> str:
    """Return a bar up to an error, which tells its interval by lighter blocks.

    Examples
    --------
    >>> _draw_bar(Spread(5.0, 2.0), 10.0)
    '█████████▓▓▓▓▓▓░░░░░░'
    """
    ends = [round(COLUMNS * max(value, 0.0) / high) for value in (error.value - error.ci95, error.value)]
    last = round(COLUMNS * max(error.value + error.ci95, 0.0) / high)
    return CERTAIN * ends[0] + LIKELY * (ends[1] - ends[0]) + POSSIBLE * (last - ends[1])


def _list_falls(step: ErrorStep) -> list[tuple[str, str, ErrorFall]]:
    """Return the rides on which a step was evaluated: key, name and errors."""
    falls = [(key, name, getattr(step, key)) for key, name in PANELS]
    return [each for each in falls if each[2].rides and isfinite(each[2].mae_before_kwh)]


def _percent(share: float) -> str:
    return f"{_number(share)} %"


def _number(share: float) -> str:
    return format_minus(f"{100.0 * share:.0f}")
