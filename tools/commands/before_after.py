"""Run `socast before-after`: estimate whether a repair or another campaign changed the consumption of cars."""

from collections.abc import Mapping
from datetime import date
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Final, TextIO

import pandas as pd
import typer

from socast.core.condition.before_after import LEAST_CAMPAIGN_KWH, compare_before_after
from socast.core.condition.campaign import LEAST_DAYS, SIZES, Campaign, CampaignSpan
from socast.core.condition.campaign_records import BeforeAfter
from socast.core.condition.car_days import gather_car_days, list_car_day_columns, select_car_day_columns
from socast.core.diagnose.inference.csv_file import read_csv
from socast.core.errors import SettingsError
from socast.core.evaluate.compare.models import select_rides
from socast.core.models import LinearModel
from socast.core.settings import Settings
from socast.tools.commands.spikein import parse_size
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options
from socast.tools.terminal.model_comparison import load_as_given
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import (
    EffectFiles,
    HtmlFile,
    JsonFile,
    ModelName,
    parse_date,
    refuse,
    split_names,
    write_json,
)
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import Rides, RideSource

OPTIONS: Final[Mapping[str, str]] = MappingProxyType(
    {name: f"--{name}" for name in ("vehicles", "at", "until", "days", "toggle", "plan")}
)
"""Parameter of a campaign -> what the command line calls it in messages."""
VEHICLE = "vehicle_id"
SPANS = (("begin", "end"), ("from", "to"))
"""Columns of a file of days on; the last day is on too, and may be empty for days on until the end."""


def make_source(
    *, rides: Rides, effects_file: EffectFiles = None, settings: Settings, elevation: ElevationFiles = None
) -> RideSource:
    """Return the source of rides; here `--vehicles` names cars, so data sheets of cars are loaded with the tables."""
    return RideSource(rides, settings, elevation or (), effects_file or ())


@insert_options("source", insert_cleaning_options(make_source))
def compare(
    *,
    source: RideSource,
    model: ModelName,
    vehicles: Annotated[
        str | None, typer.Option(metavar="A,B", help="Cars that were repaired. Default: those of --toggle.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="DATE", help="UTC date of the repair, such as 2018-11-20; it is left out.")
    ] = None,
    until: Annotated[str | None, typer.Option(metavar="DATE", help="Last UTC date that counts.")] = None,
    days: Annotated[
        int | None, typer.Option(metavar="N", min=LEAST_DAYS, help="Count only N days before and N days after.")
    ] = None,
    toggle: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="Instead of --at: days on, in columns vehicle_id,begin,end."),
    ] = None,
    what: Annotated[str, typer.Option(metavar="TEXT", help='What was done, such as "new tyres".')] = "",
    plan: Annotated[
        str | None,
        typer.Option(metavar="SHARE", help="Say too how long it takes to see a change of this size, such as 3%."),
    ] = None,
    html_file: HtmlFile = None,
    json_file: JsonFile = None,
) -> None:
    """Estimate whether the consumption of cars changed on a date, at equal conditions.

    The measure is measured over predicted energy of each day, less that of the other cars of the same vehicle model on
    the same dates. Placebo campaigns, which are the same estimate for other cars and dates, show what chance does, and
    widen the interval where it does more than the model of the noise says.

    With --at after the last rides, or --plan without --at, it says how long a change will take to be seen.

    Examples
    --------
    socast before-after tables --model fitted.json --vehicles taxi-005 --at 2018-11-20 --what "new tyres"
    socast before-after tables --model fitted.json --vehicles taxi-005,taxi-007 --plan 3%
    socast before-after tables --model fitted.json --toggle eco-mode.csv --html eco-mode.html
    """
    source.check(json_file, html_file, models=[model], also=[toggle] if toggle else [])
    campaign = read_campaign(vehicles, at, until, days, toggle, what, plan)
    loaded = load_as_given(model)
    result = evaluate_campaign(source.read_rides(loaded.effects, list_car_day_columns(loaded)), loaded, campaign)
    write_json(json_file, "before-after", result)
    show_report("before_after", result, html_file, json_file)


