"""Draw the one picture of a falling error: the error above the noise before and after each step of a model.

The README, the tutorial, the pages of `socast add` and `socast history` and the workbench show the SVG of
`draw_error_fall`, and the terminal the bars of `print_error_fall`, both of the same steps
(`socast.core.diagnose.add.records`).
"""

from collections.abc import Callable, Sequence
from html import escape
from itertools import chain
from math import ceil, floor, log10
from typing import Final, NamedTuple

from rich.console import Console
from rich.text import Text

from socast.core.diagnose.add.records import ADDED, EffectAttempt, ErrorFall
from socast.core.formatting import format_count, format_minus

WH: Final = 1000.0
"""Wh of a kWh."""
PANELS: Final = (("held_out", "of_effect", "held-out days"), ("final", "final", "final hold-out"))
"""Class of the lines of a panel, field of a step, and the name of its rides."""
TITLE: Final = "Error of a ride above the measurement noise [Wh]"
TOTAL_TITLE: Final = "Mean absolute error of a ride, with its noise, which is unknown [Wh]"
CAPTION: Final = (
    "Mean absolute error of a ride less the error that measurement noise alone causes: at 0, a model is as good as "
    "the measurement. Bars are 95 % intervals by vehicle-day. A step is evaluated on the same rides before and after, "
    "so it is the interval of the share that shows whether the error fell. The final hold-out decides nothing."
)
REMOVED: Final = "Share removed of the error that noise does not explain, and its 95 % interval"
WIDTH: Final = 560
LEFT, RIGHT, GAP, TOP, HEIGHT = 42, 552, 44, 74, 216
"""Edges of the panels, the space between them, and their height. [px]"""
NAMED: Final = 140
"""Width of a step from which the picture has its values and the words before and after. [px]"""
BAND: Final = 28
"""Height of the band of the noise. [px]"""
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

    @property
    def step_width(self) -> float:
        """Width of a step. [px]"""
        return self.width / len(self.falls)

    @property
    def is_named(self) -> bool:
        """Whether there is room for the values and for the words before and after."""
        return self.step_width >= NAMED


def describe_share(fall: ErrorFall) -> str:
    """Return which share of the error above the noise a step removed, or why that is unknown.

    Examples
    --------
    >>> from socast.core.diagnose.add.records import RemovedShare
    >>> describe_share(ErrorFall(noise_kwh=0.02, removed=RemovedShare(value=0.5, low=0.38, high=0.61)))
    '50 % (38 to 61 %)'
    """
    return "; ".join(filter(None, _split_share(fall)))


def _split_share(fall: ErrorFall) -> tuple[str, str]:
    """Return the share that a step removed with its interval, and a remark where nothing beyond noise remains."""
    share = fall.removed
    if share.value is not None and share.low is not None and share.high is not None:
        ends = f"{_number(share.low)} to {_number(min(share.high, 1.0))} %"
        remark = "nothing beyond noise remains" if fall.is_noise_reached else ""
        return f"{_number(min(share.value, 1.0))} % ({ends})", remark
    if fall.noise_kwh is None:
        return "unknown", "because the noise is unknown"
    if fall.is_noise_overestimated:
        return "unknown", "the estimated noise exceeds the error"
    return "none", "there was nothing beyond noise"


def describe_step(step: EffectAttempt) -> str:
    """Return a sentence about the share of the error above the noise that a step removed."""
    parts = [f"on the {name}, {describe_share(fall)}" for _, name, fall in _list_falls(step)]
    done = f"{step.name} {step.result}. Share removed of the error that noise does not explain"
    return f"{done}: {'; '.join(parts)}." if parts else ""


def draw_error_fall(steps: Sequence[EffectAttempt], *, standalone: bool = True) -> str:
    """Return the picture as SVG; empty where no step has an error.

    Parameters
    ----------
    standalone : bool
        Whether the picture brings its own colours, for light and dark. A page with the classes of `STYLE` does not
        need them.
    """
    shown = [step for step in steps if _list_falls(step)]
    if not shown:
        return ""
    panels = _place_panels(shown)
    falls = list(chain.from_iterable(panel.falls for panel in panels))
    is_above = all(fall.noise_kwh is not None for fall in falls if fall.rides)
    low, high, tick = _find_range(falls, is_above=is_above)

    def place(value: float) -> float:
        return TOP + HEIGHT * (high - value) / (high - low)

    below, height = _draw_shares(shown, panels)
    title = TITLE if is_above else TOTAL_TITLE
    words = " ".join(filter(None, map(describe_step, shown)))
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" class="error-fall" viewBox="0 0 {WIDTH} {height:.0f}" '
            f'role="img" aria-label="{escape(f"{title}. {words}")}">'
        ),
        f"<style>{STYLE}</style>" if standalone else "",
        f'<rect class="paper" width="{WIDTH}" height="{height:.0f}" fill="#ffffff"/>',
        _text(14, 28, title, size=18, weight="bold"),
        "" if panels[0].is_named else _text(14, TOP + HEIGHT + 44, "○ before ● after each step", "soft", size=14),
    ]
    for panel in panels:
        parts += _draw_grid(panel, place, (low, high, tick), is_above=is_above)
        for i, (step, fall) in enumerate(zip(shown, panel.falls, strict=True)):
            parts += _draw_step(panel, i, step, fall, place, is_above=is_above)
    return "".join((*parts, *below, "</svg>\n"))


