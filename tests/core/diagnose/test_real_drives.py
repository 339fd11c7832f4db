"""Test the diagnosis of two real cars with a model without heating, against their measured climate power.

The model is road load and constant auxiliaries, fitted to windows. The climate power that both cars measured is removed
from the diagnosed messages and only serves to check the result. Each data set is of one car on few days: a BMW i3 with
31 drives on 17 dates, half of them in a mild winter and half in a summer with air conditioning, and a Nissan Leaf with
135 drives on 90 dates.

Two dependencies are known: the reference accessory curve and the `accessory_scale` of the i3 were once adjusted to the
measured climate power of these same drives. `road_load_constant` uses neither, nor does any effect that is tested here.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.columns import KMH
from socast.core.diagnose.add import add
from socast.core.diagnose.add.holdout import group_rows_by_ride, predict_held_out
from socast.core.diagnose.add.refit import TermAddition, refit, refit_with
from socast.core.diagnose.add.terms import build_effect_term, build_term_columns
from socast.core.diagnose.diagnosis import diagnose
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.recipes import fit_to_windows
from socast.core.models import ANY, LinearModel
from socast.core.models.features import EFFECT_PREFIX
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.tools.commands.import_drives import collect_drives
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.drive import make_messages
from tests.support.paths import ROOT

DATA = ROOT.parent / "shared" / "data"
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}"),
]

RECIPE = "road_load_constant"
PERIOD = 3.0
CABIN = {"cabin_heating", "cabin_warmup", "door_heat_loss"}
"""Effects that heat the cabin: in the steady state, after parking, and after doors were open."""
COLD_C = 15.0
"""Outside temperature below which the climate power is heating."""
BOTH = pytest.mark.parametrize("car", ["bmw-i3", "ved"])


class Tables(NamedTuple):
    """Rides and windows of a car."""

    rides: pd.DataFrame
    windows: pd.DataFrame


class DiagnosedCar(NamedTuple):
    """Tables of a car without and with its climate power, the model, the diagnosis, and the best effect."""

    blind: Tables
    seeing: Tables
    model: LinearModel
    diagnosis: dict[str, Any]
    first: str


@cache
def diagnose_car(car: str) -> DiagnosedCar:
    """Import the drives of a car and diagnose them without their climate power."""
    if car == "ved":
        drives, settings = collect_drives([DATA / "ved_ev"], DATA_SETS["ved"]), None
    else:
        drives, settings = collect_drives([DATA / "bmw_i3"], DATA_SETS["bmw-i3"]), Settings(speed_limit=180 * KMH)
    withheld = [
        drive._replace(rows={name: rows for name, rows in drive.rows.items() if name != "hvac_w"}) for drive in drives
    ]
    blind, seeing = (tables(each, settings or Settings()) for each in (withheld, drives))
    model = fit_to_windows(RECIPE, *blind)
    diagnosis = diagnose(*blind, model)
    probable = next(cause.effect for cause in diagnosis.causes if cause.effect in effects.get_library())
    best = next(row for row in diagnosis.tested if row.effect == probable)
    return DiagnosedCar(blind, seeing, model, diagnosis, best.variant)


def tables(drives, settings: Settings) -> Tables:
    """Return the ride and window tables of drives, as `socast tables` makes them."""
    pipeline = Pipeline(settings=settings, also=list(effects.list_tabulated()), keep_forecasts=False)
    pipeline.push(make_messages(drives, PERIOD))
    pipeline.finish()
    return Tables(pipeline.take_rides(), pipeline.take_windows())


def change(car: str) -> TermAddition:
    """Return the addition of the best effect to the model."""
    first = diagnose_car(car).first
    return TermAddition(
        diagnose_car(car).model.terms,
        (),
        build_effect_term(diagnose_car(car).model, first, build_term_columns(first, ())),
    )


def fall(car: str) -> float:
    """Return the relative fall of the error of rides, each predicted by models fitted without its day."""
    rides = group_rows_by_ride(join_tables(*diagnose_car(car).blind))
    days = np.array(rides.dates)
    before, after = predict_held_out(change(car), rides, [days == day for day in sorted(set(days))])
    measured = rides.table["measured"].to_numpy()
    error, left = (float(np.abs(predicted - measured).mean()) for predicted in (before, after))
    print(f"{car}: {diagnose_car(car).first}: {error:.4f} -> {left:.4f} kWh per ride, {1 - left / error:.1%} less")
    return 1.0 - left / error


def climate(car: str) -> tuple[float, float]:
    """Return the modelled over the measured climate energy of cold rides, without and with the constant's part.

    Constant auxiliaries include the heating that is equal in all rides. Only the measured climate power determines this
    part: it is the constant less that of a road load fitted to the energy without the climate energy.
    """
    diagnosed = diagnose_car(car)
    made = refit_with(change(car), join_tables(*diagnosed.blind))
    *_, constant, coefficient = made.after.fits[ANY].coefficients
    rows = join_tables(*diagnosed.seeing)
    rows = rows.loc[rows["hvac_kwh"].notna()].reset_index(drop=True)
    less = refit(change(car), rows.assign(energy_kwh=rows["energy_kwh"] - rows["hvac_kwh"]))
    cold = rows.loc[rows["ambient_c"] < COLD_C]
    measured = float(cold["hvac_kwh"].sum())
    effect = coefficient * float(cold[f"{EFFECT_PREFIX}{diagnosed.first}"].sum())
    above = constant - less.fits[ANY].coefficients[-1]
    whole = effect + above * float(cold["effect_auxiliary"].sum())
    print(
        f"{car}: measured {measured:.2f} kWh, effect {effect:.2f} kWh, with {above:.0f} W of constant {whole:.2f} kWh"
    )
    return effect / measured, whole / measured


@BOTH
def test_diagnosis_does_not_use_measured_climate_power(car):
    blind, seeing = diagnose_car(car).blind, diagnose_car(car).seeing
    for one, other in zip(blind, seeing, strict=True):
        assert one["hvac_kwh"].isna().all()
        assert other["hvac_kwh"].notna().any()
        read = [name for name in one if name != "hvac_kwh" and not name.startswith("quality_")]
        pd.testing.assert_frame_equal(one[read], other[read])
    assert not [name for name in effects.list_tabulated() if "hvac" in effects.get(name).arguments]
    assert not [term for term in diagnose_car(car).model.terms if "accessor" in " ".join(term.columns)]


def test_diagnosis_of_leaf_ranks_cabin_heating_first():
    """Without the temperature of the battery, heating of a cold battery is the only other explanation."""
    diagnosis = diagnose_car("ved").diagnosis
    first = diagnosis.missing[0]
    assert diagnosis.verdict == first.effect == "cabin_heating"
    assert first.coefficient.plausible
    assert set(first.credible_set) <= {"cabin_heating", "cold_battery_heating"}
    assert sum(each.probability for each in first.causes if each.effect in first.credible_set) > 0.9


def test_diagnosis_of_i3_ranks_cabin_heat_first():
    """Heating by temperature is named; warming up after parking is named, or told as a form that resembles it.

    No effect has the shape of this heater exactly. It took 3.9 kW over the first five minutes, 1.5 kW over the next
    five, then 1.2 kW, as measured at 3 to 9 °C outside. With 17 dates of one car, the effects that heat the cabin are
    hardly distinguishable.
    """
    diagnosis = diagnose_car("bmw-i3").diagnosis
    best = sorted((row for row in diagnosis.tested if row.gain), key=lambda row: -row.gain)[:3]
    assert {row.effect for row in best} <= CABIN | {"cold_rolling"}
    assert best[0].effect in CABIN
    assert all(row.z > 2.1 for row in best)
    assert max(row.z for row in best) > 2.9
    named = {one.effect for one in diagnosis.missing}
    assert "cabin_heating" in named
    assert "cabin_warmup" in named | {one.resembles for one in diagnosis.unknown}
    assert diagnosis.verdict in CABIN
    assert diagnosis.missing[0].coefficient.plausible


def test_error_of_held_out_rides_falls_for_leaf():
    assert fall("ved") > 0.2


def test_error_of_held_out_rides_falls_for_i3():
    """The error falls by two fifths with every day predicted without it; the goal of 45 % is missed.

    Subtracting the measured climate energy where it is known lowers the error by 59 %.
    """
    assert fall("bmw-i3") > 0.4
    diagnosed = diagnose_car("bmw-i3")
    first = diagnosed.first
    trial = add.add_effect(
        diagnosed.model,
        first,
        build_term_columns(first, ()),
        join_tables(*diagnosed.blind),
        rides=diagnosed.blind.rides,
    ).trial
    assert trial.accepted
    assert trial.coefficient.plausible
    assert trial.on_days.fall > 0.3


@BOTH
def test_energy_of_effect_matches_measured_climate_power(car):
    """The energies agree within 25 % with or without the part that the constant includes, and within half without it.

    Heating from a higher outside temperature on and a smaller constant explain the Leaf's drives as well. The constant
    of the i3 also takes up its warm-up, which the model of this test lacks.
    """
    effect, whole = climate(car)
    assert 0.5 < effect < 1.5
    assert min(abs(effect - 1.0), abs(whole - 1.0)) < 0.25


def test_error_of_leaf_is_a_constant_load_of_each_ride():
    """The measured climate power differs by 0.34 to 0.39 kW between rides, beyond temperature.

    With the climate power subtracted, 0.29 kW remain, in sum 0.48 kW.
    """
    (load,) = diagnose_car("ved").diagnosis.error_location.loads
    assert (load.level, load.kind, load.unit) == ("ride", "constant", "W")
    assert load.low < 420.0 < load.high
    assert load.low > 300.0


def test_error_of_i3_is_a_load_at_the_beginning_of_rides():
    first, *_ = diagnose_car("bmw-i3").diagnosis.error_location.loads
    assert first.kind == "beginning"
    assert first.low < 3900.0 < first.high


def test_error_location_lists_what_real_drives_lack():
    leaf = diagnose_car("ved").diagnosis.error_location
    assert {"elevation", "wind", "climate power"} <= set(leaf.absent_signals)
    assert leaf.absent_kinds == ("climbing",)
