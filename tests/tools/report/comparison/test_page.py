"""Test which tables of a comparison the terminal and the page show."""

from tools.report.comparison.page import PLACES, build_sections


def compared(*q):
    """Return a result with two conditions of two bins; `q` are the false discovery rates of the second."""
    bins = [
        {"bin": label, "n": 9, "vehicle_days": 9, "bias_kwh": {"value": 0.1, "ci95": 0.05}, "q": rate}
        for label, rate in zip(("-5 to 0", "0 to 5"), q, strict=True)
    ]
    even = [entry | {"q": 0.9} for entry in bins]
    about = {
        "rides": 18, "read": 18, "left_out": {}, "measured": {"vi": 1.0}, "vehicles": 3, "vehicle_days": 18,
        "first_date": "2018-01-15", "last_date": "2018-01-20",
        "consumption_kwh": {"value": 0.4, "ci95": 0.1}, "per_100km_kwh": {"value": 15.0, "ci95": 1.0},
    }  # fmt: skip
    scores = {"by": {"distance": even, "temperature": bins}, "worst": {}, "n": 18}
    return {"about": about, "models": {"basic": scores}}


def find_places(*q, commands):
    (section,) = (each for each in build_sections(compared(*q), commands=commands) if each.key == PLACES)
    return section


def test_terminal_shows_conditions_with_significant_bias_and_names_the_others():
    section = find_places(0.01, 0.9, commands=False)
    assert [table.title for table in section.tables] == ["Errors by temperature"]
    assert section.text.startswith("No significant bias by distance;")


def test_terminal_names_conditions_where_nothing_is_significant():
    section = find_places(0.9, 0.9, commands=False)
    assert not section.tables
    assert "distance, temperature" in section.text


def test_page_shows_every_condition_with_minus_signs():
    section = find_places(0.01, 0.9, commands=True)
    assert [table.title for table in section.tables] == ["Errors by distance", "Errors by temperature"]
    assert section.text == ""
    assert [row.name for row in section.tables[1].rows] == ["−5 to 0", "0 to 5"]
