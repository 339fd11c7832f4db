"""Test shadow models: the laws of the pipeline hold for them, and nothing that they do affects the first model."""

import math

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core import effects
from socast.core.effects import registry
from socast.core.errors import ModelError
from socast.core.models import ANY, BASIC_PHYSICAL, EXTENDED_PHYSICAL, Fit, LinearModel, Term
from socast.core.models.interval import PredictionInterval
from socast.core.monitoring.shadow import MOST_VEHICLE_MODELS, EndedRides, ShadowModels
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import ModelErrors
from tests.support.faulty_shifts import mixed, shift
from tests.support.telemetry import START, chunked, drive, make_message, profile, telemetry, without

WARM = msgspec.structs.replace(
    EXTENDED_PHYSICAL,
    version="2",
    terms=(*EXTENDED_PHYSICAL.terms, Term(name="cold", columns=("effect_cold_rolling", "winter"), unit="N/K")),
    fits={ANY: Fit(coefficients=(1.0, 1.0, 1.0, 1.0, 1.0, 2.0))},
)
"""A model with the name of another one, another version, and an effect and a column that the first lacks."""
SHADOWS = (EXTENDED_PHYSICAL, WARM)
MODELS = ("nissan-leaf-2013", "kia-soul-ev-2015", "bmw-i3-2014")


def served(messages, cuts=(), **options):
    """Return a pipeline with shadows, its forecasts, and its messages about models."""
    pipeline = Pipeline(BASIC_PHYSICAL, **{"shadows": SHADOWS, **options})
    forecasts, errors = [], []
    for chunk in chunked(messages, cuts):
        forecasts += pipeline.push(chunk)
        errors += pipeline.model_errors()
    forecasts += pipeline.finish()
    return pipeline, forecasts, errors + pipeline.model_errors()


def decoded(messages, model=None):
    """Return the errors in messages, of one model or of all."""
    published = [msgspec.json.decode(message.payload, type=ModelErrors) for message in messages]
    return [errors for errors in published if model in {None, errors.model}]


def lapped(name="a", rides=6, days=1, seed=1, model="nissan-leaf-2013"):
    """Return a car's messages: some rides a day with parking between, on some days, measured by voltage and current."""
    rng = np.random.default_rng(seed)
    names = [part for ride in range(rides) for part in (None, f"{name}-{ride}")] + [None]
    out = [make_message("vehicle", name, model=model)]
    for day in range(days):
        speed = np.concatenate([profile(120, rng) if ride else np.zeros(20) for ride in names])
        ride_id = np.repeat(np.array(names, dtype=object), [120 if ride else 20 for ride in names])
        columns = drive(len(speed), speed=speed, ride_id=ride_id, battery_voltage_v=360.0, ambient_c=-5.0)
        columns["battery_current_a"] = 5 + 0.8 * columns["speed_kmh"]
        columns["time_s"] += 86400.0 * day
        out += telemetry(without(columns, "seq"), name)
    return out


def test_first_model_is_independent_of_its_shadows():
    messages = shift(7)
    alone = Pipeline(BASIC_PHYSICAL)
    expected = alone.push(messages) + alone.finish()
    pipeline, forecasts, errors = served(messages)
    assert forecasts == expected
    assert errors
    rides, more = alone.take_rides(), pipeline.take_rides()
    pd.testing.assert_frame_equal(rides, more[list(rides)], check_exact=True)
    assert {"effect_cold_rolling", "effect_accessories"} <= set(more) - set(rides)
    assert [one._replace(shadows_kwh=()) for one in pipeline.status()].__repr__() == repr(alone.status())
    assert alone.model_errors() == []
    assert set(pipeline.quality()) - set(alone.quality()) == {"unpredicted_by_shadow", "shadow_faults"}


@given(seed=st.integers(0, 200), cuts=st.lists(st.integers(0, 420), max_size=10))
def test_any_chunking_gives_the_same_model_errors(seed, cuts):
    messages = shift(seed)
    whole, forecasts, errors = served(messages)
    parts, *same = served(messages, cuts)
    assert same == [forecasts, errors]
    assert parts.shadows.errors() == whole.shadows.errors()
    assert repr(parts.status()) == repr(whole.status())


