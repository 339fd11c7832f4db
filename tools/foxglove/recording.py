"""The recording of a replay for Foxglove: the messages, the forecasts, and the topics for viewers."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from socast.core.errors import RecordingError
from socast.core.files import write_whole
from socast.core.wire.messages import Message, address
from socast.stream.closeable import Closeable
from socast.stream.mcap_writer import McapSink
from socast.stream.source import Source
from socast.tools.foxglove.layout import make_layout
from socast.tools.foxglove.topics import ViewerTopics


class FoxgloveRecording(Closeable):
    """Write what is replayed as it is, and beside it, for viewers only, forecasts, positions and warnings.

    The readers of socast leave out what is for viewers, so that a replay of this recording equals one of the original.

    Parameters
    ----------
    sink : McapSink
        Writer of the recording, with the schemas of `socast.tools.foxglove.schemas`.
    """

    def __init__(self, sink: McapSink) -> None:
        self._sink = sink
        self._topics = ViewerTopics()
        self._cars: dict[str, None] = {}

    def record_source(self, source: Source) -> Iterator[Sequence[Message]]:
        """Yield the messages of a source, after they are recorded."""
        for messages in source:
            self._sink.put(messages)
            self._sink.put(self._topics.make_messages([each for each in messages if _is_input(each)]), for_viewers=True)
            yield messages

    def put(self, messages: Sequence[Message]) -> None:
        """Record forecasts and errors of models for viewers."""
        self._sink.put([*messages, *self._topics.make_messages(messages)], for_viewers=True)
        for key in {message.key for message in messages}:
            known = address(key)
            if known and known.kind == "forecast":
                self._cars[key.rpartition("/")[0]] = None

    def close(self) -> None:
        """Write the summary and close the file; a second call has no effect."""
        self._sink.close()

    def write_layout(self, path: Path) -> None:
        """Write a layout that shows the cars of the recording."""
        text = json.dumps(make_layout(sorted(self._cars)), indent=2) + "\n"
        try:
            write_whole(path, text.encode())
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}; make room") from error


def _is_input(message: Message) -> bool:
    """Return whether a message is no forecast of an earlier run."""
    known = address(message.key)
    return known is not None and known.kind != "forecast"
