"""The loop makes the same forecasts for every source, records every message, and closes every sink."""

import gc
import io
import json
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from threading import Event

import pytest

from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream.loop import collect_garbage_rarely, run
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.memory import MemorySink, MemorySource
from socast.stream.recorder import Recorder, list_recordings
from socast.stream.source import stop_source
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_source import ZenohSource
from socast.tools.terminal.stop_signals import stop_on_signals
from tests.support.recorded_shift import shift
from tests.support.signal_handlers import ASKING, keep_handlers

pytestmark = pytest.mark.long
Results = tuple[list[Message], list[Message], str]


def make_pipeline(models) -> Pipeline:
    first, *shadows = models
    return Pipeline(first, shadows=shadows)


def collect_results(sink: MemorySink, pipeline: Pipeline) -> Results:
    """Return the forecasts, the errors of models, and the rides."""
    forecasts = [message for message in sink.messages if message.key.endswith("/forecast")]
    errors = [message for message in sink.messages if message.key.startswith("models/")]
    assert len(forecasts) + len(errors) == len(sink.messages)
    return forecasts, errors, pipeline.take_rides().to_json()


def run_loop(source, models) -> Results:
    """Run the loop over a source and return its results."""
    pipeline, sink = make_pipeline(models), MemorySink()
    tally = run(source, pipeline, [sink])
    assert sink.closed
    results = collect_results(sink, pipeline)
    assert (tally.forecasts, tally.model_errors) == (len(results[0]), len(results[1]))
    return results


@pytest.fixture(scope="module", params=[1, 2], ids=["one model", "and a shadow"])
def models(request):
    return (EXTENDED_PHYSICAL, BASIC_PHYSICAL)[: request.param]


@pytest.fixture(scope="module")
def reference(models) -> Results:
    results = run_loop(MemorySource(shift()), models)
    assert len(results[0]) > 50
    assert len(results[1]) == (2 * (9 + 1) if len(models) > 1 else 0)  # after each ride, and after the last day
    return results


@pytest.mark.parametrize("chunk", [1, 7, 100_000])
def test_size_of_lists_never_changes_results(reference, models, chunk):
    assert run_loop(MemorySource(shift(), chunk), models) == reference


def test_replay_gives_same_results_as_memory(reference, models, tmp_path: Path):
    with McapSink(tmp_path / "shift.mcap", 10_000) as sink:
        sink.put(shift())
    assert run_loop(McapSource(tmp_path / "shift.mcap"), models) == reference


def test_errors_of_models_are_recorded_with_their_schema(tmp_path: Path):
    run(MemorySource(shift()), make_pipeline([EXTENDED_PHYSICAL, BASIC_PHYSICAL]), [McapSink(tmp_path / "out.mcap")])
    source = McapSource(tmp_path / "out.mcap")
    kept = [message for block in source for message in block if message.key.startswith("models/")]
    assert {message.key for message in kept} == {
        "models/extended_physical/1/errors",
        "models/basic_physical/1/errors",
    }
    assert source.schemas["models/basic_physical/1/errors"] == "ModelErrors"
    last = json.loads(kept[-1].payload)
    assert last["overall"]["rides"] == last["overall"]["gain"]["rides"] == 9
    assert kept[-1].receipt_ns == int(last["time_s"] * 1e9)


def test_publish_period_limits_errors_to_newest_of_each_model():
    sink, now = MemorySink(), [0.0]

    def watch(_):
        now[0] += 0.5

    pipeline = make_pipeline([EXTENDED_PHYSICAL, BASIC_PHYSICAL])
    run(MemorySource(shift(), 1), pipeline, [sink], publish_s=200.0, watch=watch, clock=lambda: now[0])
    rides = [
        json.loads(message.payload)["overall"]["rides"] for message in sink.messages if "models/basic" in message.key
    ]
    assert rides == [3, 6, 9]


PUBLISH = """
import sys, time
from socast.stream.mcap_reader import McapSource
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_session import Connection, Node
with Node(Connection(connect=(sys.argv[1],))) as node:
    sink = ZenohSink(node)
    deadline = time.monotonic() + 20
    while not sink.has_subscriber() and time.monotonic() < deadline:
        time.sleep(0.01)
    for block in McapSource(sys.argv[2]):
        sink.put(block)
    sink.close()
"""


def test_live_over_zenoh_and_its_recording_give_same_results_as_memory(reference, models, tmp_path: Path):
    sent, stop = shift(), Event()
    with McapSink(tmp_path / "shift.mcap") as sink:
        sink.put(sent)
    recorder, pipeline, sink = Recorder(tmp_path / "live"), make_pipeline(models), MemorySink()
    deadline = time.monotonic() + 30
    with Node(Connection(listen=("tcp/127.0.0.1:0",))) as node:
        source = ZenohSource(node, stop)
        with subprocess.Popen([sys.executable, "-c", PUBLISH, node.endpoints[0], tmp_path / "shift.mcap"]) as publisher:

            def watch(tally) -> None:
                if tally.received >= len(sent) or time.monotonic() > deadline:
                    stop.set()

            tally = run(source, pipeline, [sink], recorder=recorder, watch=watch)
            assert publisher.wait(10) == 0
    assert (tally.received, tally.missed) == (len(sent), 0)
    assert collect_results(sink, pipeline) == reference
    (file,) = recorder.files
    again = [m for block in McapSource(file) for m in block]
    once = dict.fromkeys((m.key, m.payload) for m in sent)  # the loggers send some samples twice
    assert [(m.key, m.payload) for m in again] == list(once)
    assert run_loop(McapSource(file), models) == reference