@given(seed=st.integers(0, 100), at=st.integers(0, 420))
def test_running_errors_continue_after_a_restart(seed, at):
    messages = shift(seed)
    _, forecasts, errors = served(messages)
    first = Pipeline(BASIC_PHYSICAL, shadows=SHADOWS)
    out, published = first.push(messages[:at]), first.model_errors()
    kept = first.snapshot()
    second = Pipeline(BASIC_PHYSICAL, shadows=SHADOWS)
    second.restore(kept)
    assert second.snapshot() == kept
    out += second.push(messages[at:]) + second.finish()
    assert out == forecasts
    assert published + second.model_errors() == errors


@given(seed=st.integers(0, 100))
def test_contribution_of_a_vehicle_is_independent_of_others(seed):
    streams = [lapped(name, 3, 2, seed + place, name) for place, name in enumerate(MODELS)]
    pipeline, _, _ = served(mixed(streams, seed))
    together = {e.model: {m.vehicle_model: m for m in e.by_vehicle_model} for e in pipeline.shadows.errors()}
    for name, stream in zip(MODELS, streams, strict=True):
        alone, _, _ = served(stream)
        for errors in alone.shadows.errors():
            assert errors.by_vehicle_model == [together[errors.model][name]]
            assert errors.overall == msgspec.structs.replace(together[errors.model][name], vehicle_model=None)


def test_running_errors_are_those_of_the_ride_table():
    pipeline, _, messages = served([*lapped(days=3), *lapped("b", seed=50, model="kia-soul-ev-2015")])
    rides = pipeline.take_rides()
    rides = rides[rides["fit_for_training"]]
    measured = rides["energy_kwh"].to_numpy()
    off = {f"{m.name}/{m.version}": m.predict_energy(rides) - measured for m in (BASIC_PHYSICAL, *SHADOWS)}
    first = np.abs(off["basic_physical/1"])
    for errors in pipeline.shadows.errors():
        error = off[errors.model]
        for errors_of_model, rows in [
            (errors.overall, slice(None)),
            *((part, (rides["vehicle_model"] == part.vehicle_model).to_numpy()) for part in errors.by_vehicle_model),
        ]:
            assert errors_of_model.rides == len(error[rows])
            assert errors_of_model.mae_kwh == pytest.approx(np.abs(error[rows]).mean())
            assert errors_of_model.bias_kwh == pytest.approx(error[rows].mean())
            assert errors_of_model.mae_pct == pytest.approx(100 * np.abs(error[rows]).sum() / measured[rows].sum())
            if errors.model != errors.first:
                assert errors_of_model.gain.mean_kwh == pytest.approx((first[rows] - np.abs(error[rows])).mean())
                assert errors_of_model.gain.rides == errors_of_model.rides
                days = rides[["vehicle_id", "date"]][rows].drop_duplicates()
                assert errors_of_model.gain.vehicle_days == len(days)
    assert pipeline.shadows.errors()[0].overall.gain is None
    assert decoded(messages)[-3:] == pipeline.shadows.errors()


def test_vehicle_day_counts_when_it_has_ended():
    _, _, messages = served(lapped(rides=4, days=2))
    errors_of_model = decoded(messages, "extended_physical/2")
    assert [errors.overall.rides for errors in errors_of_model] == [1, 2, 3, 4, 5, 6, 7, 8, 8]
    assert [errors.overall.gain.vehicle_days for errors in errors_of_model] == [0, 0, 0, 0, 1, 1, 1, 1, 2]
    assert [errors.overall.gain.rides for errors in errors_of_model] == [0, 0, 0, 0, 4, 4, 4, 4, 8]
    assert {errors.overall.gain.verdict for errors in errors_of_model} == {"undecided"}
    times = [errors.time_s for errors in errors_of_model]
    assert times == sorted(times)
    assert times[0] == pytest.approx(START + 3 * 140, abs=3)


def test_keys_distinguish_versions_and_have_the_prefix():
    _, _, messages = served(lapped(rides=1), prefix="montreal/")
    names = ("basic_physical/1", "extended_physical/1", "extended_physical/2")
    assert [message.key for message in messages] == [f"montreal/models/{name}/errors" for name in names] * 2
    assert all(
        message.receipt_ns == int(errors.time_s * 1e9)
        for message, errors in zip(messages, decoded(messages), strict=True)
    )


def test_newest_only_returns_last_message_of_each_model():
    _, _, errors = served(lapped())
    late = Pipeline(BASIC_PHYSICAL, shadows=SHADOWS)
    late.push(lapped())
    late.finish()
    assert late.model_errors(newest_only=True) == errors[-3:]
    assert late.model_errors(newest_only=True) == []