def _place_panels(steps: Sequence[EffectAttempt]) -> list[_Panel]:
    """Return the panels that have something to show, side by side."""
    falls = {key: tuple(_get_fall(step, field) for step in steps) for key, field, _ in PANELS}
    used = [(key, name) for key, _, name in PANELS if any(fall.rides for fall in falls[key])]
    width = (RIGHT - LEFT - GAP * (len(used) - 1)) / len(used)
    return [_Panel(key, name, falls[key], LEFT + i * (width + GAP), width) for i, (key, name) in enumerate(used)]


class _Error(NamedTuple):
    """Hold an error and half the width of its 95 % interval, 0 where that is unknown. [Wh]"""

    value: float
    half: float = 0.0


def _get_errors(fall: ErrorFall, *, is_above: bool) -> tuple[_Error, _Error]:
    """Return the errors before and after, above the noise if it is known."""
    if is_above:
        before, after = (
            _Error(WH * (each.value or 0.0), WH * (each.ci95 or 0.0))
            for each in (fall.above_before_kwh, fall.above_after_kwh)
        )
        return before, after
    return _Error(WH * (fall.mae_before_kwh or 0.0)), _Error(WH * (fall.mae_after_kwh or 0.0))


def _find_range(falls: Sequence[ErrorFall], *, is_above: bool) -> tuple[float, float, float]:
    """Return the ends of the axis and the distance of its ticks. [Wh]"""
    errors = [each for fall in falls if fall.rides for each in _get_errors(fall, is_above=is_above)]
    high = 1.04 * max([each.value + each.half for each in errors] + [1e-3])
    low = min([1.1 * (each.value - each.half) for each in errors] + [-high * BAND / (HEIGHT - BAND)])
    unit = 10.0 ** floor(log10(high / 4.0))
    tick = next(unit * step for step in (1.0, 2.0, 5.0, 10.0) if 5.0 * unit * step >= high)
    return low, high, tick


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
        alone = next(fall.noise_kwh or 0.0 for fall in reversed(panel.falls) if fall.rides)
        parts.append(
            _text(end - 6, TOP + HEIGHT - 9, f"noise alone: {WH * alone:.1f} Wh", "soft", anchor="end", size=14)
        )
    for k in range(ceil(low / tick), floor(high / tick) + 1):
        y, kind = place(k * tick), "zero" if k == 0 else "grid"
        width = 2 if k == 0 else 1
        parts.append(
            f'<line class="{kind}" x1="{x:.1f}" x2="{end:.1f}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="{"#4a5a66" if k == 0 else "#d5dde3"}" stroke-width="{width}"/>'
        )
        parts.append(_text(x - 8, y + 5, format_minus(f"{k * tick:g}"), "soft", anchor="end"))
    return parts


def _draw_step(
    panel: _Panel, i: int, step: EffectAttempt, fall: ErrorFall, place: Callable[[float], float], *, is_above: bool
) -> list[str]:
    """Return the error before and after a step, with the line on which it falls."""
    wide = panel.step_width
    middle, apart = panel.left + wide * (i + 0.5), min(0.24 * wide, 60.0)
    number = _text(middle, TOP + HEIGHT + 20, f"{i + 1}", "soft", anchor="middle")
    if not fall.rides:
        return [number]
    pair, xs = _get_errors(fall, is_above=is_above), (middle - apart, middle + apart)
    ys = [place(each.value) for each in pair]
    line = f'class="{panel.key}-line" stroke="{COLOURS[panel.key]}"'
    dashed = "" if step.action == ADDED else ' stroke-dasharray="5 5"'
    parts = [
        f'<line {line} stroke-width="3.5"{dashed} x1="{xs[0]:.1f}" y1="{ys[0]:.1f}" x2="{xs[1]:.1f}" y2="{ys[1]:.1f}"/>'
    ]
    for x, y, each, name in zip(xs, ys, pair, ("before", "after"), strict=True):
        top, bottom = place(each.value + each.half), place(each.value - each.half)
        parts.append(
            f'<line {line} stroke-width="2" x1="{x:.1f}" x2="{x:.1f}" y1="{top:.1f}" y2="{bottom:.1f}"/>'
            f'<circle class="{"open" if name == "before" else panel.key} {panel.key}-line" cx="{x:.1f}" cy="{y:.1f}" '
            f'r="6" fill="{"#ffffff" if name == "before" else COLOURS[panel.key]}" stroke="{COLOURS[panel.key]}" '
            'stroke-width="3"/>'
        )
        if panel.is_named:
            side, anchor = (-12, "end") if name == "before" else (12, "start")
            parts.append(_text(x + side, y + 5, format_minus(f"{each.value:.1f}"), panel.key, anchor=anchor))
            parts.append(_text(x, TOP + HEIGHT + 20, name, "soft", anchor="middle"))
    return parts if panel.is_named else [*parts, number]


