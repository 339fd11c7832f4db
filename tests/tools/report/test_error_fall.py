"""The picture of a falling error: one SVG for pages, bars in the terminal, and words."""

from io import StringIO
from xml.etree import ElementTree as ET

import pytest
from msgspec.structs import asdict, replace
from rich.console import Console

from socast.core.diagnose.add.records import EffectAttempt, ErrorFall, FinalErrorFall, RemovedShare
from socast.core.evaluate.records import EstimatedValue
from socast.tools.report.error_fall import describe_share, describe_step, draw_error_fall, print_error_fall

SVG = "{http://www.w3.org/2000/svg}"
HELD_OUT = ErrorFall(
    rides=1435,
    clusters=320,
    mae_before_kwh=0.036,
    mae_after_kwh=0.030,
    fall=0.16,
    change_kwh=EstimatedValue(value=-0.006, ci95=0.002),
    noise_kwh=0.0235,
    above_before_kwh=EstimatedValue(value=0.0125, ci95=0.003),
    above_after_kwh=EstimatedValue(value=0.0065, ci95=0.002),
    removed=RemovedShare(value=0.48, low=0.32, high=0.61),
)
FINAL = FinalErrorFall(
    **asdict(HELD_OUT)
    | {
        "rides": 102,
        "above_after_kwh": EstimatedValue(value=0.0015, ci95=0.002),
        "removed": RemovedShare(value=0.88, low=0.6, high=1.2),
    }
)
STEP = EffectAttempt(effect="headwind", action="add", of_effect=HELD_OUT, final=FINAL)
REFUSED = replace(STEP, effect="snow", action="refused", final=None)


def texts(svg: str) -> list[str]:
    return ["".join(each.itertext()) for each in ET.fromstring(svg).iter(f"{SVG}text")]


def printed(*steps: EffectAttempt) -> str:
    console = Console(width=80, file=StringIO(), color_system=None)
    print_error_fall(steps, console)
    return console.file.getvalue()


def test_picture_has_the_errors_the_noise_and_the_share_of_both_kinds_of_rides():
    shown = texts(draw_error_fall([STEP]))
    for words in (
        "Error of a ride above the measurement noise [Wh]", "held-out days", "final hold-out", "1,435 rides", "12.5",
        "6.5", "noise alone: 23.5 Wh", "headwind added", "48 % (32 to 61 %)", "88 % (60 to 100 %)",
        "nothing beyond noise remains",
    ):  # fmt: skip
        assert words in shown, words


def test_lower_error_is_lower_in_the_picture_and_noise_is_below_it():
    root = ET.fromstring(draw_error_fall([STEP]))
    heights = [float(each.get("cy", "")) for each in root.iter(f"{SVG}circle")]
    zero = next(float(each.get("y1", "")) for each in root.iter(f"{SVG}line") if each.get("class") == "zero")
    assert heights[0] < heights[1] < zero
    assert heights[2] < heights[3] < zero


def test_nothing_leaves_the_picture_however_long_the_steps():
    steps = [replace(STEP, effect=f"cold_battery_heating_{i}", columns=("vehicle=taxi-003",)) for i in range(8)]
    root = ET.fromstring(draw_error_fall(steps))
    _, _, width, height = map(float, root.get("viewBox", "").split())
    for each in root.iter(f"{SVG}text"):
        assert 0 < float(each.get("y", "")) < height
        assert 0 < float(each.get("x", "")) <= width
    assert "before" not in texts(draw_error_fall(steps))


def test_refused_step_is_dashed_and_a_missing_final_hold_out_has_no_panel():
    svg = draw_error_fall([REFUSED])
    assert "stroke-dasharray" in svg
    assert "snow refused" in texts(svg)
    assert "final hold-out" not in texts(svg)
    assert "stroke-dasharray" not in draw_error_fall([STEP])


def test_page_with_its_own_colours_gets_no_style():
    assert "prefers-color-scheme" in draw_error_fall([STEP])
    inside = draw_error_fall([STEP], standalone=False)
    assert "<style" not in inside
    assert "style=" not in inside


def test_names_are_escaped():
    svg = draw_error_fall([replace(STEP, effect='<script>"&')])
    assert '<script>"& added' in texts(svg)
    assert "<script" not in svg


def test_nothing_is_drawn_without_an_error():
    assert draw_error_fall([]) == draw_error_fall([replace(STEP, of_effect=ErrorFall(), final=None)]) == ""
    assert printed() == printed(replace(STEP, of_effect=ErrorFall(), final=None)) == ""


def test_error_without_known_noise_is_drawn_as_a_whole():
    old = ErrorFall(rides=100, clusters=30, mae_before_kwh=0.42, mae_after_kwh=0.31)
    shown = texts(draw_error_fall([replace(STEP, of_effect=old, final=None)]))
    assert "420.0" in shown
    assert not any("noise alone" in each for each in shown)
    assert "unknown" in shown


@pytest.mark.parametrize(
    ("fall", "words"),
    [
        (HELD_OUT, "48 % (32 to 61 %)"),
        (FINAL, "88 % (60 to 100 %); nothing beyond noise remains"),
        (replace(HELD_OUT, removed=RemovedShare(value=-0.1, low=-0.3, high=0.1)), "−10 % (−30 to 10 %)"),
        (replace(HELD_OUT, removed=RemovedShare(), noise_kwh=None), "unknown; because the noise is unknown"),
        (replace(HELD_OUT, removed=RemovedShare()), "none; there was nothing beyond noise"),
        (
            replace(HELD_OUT, removed=RemovedShare(), above_after_kwh=EstimatedValue(value=-0.01, ci95=0.002)),
            "unknown; the estimated noise exceeds the error",
        ),
    ],
)
def test_share_is_stated_with_its_interval_or_with_why_it_is_unknown(fall, words):
    assert describe_share(fall) == words


def test_words_state_the_share_on_both_kinds_of_rides():
    words = describe_step(STEP)
    assert "on the held-out days, 48 % (32 to 61 %)" in words
    assert "on the final hold-out, 88 % (60 to 100 %)" in words


def test_terminal_has_the_same_numbers_within_80_columns():
    lines = printed(STEP, REFUSED).splitlines()
    assert max(map(len, lines)) <= 80
    words = " ".join(" ".join(lines).split())
    for part in ("1. headwind added", "before 12.5 ± 3.0", "after 6.5 ± 2.0", "removed 48 % (32 to 61 %)",
                 "removed 88 % (60 to 100 %); nothing beyond noise remains", "2. snow refused"):  # fmt: skip
        assert part in words, part
    bars = [line.count("█") + line.count("▓") for line in lines if " ± " in line]
    assert bars[0] > bars[1]
    assert bars[2] > bars[3]
