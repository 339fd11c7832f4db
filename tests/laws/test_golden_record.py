"""What the product computes stays what it was: see `tests/support/golden_record.py`."""

import pytest

from tests.support.golden_record import differences, digest, of_json, run_with_common_routines

pytestmark = pytest.mark.long


def test_results_equal_golden_record():
    result = run_with_common_routines("--tolerant")
    assert result.stdout == "nothing differs\n", result.stdout + result.stderr


def test_changed_value_and_exchanged_values_are_found():
    before = {"table": {"energy": digest([1.0, 2.0, 3.0])}}
    for values in ([1.0, 2.0, 3.1], [2.0, 1.0, 3.0], [1.0, 2.0]):
        assert differences(before, {"table": {"energy": digest(values)}}, exact=False)


def test_rounding_of_another_processor_is_allowed_unless_exact():
    before, after = ({"table": {"energy": digest([1.0, value])}} for value in (2.0, 2.0 * (1.0 + 1e-15)))
    assert differences(before, after, exact=False) == []
    assert differences(before, after, exact=True)


def test_changed_words_are_found():
    before, after = ({"report": of_json({"verdict": word})} for word in ("better", "worse"))
    assert differences(before, after, exact=False)


def test_other_version_of_equal_numbers_is_allowed_unless_exact():
    before, after = ({"autumn: model": of_json({"version": text})} for text in ("1a2b", "3c4d"))
    assert differences(before, after, exact=False) == []
    assert differences(before, after, exact=True)


def test_fitted_numbers_may_differ_more_than_tables():
    before, after = ({"energy": digest([value])} for value in (2.0, 2.0 * (1.0 + 1e-5)))
    assert differences({"autumn: model hybrid": before}, {"autumn: model hybrid": after}, exact=False) == []
    assert differences({"autumn: rides": before}, {"autumn: rides": after}, exact=False)