def evaluate_campaign(rides: pd.DataFrame, model: LinearModel, campaign: Campaign) -> BeforeAfter:
    """Return what a campaign changed; one without a date and days on is planned for the day after the last rides."""
    compared = select_rides(select_car_day_columns(rides, model), {model.name: model})
    car_days = gather_car_days(compared, model.name, LEAST_CAMPAIGN_KWH)
    if campaign.at is None and not campaign.spans:
        campaign = campaign._replace(at=int(car_days.consumption.dates[-1]) + 1)
    return compare_before_after(car_days, campaign, model.name)


def read_campaign(
    vehicles: str | None,
    at: str | None,
    until: str | None = None,
    days: int | None = None,
    toggle: Path | TextIO | None = None,
    what: str = "",
    plan: str | None = None,
    names: Mapping[str, str] = OPTIONS,
) -> Campaign:
    """Return the campaign that the parameters describe; messages call them by `names`.

    `toggle` may also be an open file.
    """
    cars = split_names(vehicles)
    sizes = tuple(sorted({*SIZES, *([parse_size(plan)] if plan else [])}))
    if toggle is not None:
        if beside := [names[name] for name, value in {"at": at, "until": until, "days": days}.items() if value]:
            raise SettingsError(
                f"{beside[0]} is given with {names['toggle']}, which holds all dates; leave one of them out"
            )
        spans = read_spans(toggle, cars, names["toggle"])
        return Campaign(
            cars or tuple(dict.fromkeys(span.vehicle_id for span in spans)), None, None, None, spans, what, sizes
        )
    refuse(
        (not cars, f"the cars that were repaired are not named ({names['vehicles']}): give them, such as taxi-005"),
        (
            at is None and plan is None,
            f"the date of the repair is missing ({names['at']}): give it, such as 2018-11-20"
            + (f", or a size to plan for ({names['plan']} 3%)" if "plan" in names else ""),
        ),
    )
    first, last = (
        None if each is None else parse_date(name, each).toordinal()
        for name, each in ((names["at"], at), (names["until"], until))
    )
    if last is not None and (first is None or last <= first):
        raise SettingsError(
            f"{names['until']} is {until}, and must be after {names['at']}{f', {at}' if at else ''}: give a later date"
        )
    return Campaign(cars, first, last, days, (), what, sizes)


def read_spans(file: Path | TextIO, cars: tuple[str, ...] = (), name: str = "") -> tuple[CampaignSpan, ...]:
    """Return the days on of a CSV file; without a column of vehicles, they are those of all cars of the campaign.

    Messages call an open file by its `name`.
    """
    path = file if isinstance(file, Path) else name
    table = read_csv(file, str(path))
    columns = next((pair for pair in SPANS if set(pair) <= set(table)), None)
    if columns is None:
        raise SettingsError(
            f"{path} has the columns {', '.join(map(str, table))}: its header must be {VEHICLE},begin,end, or "
            "begin,end with --vehicles"
        )
    if VEHICLE not in table and not cars:
        raise SettingsError(
            f"{path} has no column {VEHICLE}, and no cars are named: give them with --vehicles, such as taxi-005, or "
            "add the column"
        )
    spans = []
    for line, row in enumerate(table.to_dict("records"), start=2):
        begin = parse_date(f"{path}, line {line}: {columns[0]}", row[columns[0]]).toordinal()
        end = row[columns[1]].strip()
        last = parse_date(f"{path}, line {line}: {columns[1]}", end).toordinal() if end else date.max.toordinal()
        if last < begin:
            raise SettingsError(f"{path}, line {line}: the end {end} is before the begin {row[columns[0]]}; swap them")
        named = [row[VEHICLE].strip()] if VEHICLE in table else cars
        spans += [CampaignSpan(car, begin, last) for car in named if not cars or car in cars]
    if not spans:
        raise SettingsError(f"{path} holds no days on of {', '.join(cars) or 'any car'}: add a line for each period")
    return tuple(spans)
