"""The change that came with a campaign is estimated without bias, with an interval that placebo campaigns calibrate."""

import numpy as np
import pytest

from socast.core.condition.before_after import compare_before_after
from socast.core.condition.campaign import LEAST_DAYS, Campaign, CampaignSpan
from socast.core.condition.campaign_records import PlaceboCampaign
from socast.core.condition.placebo import MOST_PLACEBOS, PRIOR_FREEDOM, calibrate_errors
from socast.core.errors import ModelError
from tests.support.campaign_fleets import AFTER_DAYS, AT, BEFORE_DAYS, FIRST, judge_changes, make_fleet

ONE = Campaign(("taxi-001",), AT)


def with_values(fleet, change):
    """Return a fleet whose logarithms of consumption a function changed."""
    value = fleet.consumption.value.copy()
    change(value)
    return fleet._replace(consumption=fleet.consumption._replace(value=value))


def estimate(fleet, campaign=ONE):
    """Return the result of a comparison."""
    return compare_before_after(fleet, campaign, "road_load")


def find_size(fleet, campaign=ONE):
    """Return the logarithm of the estimated factor."""
    return np.log1p(estimate(fleet, campaign).change.change)


@pytest.fixture(scope="module")
def fleet():
    """Return a fleet without a change."""
    return make_fleet(0.0, 7)


def test_planted_change_is_shown_and_its_intervals_hold_it():
    result = estimate(make_fleet(-0.06, 3))
    found = result.change
    assert found.is_shown
    assert found.ci95[0] < found.ci90[0] < -0.06 < found.ci90[1] < found.ci95[1]
    assert found.siblings == 7
    assert result.placebo.as_large <= 0.02 * len(result.placebo.campaigns)
    assert result.notes == []


def test_extra_energy_is_that_of_the_change_at_the_consumption_of_the_days_after():
    fleet = make_fleet(-0.06, 3)
    amount = fleet.consumption.amount
    found = estimate(fleet._replace(distance_km=np.full_like(amount, 50.0))).change
    after = fleet.consumption.value[0, BEFORE_DAYS + 1 :]
    used = np.isfinite(after)
    measured = (np.exp(after) * amount[0, BEFORE_DAYS + 1 :])[used].sum() / (50.0 * used.sum())
    assert found.per_100km_kwh == pytest.approx(100.0 * measured)
    extra, low, high = found.extra_per_100km_kwh
    assert extra == pytest.approx(found.per_100km_kwh * (1.0 - 1.0 / (1.0 + found.change)))
    assert low < extra < high
    assert estimate(fleet).change.extra_per_100km_kwh is None


def test_estimate_is_not_drawn_towards_zero(fleet):
    for change in (-0.3, 0.03, 0.5):
        assert find_size(make_fleet(change, 7)) - find_size(fleet) == pytest.approx(np.log1p(change), abs=1e-9)


def test_what_all_cars_of_a_model_share_is_no_change(fleet):
    def make_cold(value):
        value[:, BEFORE_DAYS:] += 0.2

    assert find_size(with_values(fleet, make_cold)) == pytest.approx(find_size(fleet), abs=0.01)


def test_without_siblings_the_weather_counts_and_the_result_says_so(fleet):
    alone = fleet._replace(models=["leaf", *[f"model-{i}" for i in range(7)]])

    def make_cold(value):
        value[:, BEFORE_DAYS:] += 0.2

    result = estimate(with_values(alone, make_cold))
    assert result.change.change > 0.1
    assert result.change.siblings == 0
    assert "No siblings of taxi-001" in result.notes[0]


def test_several_cars_without_siblings_have_no_narrower_interval_than_one(fleet):
    alone = fleet._replace(models=["leaf", "leaf", *[f"model-{i}" for i in range(6)]])
    result = estimate(alone, Campaign(("taxi-001", "taxi-002"), AT))
    errors = [np.log1p(each.change) / each.ratio for each in (*result.cars, result.change)]
    assert min(errors[:2]) < errors[2] < max(errors[:2])


def test_date_of_the_campaign_and_days_outside_the_window_are_left_out(fleet):
    def spoil(value):
        value[0, BEFORE_DAYS] = 0.9
        value[0, : BEFORE_DAYS - 20] += 0.5
        value[0, BEFORE_DAYS + 15 :] -= 0.5

    window = ONE._replace(days=20, until=AT + 14)
    assert find_size(with_values(fleet, spoil), window) == pytest.approx(find_size(fleet, window), abs=1e-9)


def test_repaired_cars_are_no_siblings_of_each_other(fleet):
    both = Campaign(("taxi-001", "taxi-002"), AT)
    result, none = estimate(make_fleet(0.1, 7, changed=2), both), estimate(fleet, both)
    sizes = [[np.log1p(each.change) for each in of.cars] for of in (result, none)]
    assert np.subtract(*sizes) == pytest.approx(np.log1p(0.1), abs=1e-9)
    assert [each.siblings for each in result.cars] == [6, 6]
    assert min(sizes[0]) <= np.log1p(result.change.change) <= max(sizes[0])


def test_several_cars_have_a_narrower_interval_than_one_but_not_by_more_than_independent_ones(fleet):
    result = estimate(fleet, Campaign(("taxi-001", "taxi-002", "taxi-003"), AT))
    errors = [np.log1p(each.change) / each.ratio for each in (*result.cars, result.change)]
    assert (np.array(errors[:3]) ** -2.0).sum() ** -0.5 < errors[3] < min(errors[:3])