def test_repeated_model_is_refused_in_one_line():
    with pytest.raises(ModelError, match=r"^model extended_physical/1 is given twice: [^\n]+$"):
        Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL, EXTENDED_PHYSICAL])


def fails(name):
    """Return a model that raises for any ride."""

    class Failing(LinearModel):
        """A model that always raises."""

        def predict_energy(self, _):
            raise ZeroDivisionError

    fields = {field: getattr(BASIC_PHYSICAL, field) for field in BASIC_PHYSICAL.__struct_fields__}
    return Failing(**{**fields, "name": name})


def test_failing_shadow_is_counted_and_the_others_continue():
    leaves = msgspec.structs.replace(EXTENDED_PHYSICAL, name="leaves", fits={"bmw-i3-2014": WARM.fits[ANY]})
    leaves = msgspec.structs.replace(leaves, terms=WARM.terms)
    messages = lapped()
    alone = Pipeline(BASIC_PHYSICAL)
    expected = alone.push(messages) + alone.finish()
    pipeline, forecasts, _ = served(messages, shadows=[leaves, fails("broken"), EXTENDED_PHYSICAL])
    assert forecasts == expected
    quality = pipeline.quality()
    assert quality["unpredicted_by_shadow"] == {"leaves/1": 6, "broken/1": 6, "extended_physical/1": 0}
    assert list(quality["shadow_faults"]) == ["model broken/1: ZeroDivisionError"]
    first, *others = (errors.overall for errors in pipeline.shadows.errors())
    assert [one.rides for one in (first, *others)] == [6, 0, 0, 6]
    assert [one.unpredicted_rides for one in others] == [6, 6, 0]
    assert (others[0].mae_kwh, others[0].gain.mean_kwh, others[0].gain.vehicle_days) == (None, None, 0)
    assert others[2].gain.rides == 6
    assert all(math.isnan(one.shadows_kwh[0]) for one in pipeline.status())


def test_failing_effect_of_a_shadow_is_counted(monkeypatch):
    @effects.effect(coefficient="mood", unit="W", low=0, high=1, source="none, it is made up")
    def moody(speed):
        """Fails in service: P = 1 W."""
        raise OverflowError(speed)

    monkeypatch.setitem(registry._library, "moody", moody)
    term = Term(name="mood", columns=("effect_moody",), unit="1")
    shadow = LinearModel(name="s", version="1", recipe="s", terms=(term,), fits={ANY: Fit(coefficients=(1.0,))})
    messages = lapped()
    alone = Pipeline(BASIC_PHYSICAL)
    expected = alone.push(messages) + alone.finish()
    pipeline, forecasts, _ = served(messages, shadows=[shadow, EXTENDED_PHYSICAL])
    assert forecasts == expected
    quality = pipeline.quality()
    assert quality["unpredicted_by_shadow"] == {"s/1": 6, "extended_physical/1": 0}
    assert list(quality["shadow_faults"]) == ["effect moody: OverflowError"]


