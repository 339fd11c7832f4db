"""Known events: what a file may hold, and what is refused."""

import pytest

from socast.core.diagnose.inference.events import read_events
from socast.core.diagnose.inference.scopes import KnownEvent
from socast.core.errors import ModelError


def test_file_names_dates_and_cars(tmp_path):
    file = tmp_path / "events.csv"
    file.write_text("date,vehicle_id,what\n2023-05-05,car-1,new tyres\n2023-06-01,,\n")
    assert read_events(file) == [KnownEvent("2023-05-05", "car-1", "new tyres"), KnownEvent("2023-06-01")]
    file.write_text("date\n2023-05-05\n")
    assert read_events(file) == [KnownEvent("2023-05-05")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("day\n2023-05-05\n", "no column 'date'"),
        ("date\n5 May\n", "line 2: the date is '5 May'"),
        ("", "cannot be read"),
        ("date,what\n2023-05-05,tyres\n2023-05-06,tyres, front, new\n", "quote words with a comma"),
    ],
)
def test_file_that_holds_no_events_is_refused_in_one_line(text, words, tmp_path):
    file = tmp_path / "events.csv"
    file.write_text(text)
    with pytest.raises(ModelError, match=words) as caught:
        read_events(file)
    assert "\n" not in str(caught.value)