def test_days_on_are_compared_with_days_off(fleet):
    spans = tuple(CampaignSpan("taxi-001", FIRST + week, FIRST + week + 6) for week in range(0, 84, 14))
    campaign = Campaign(("taxi-001",), spans=spans)

    def switch(value):
        value[0, campaign.classify("taxi-001", fleet.consumption.dates) == 2] += np.log(0.95)

    assert find_size(with_values(fleet, switch), campaign) - find_size(fleet, campaign) == pytest.approx(np.log(0.95))
    result = estimate(with_values(fleet, switch), campaign)
    assert result.change.ci90[0] < -0.05 < result.change.ci90[1] < 0.0
    assert len(result.placebo.campaigns) <= MOST_PLACEBOS


def test_cars_that_drift_widen_the_interval(fleet):
    draw = np.random.default_rng(1)

    def shake(value):
        value += np.repeat(draw.normal(0.0, 0.05, (len(value), 9)), 10, axis=1)[:, : value.shape[1]]

    steady, shaken = (estimate(each).change.ci90 for each in (fleet, with_values(fleet, shake)))
    assert shaken[1] - shaken[0] > 2.0 * (steady[1] - steady[0])


def test_scale_is_pooled_with_the_model_and_never_narrows():
    def calibrate(ratio, independent):
        one = PlaceboCampaign(vehicle_id="a", shift_days=0, change=0.0, ratio=ratio)
        return calibrate_errors([one, one], independent, 2.5)

    pooled = calibrate(-3.0, 2.0)
    assert pooled.scale**2 == pytest.approx((PRIOR_FREEDOM + 2.0 * 9.0) / (PRIOR_FREEDOM + 2.0))
    assert pooled.freedom == PRIOR_FREEDOM + 2.0
    assert pooled.as_large == 2
    assert calibrate(0.1, 50.0).scale == 1.0
    assert calibrate_errors([], 0.0, 2.5).scale == 1.0


def test_placebos_are_of_cars_and_days_without_the_campaign(fleet):
    one = estimate(fleet).placebo
    assert one.independent < len(one.campaigns) / 4.0
    own = [each.shift_days for each in one.campaigns if each.vehicle_id == "taxi-001"]
    assert own
    assert max(own) <= -LEAST_DAYS
    assert {each.vehicle_id for each in one.campaigns} == {f"taxi-{i:03}" for i in range(1, 9)}


def test_campaign_to_come_says_how_long_changes_take_to_be_seen(fleet):
    result = estimate(fleet, Campaign(("taxi-001",), AT + AFTER_DAYS + 20))
    assert result.change is None
    assert result.series == []
    days = [each.days or 1000 for each in result.detection]
    assert days == sorted(days, reverse=True)
    quiet = estimate(make_fleet(0.0, 7, noise=0.01), Campaign(("taxi-001",), AT + AFTER_DAYS + 20))
    assert all((quick.days or 1000) <= slow for quick, slow in zip(quiet.detection, days, strict=True))
    assert quiet.detection[2].days < days[1]


@pytest.mark.long
def test_change_is_seen_after_the_days_that_are_foreseen(fleet):
    foreseen = estimate(fleet, Campaign(("taxi-001",), AT)).detection[2].days
    shown = []
    for seed in range(30):
        campaign = Campaign(("taxi-001",), AT, until=AT + max(foreseen, 2 * LEAST_DAYS))
        shown.append(estimate(make_fleet(0.06, seed), campaign).change.is_shown)
    assert np.mean(shown) > 0.7


def test_series_shows_the_days_beside_the_level_before():
    (one,) = estimate(make_fleet(0.2, 3)).series
    after = np.array(one.after)
    assert np.median(np.array(one.deviation)[~after]) == pytest.approx(0.0, abs=0.03)
    assert np.median(np.array(one.deviation)[after]) == pytest.approx(0.2, abs=0.05)
    assert np.mean(one.level_after.level) == pytest.approx(0.2, abs=0.04)
    assert one.level_after.low[0] < one.level_after.level[0] < one.level_after.high[0]
    assert one.level_before.date[-1] < "2018-11-19" < one.level_after.date[0]


@pytest.mark.parametrize(
    ("campaign", "words"),
    [
        (Campaign(("taxi-01",), AT), "vehicle 'taxi-01' has no rides here; did you mean taxi-001"),
        (Campaign(("taxi-001",), FIRST), "the rides are of 2018-09-20 to 2018-12-17: give a date after 2018-09-20"),
        (Campaign(("taxi-001",), FIRST + 3), "measurements before the date, and a comparison takes 5: give more rides"),
        (Campaign(("taxi-001",), AT, until=AT + 3), "measurements after the date, and a comparison takes 5"),
        (Campaign(("taxi-001",)), "0 days with measurements on, and a comparison takes 5"),
    ],
)
def test_wrong_campaign_is_refused_with_value_limit_and_remedy(fleet, campaign, words):
    with pytest.raises(ModelError, match=words):
        estimate(fleet, campaign)


@pytest.mark.long
def test_estimates_are_unbiased_and_intervals_hold_the_truth():
    for each in judge_changes((0.0, 0.06), 80):
        assert abs(each.bias_points) < 0.4
        assert 0.82 < each.held_90 < 0.97
        assert each.held_95 > 0.9
        assert each.shown < 0.18 if each.change == 0.0 else each.shown > 0.95