def ended(rng, rides, model="m", first=0.1, second=0.1, cars=10):
    """Return measured rides of a fleet, with errors of two models of given standard deviations. [kWh]"""
    lane = np.arange(rides) % cars
    start = START + 86400.0 * (np.arange(rides) // (5 * cars))
    measured = rng.uniform(0.5, 2.0, rides)
    predicted = [measured + rng.normal(0.0, spread, rides) for spread in (first, second)]
    return EndedRides(lane, start, start + 600.0, [model] * rides, measured, predicted)


@pytest.mark.parametrize(("spread", "verdict"), [(0.05, "better"), (0.1, "undecided"), (0.2, "worse")])
def test_planted_difference_is_detected(rng, spread, verdict):
    shadows = ShadowModels([BASIC_PHYSICAL, EXTENDED_PHYSICAL])
    shadows.add_ended(ended(rng, 2500, second=spread))
    gain = shadows.errors()[1].overall.gain
    assert gain.verdict == verdict
    truth = math.sqrt(2 / math.pi) * (0.1 - spread)
    assert gain.lower_kwh < truth < gain.upper_kwh
    assert gain.vehicle_days == 500 - 10
    shadows.close()
    assert shadows.errors()[1].overall.gain.vehicle_days == 500


def test_models_with_equal_predictions_are_never_distinguished(rng):
    shadows = ShadowModels([BASIC_PHYSICAL, EXTENDED_PHYSICAL])
    rides = ended(rng, 3000)
    shadows.add_ended(rides._replace(predicted=[rides.predicted[0]] * 2))
    assert shadows.errors()[1].overall.gain.verdict == "undecided"


def test_vehicle_models_beyond_the_limit_count_only_among_all(rng):
    shadows = ShadowModels([BASIC_PHYSICAL, EXTENDED_PHYSICAL])
    rides = ended(rng, 200, cars=1)
    shadows.add_ended(rides._replace(vehicle_model=[None, *(f"car {i}" for i in range(199))]))
    shadows.close()
    errors = shadows.errors()[1]
    assert len(errors.by_vehicle_model) == MOST_VEHICLE_MODELS
    assert errors.overall.rides == errors.overall.gain.rides == 200


def test_running_errors_continue_for_models_that_remain():
    messages = lapped()
    pipeline, _, _ = served(messages)
    kept = pipeline.snapshot()
    fewer = Pipeline(BASIC_PHYSICAL, shadows=[EXTENDED_PHYSICAL])
    fewer.restore(kept)
    assert [errors.overall.rides for errors in fewer.shadows.errors()] == [6, 6]
    renewed = msgspec.structs.replace(WARM, version="3")
    other = Pipeline(BASIC_PHYSICAL, shadows=[EXTENDED_PHYSICAL, renewed])
    other.restore(kept)
    assert [errors.overall.rides for errors in other.shadows.errors()] == [6, 6, 0]
    assert other.shadows.errors()[1] == pipeline.shadows.errors()[1]
    other.push(lapped(days=2))
    assert other.shadows.errors()[2].overall.rides > 0


def test_another_first_model_resets_running_errors():
    pipeline, _, _ = served(lapped())
    other = Pipeline(msgspec.structs.replace(BASIC_PHYSICAL, version="9"), shadows=SHADOWS)
    other.restore(pipeline.snapshot())
    assert {errors.overall.rides for errors in other.shadows.errors()} == {0}
    assert other.quality()["rides"] == 6


def test_snapshot_without_shadows_loads_with_shadows_of_the_same_effects():
    alone = Pipeline(EXTENDED_PHYSICAL)
    alone.push(lapped()[:-40])
    beside = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    beside.restore(alone.snapshot())
    beside.finish()
    assert beside.shadows.errors()[1].overall.rides == 1


def test_errors_of_a_single_model_are_followed_but_not_published():
    alone, _, published = served(lapped(), shadows=())
    beside, _, _ = served(lapped())
    assert published == []
    assert alone.shadows.errors() == beside.shadows.errors()[:1]
    assert alone.shadows.errors()[0].overall.rides == 6
    again = Pipeline(BASIC_PHYSICAL)
    again.restore(alone.snapshot())
    assert again.shadows.errors() == alone.shadows.errors()


def calibrated(model, half_width):
    """Return a model with an interval of a constant half width. [kWh]"""
    interval = PredictionInterval(
        scales={ANY: (half_width, 0.0, 0.0)}, distances_km=(0.0,), levels=(0.05, 0.95), quantiles=((-1.0, 1.0),)
    )
    return msgspec.structs.replace(model, interval=interval)


@pytest.mark.parametrize(("half_width", "outcomes"), [(100.0, [0, 6, 0]), (1e-9, None)])
def test_rides_inside_the_interval_of_a_model_are_counted(half_width, outcomes):
    pipeline = Pipeline(calibrated(BASIC_PHYSICAL, half_width), shadows=[EXTENDED_PHYSICAL])
    pipeline.push(lapped())
    pipeline.finish()
    with_interval, without_interval = pipeline.shadows.monitors
    bias = pipeline.shadows.errors()[0].overall.bias_kwh
    assert with_interval.interval_outcomes.tolist() == (outcomes or ([6, 0, 0] if bias > 0.0 else [0, 0, 6]))
    assert without_interval.interval_outcomes.sum() == 0
    again = Pipeline(calibrated(BASIC_PHYSICAL, half_width), shadows=[EXTENDED_PHYSICAL])
    again.restore(pipeline.snapshot())
    assert again.shadows.monitors[0].interval_outcomes.tolist() == with_interval.interval_outcomes.tolist()
    assert pipeline.shadows.faults == {}
