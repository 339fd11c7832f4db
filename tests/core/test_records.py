"""Test that records hold plain values, and that JSON, columns of tables and DataFrames follow from their fields."""

from typing import Annotated

import numpy as np

from socast.core.records import PartialRecord, Record, declare, list_shown, make_frame, to_json_values


class Part(Record, frozen=True):
    """Hold a share and its interval."""

    name: str = ""
    share: Annotated[float | None, declare("Share of the energy. [1]", "share", "percent")] = None
    ci95: tuple[float | None, float | None] | None = None
    inner: "list[Part]" = []  # noqa: RUF012 - msgspec copies an empty list
    by_car: dict[str, list[float | None]] = {}  # noqa: RUF012 - msgspec copies an empty dict


def test_numbers_of_numpy_become_plain_and_unknown_numbers_none():
    made = Part(share=np.float64(0.5), ci95=(np.float64(0.1), np.inf), by_car={"a": np.array([1.0, np.nan])})
    assert type(made.share) is float
    assert made.ci95 == (0.1, None)
    assert made.by_car == {"a": [1.0, None]}


def test_json_values_of_records_have_all_fields():
    made = Part(name="a", inner=[Part(name="b", share=float("nan"))])
    empty = {"name": "b", "share": None, "ci95": None, "inner": [], "by_car": {}}
    assert made.to_json() == {"name": "a", "share": None, "ci95": None, "inner": [empty], "by_car": {}}
    assert to_json_values({1: (made,)})["1"][0]["inner"] == [empty]


def test_json_of_a_partial_record_has_no_field_of_default_value():
    class Sparse(PartialRecord, frozen=True):
        known: float | None
        note: str = ""

    assert Sparse(known=None).to_json() == {"known": None}
    assert Sparse(known=1.0, note="a").to_json() == {"known": 1.0, "note": "a"}


def test_declared_columns_and_frames_follow_the_order_of_the_fields():
    assert {name: tuple(shown) for name, shown in list_shown(Part).items()} == {"share": ("share", "percent", "")}
    frame = make_frame([Part(name="a", share=1.0), Part(name="b")])
    assert list(make_frame([Part(name="a", ci95=(0.0, 1.0))])) == ["name", "share"]
    assert list(frame)[:2] == ["name", "share"]
    assert np.isnan(frame["share"][1])
    assert make_frame([]).empty