def _draw_shares(steps: Sequence[EffectAttempt], panels: Sequence[_Panel]) -> tuple[list[str], float]:
    """Return the share that each step removed, below its panel, and the height of the whole picture. [px]"""
    y = TOP + HEIGHT + (48.0 if panels[0].is_named else 72.0)
    parts = [_text(14, y, REMOVED, "soft", size=14)]
    for i, step in enumerate(steps):
        y += 26
        place = f"{i + 1}. " if len(steps) > 1 else ""
        parts.append(_text(14, y, f"{place}{step.name} {step.result}", weight="bold"))
        shares = {one: _split_share(one.falls[i]) for one in panels if one.falls[i].rides}
        y += 24
        parts += [
            _text(panel.left, y, share, panel.key, weight="bold", size=19) for panel, (share, _) in shares.items()
        ]
        if any(remark for _, remark in shares.values()):
            y += 20
            parts += [_text(one.left, y, remark, one.key, size=14) for one, (_, remark) in shares.items()]
    return parts, y + 14.0


def _text(
    x: float, y: float, words: str, kind: str = "ink", *, anchor: str = "start", weight: str = "normal", size: int = 15
) -> str:
    return (
        f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" fill="{COLOURS[kind]}" text-anchor="{anchor}" '
        f'font-weight="{weight}" font-size="{size}" xml:space="preserve">{escape(words)}</text>'
    )


def print_error_fall(steps: Sequence[EffectAttempt], console: Console) -> None:
    """Print the picture with bars of block characters, within 80 columns; nothing where no step has an error."""
    shown = [(i, step) for i, step in enumerate(steps, start=1) if _list_falls(step)]
    if not shown:
        return
    falls = [fall for _, step in shown for _, _, fall in _list_falls(step)]
    is_above = all(fall.noise_kwh is not None for fall in falls)
    _, high, _ = _find_range(falls, is_above=is_above)
    console.print()
    console.print(Text(TITLE if is_above else TOTAL_TITLE, style="bold"))
    for i, step in shown:
        console.print(Text(f" {i}. {step.name} {step.result}"))
        for key, name, fall in _list_falls(step):
            for word, each in zip(("before", "after"), _get_errors(fall, is_above=is_above), strict=True):
                label = f"{name if word == 'before' else '':<15} {word:<6} {format_minus(f'{each.value:.1f}'):>6} "
                spread = f"± {each.half:<5.1f}" if each.half else " " * 7
                bar = Text(f"    {label}{spread}")
                bar.append(_draw_bar(each, high), style="blue" if key == "held_out" else "yellow")
                console.print(bar)
            console.print(Text(f"{'':20}removed {describe_share(fall)}"))
    if is_above:
        noise = " and ".join(dict.fromkeys(f"{WH * (fall.noise_kwh or 0.0):.1f}" for fall in falls))
        ends = f"{CERTAIN} up to the 95 % interval, {LIKELY} up to the value, {POSSIBLE} up to the end of the interval"
        console.print(Text(f"Noise alone causes {noise} Wh; removed: share of what noise does not explain."))
        console.print(Text(f"{ends}."))


def _draw_bar(error: _Error, high: float) -> str:
    """Return a bar up to an error, which tells its interval by lighter blocks.

    Examples
    --------
    >>> _draw_bar(_Error(5.0, 2.0), 10.0)
    '█████████▓▓▓▓▓▓░░░░░░'
    """
    ends = [round(COLUMNS * max(value, 0.0) / high) for value in (error.value - error.half, error.value)]
    last = round(COLUMNS * max(error.value + error.half, 0.0) / high)
    return CERTAIN * ends[0] + LIKELY * (ends[1] - ends[0]) + POSSIBLE * (last - ends[1])


def _get_fall(step: EffectAttempt, field: str) -> ErrorFall:
    """Return the errors of a step on some rides, without rides where it has none."""
    fall: ErrorFall | None = getattr(step, field)
    return fall or ErrorFall()


def _list_falls(step: EffectAttempt) -> list[tuple[str, str, ErrorFall]]:
    """Return the rides on which a step was evaluated: class, name and errors."""
    falls = [(key, name, _get_fall(step, field)) for key, field, name in PANELS]
    return [each for each in falls if each[2].rides and each[2].mae_before_kwh is not None]


def _number(share: float) -> str:
    return format_minus(f"{100.0 * share:.0f}")