class BreakingPipeline:
    """A pipeline that raises an error at the third list."""

    def __init__(self) -> None:
        self.seen = 0
        self.due = []

    def take(self, messages, record=None):
        if record:
            record(messages)
        self.seen += 1
        if self.seen == 3:
            raise ZeroDivisionError
        self.due += [Message("fleet/a/forecast", b"{}", m.receipt_ns) for m in messages]

    def forecasts(self, *, newest_only=False):
        due, self.due = self.due, []
        return due[-1:] if newest_only else due

    def model_errors(self, **_):
        return []

    def finish(self):
        return [Message("fleet/a/forecast", b"the last", 0)]

    def quality(self):
        return {}


def test_message_that_breaks_pipeline_is_recorded_and_sinks_are_closed(tmp_path: Path):
    sent, sink = shift(20), MemorySink()
    with pytest.raises(ZeroDivisionError):
        run(MemorySource(sent, 10), BreakingPipeline(), [sink], recorder=Recorder(tmp_path))
    (file,) = list_recordings(tmp_path)
    source = McapSource(file)
    assert [m for block in source for m in block] == sent[:30]
    assert not source.losses
    assert sink.closed
    assert len(sink.messages) == 20


def test_sinks_receive_last_forecasts():
    sink = MemorySink()
    tally = run(MemorySource(shift(2), 100), BreakingPipeline(), [sink])
    assert sink.messages[-1].payload == b"the last"
    assert tally.forecasts == len(sink.messages)
    assert tally.received == len(shift(2))


def run_and_read_log(source=None, *, as_json: bool, **settings) -> list[str]:
    text = io.StringIO()
    log_lines(as_json=as_json, to=text)
    try:
        run(source or MemorySource(shift(50), 40), Pipeline(), **settings)
    finally:
        logging.getLogger("socast").handlers.clear()
        logging.getLogger("socast").propagate = True
        logging.getLogger("socast").setLevel(logging.NOTSET)
    return text.getvalue().splitlines()


def test_counters_are_logged_periodically_and_at_end():
    ticks = iter(range(10_000))
    logged = [
        json.loads(line) for line in run_and_read_log(as_json=True, report_s=5.0, clock=lambda: float(next(ticks)))
    ]
    assert [line["event"] for line in logged[:-1]] == ["running"] * (len(logged) - 1)
    assert len(logged) > 1
    last = logged[-1]
    assert last["event"] == "finished"
    assert last["messages"] == len(shift(50))
    assert last["received.weather"] == 1
    assert sum(count for name, count in last.items() if name.startswith("undecodable.")) == 1
    assert last["missed"] == 0


def test_rate_is_that_since_the_last_line_and_drops_are_told():
    class Source(list):
        missed, dropped = None, {"stop": 3}

    ticks = iter(range(1000))
    source = Source([shift(50)[:40], [], []])
    lines = run_and_read_log(source, as_json=True, report_s=1.0, clock=lambda: float(next(ticks)))
    logged = [json.loads(line) for line in lines]
    assert [line["messages"] for line in logged] == [40] * 4
    assert logged[0]["per_second"] > logged[1]["per_second"] == logged[2]["per_second"] == 0.0
    assert {(line["recovery"], line["dropped.stop"], line.get("missed")) for line in logged} == {("off", 3, None)}


def test_log_line_holds_keys_and_values():
    (line,) = run_and_read_log(as_json=False)
    pairs = dict(pair.split("=", 1) for pair in line.split(" "))
    assert pairs["level"] == "info"
    assert pairs["event"] == "finished"
    assert int(pairs["messages"]) == len(shift(50))


@pytest.fixture(autouse=True)
def handlers():
    """Return to the handlers of signals of before."""
    with keep_handlers():
        yield


@pytest.mark.parametrize("number", ASKING)
def test_signal_ends_source_and_loop_finishes_normally(number):
    sink = MemorySink()
    with stop_on_signals() as stop:

        def watch(tally) -> None:
            if tally.received == 10:
                os.kill(os.getpid(), number)

        tally = run(stop_source(MemorySource(shift(20), 5), stop), WorkingPipeline(), [sink], watch=watch)
    assert tally.received == 10
    assert sink.messages[-1].payload == b"the last"
    os.kill(os.getpid(), number)  # one that comes late changes nothing


class WorkingPipeline(BreakingPipeline):
    """The same pipeline without the error."""

    def take(self, messages, record=None):  # noqa: ARG002
        self.due += [Message("fleet/a/forecast", b"{}", m.receipt_ns) for m in messages]


def test_publish_period_limits_forecasts_and_end_publishes_last_ones():
    sent, sink, now = shift(20), MemorySink(), [0.0]

    def watch(_):
        now[0] += 0.05

    run(MemorySource(sent, 1), WorkingPipeline(), [sink], publish_s=0.2, watch=watch, clock=lambda: now[0])
    times = [m.receipt_ns for m in sink.messages[:-1]]
    assert times[0] == sent[0].receipt_ns
    assert times[-1] == sent[-1].receipt_ns
    assert len(sent) / 5 <= len(times) <= len(sent) / 4 + 2
    assert times == sorted(times)


def test_garbage_collector_visits_no_object_from_before_the_loop():
    thresholds, generations = gc.get_threshold(), []

    def note(_, info):
        generations.append(info["generation"])

    gc.collect()  # no other full collection is due for a while
    gc.callbacks.append(note)
    try:
        with collect_garbage_rarely():
            assert gc.get_freeze_count() > 10_000
            assert gc.get_threshold() > thresholds
            with collect_garbage_rarely():
                pass
            assert gc.get_threshold() > thresholds  # the outer loop runs on
    finally:
        gc.callbacks.remove(note)
    assert 2 not in generations
    assert (gc.get_freeze_count(), gc.get_threshold()) == (0, thresholds)
