"""`socast check`: show what the logger of each car sends wrong, how often, and what that costs."""

import pandas as pd

from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.totals.logger_faults import list_facts
from socast.core.totals.run_counters import CarCounters
from socast.stream.elevation_files import open_elevation
from socast.stream.source import merge_sources
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options
from socast.tools.terminal.fault_report import (
    RIDE_COLUMNS,
    choose_next_step,
    describe_car,
    find_mean_powers,
    report_cars,
    show_cars,
)
from socast.tools.terminal.output import JsonFile, VehicleFiles, check_outputs, make_console, write_json
from socast.tools.terminal.recordings import Recordings, open_recordings, warn_of_losses
from socast.tools.terminal.ride_source import tabulate


@insert_cleaning_options
def check(
    recordings: Recordings,
    *,
    vehicles: VehicleFiles = None,
    settings: Settings,
    elevation: ElevationFiles = None,
    json_file: JsonFile = None,
) -> None:
    """Show what the logger of each car sends wrong, how often, and what that costs.

    The recordings are cleaned as `socast tables` cleans them. The page is for makers of loggers, and for a first look
    at new data.

    Examples
    --------
    socast check recordings/shift.mcap
    socast check kept/*.mcap --json - | jq '.cars[] | select(.is_clean | not).vehicle_id'
    """
    sources = open_recordings(recordings)
    check_outputs([*recordings, *(vehicles or ()), *(elevation or ())], json_file)
    pipeline = Pipeline(
        settings=settings, keep_forecasts=False, two_sided=True, elevation_map=open_elevation(elevation or ())
    )
    pipeline.totals.counters = counters = CarCounters()
    rides: list[pd.DataFrame] = []
    tabulate(sources, pipeline, lambda ended, _: rides.append(ended[list(RIDE_COLUMNS)]))
    names = pipeline.lanes.names
    facts = list_facts(pipeline.quality()["logger_faults"])
    messages = [pipeline.cars.messages[kind] for kind in pipeline.cars.of_lane.tolist()]
    announced = {name for name, about in zip(names, messages, strict=False) if about and about.power_covers is not None}
    for name, fact in find_mean_powers(merge_sources(sources), announced).items():
        facts.setdefault(name, []).append(fact)
    cars = report_cars(names, *counters.list_cars(len(names)), pd.concat(rides, ignore_index=True), facts)
    cars = [car for car in cars if car.samples]
    undecodable = dict(sorted(pipeline.quality()["undecodable"].items()))
    step = choose_next_step(cars)
    lost = {str(source.path): source.losses.lines() for source in sources if source.losses}
    report = {"cars": [describe_car(car) for car in cars], "undecodable": undecodable, "lost": lost, "next_step": step}
    write_json(json_file, "check", report)
    console = make_console(json_file)
    show_cars(cars, console)
    if undecodable:
        causes = ", ".join(f"{cause.replace('_', ' ')} {count:,}" for cause, count in undecodable.items())
        console.print(f"Payloads that cannot be read: {causes}.", markup=False, highlight=False)
    console.print(step, style="bold", markup=False, highlight=False)
    warn_of_losses(sources)
