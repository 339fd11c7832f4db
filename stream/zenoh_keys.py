"""The keys of received samples: as numbers for the consumer, and as declared key expressions for its session."""

from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import zenoh

from socast.core.wire.messages import BATCH

_MOST_KEYS, _MOST_CHARACTERS, _LONGEST_KEY = 100_000, 1 << 23, 512  # that are remembered as text
_FREQUENT: Final = "/telemetry", f"/{BATCH}", "/forecast"  # ends of the keys that are declared
MOST_DECLARED: Final = 1 << 14
"""Largest number of keys that are declared in the life of a session, see `KeyDeclarer`."""
END_S: Final = 1.0
"""Longest wait for a declaration at the end. [s]"""


class SampleKeys(dict[Any, int]):
    """Number the key expressions of messages, and make the text of each only once; forecasts, no input, have -1.

    Parameters
    ----------
    declare : callable
        Function that receives each new key that is remembered.

    Attributes
    ----------
    texts : list of str
        Text of each number. Once there are many, another list begins, and blocks of messages hold the one before.
    """

    def __init__(self, declare: Callable[[str], None] = lambda _: None) -> None:
        self.texts: list[str] = []
        self._characters = 0
        self._declare = declare

    def __missing__(self, key: Any) -> int:
        text = str(key)
        number = -1 if text.endswith("/forecast") else len(self.texts)
        if number >= 0:
            self.texts.append(text)
            self._characters += len(text)
        if len(text) <= _LONGEST_KEY:
            self[key] = number
            self._declare(text)
        return number

    def find_text(self, key: Any) -> str:
        """Return the text of a key expression; an empty one for forecasts."""
        return self.texts[number] if (number := self[key]) >= 0 else ""

    def begin_list_if_full(self) -> bool:
        """Begin another list of texts where there are many, as strangers may make up keys; return whether it begins."""
        is_full = len(self) >= _MOST_KEYS or self._characters >= _MOST_CHARACTERS
        if is_full:
            self.clear()
            self.texts, self._characters = [], 0
        return is_full


class KeyDeclarer:
    """Declare keys of frequent samples to a session, from a thread of its own.

    A client of a router compares each sample of a key that is not declared with every key that it knows, such as those
    of the tokens of publishers: 0.2 ms for 1,000 cars (zenoh 1.10). A declaration waits for samples that are being
    delivered, and these may wait for the thread that takes samples, which must therefore not make it.

    Zenoh numbers the declarations of a session with 16 bits. After 65,535 of them, though undeclared meanwhile, it
    gives numbers again and delivers samples with the key of another car. A declaration also costs more, the more keys
    are declared. Only the first `MOST_DECLARED` are therefore declared, as strangers may make up keys.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._left = MOST_DECLARED
        self._todo: SimpleQueue[str | None] = SimpleQueue()
        self._declared: list[Any] = []  # a key that nobody holds is undeclared
        self._thread: Thread | None = None

    def add(self, key: str) -> None:
        """Let a key be declared if its samples are frequent; return at once."""
        if not self._left or not key.endswith(_FREQUENT):
            return
        self._left -= 1
        if self._thread is None:
            self._thread = Thread(target=self._work, name="zenoh-keys", daemon=True)
            self._thread.start()
        self._todo.put(key)

    def close(self) -> None:
        """Declare no more; the keys remain declared until the session ends. A second call has no effect."""
        self._left = 0
        self._todo.put(None)
        if self._thread is not None:
            self._thread.join(END_S)

    def _work(self) -> None:
        """Declare keys until the end of the declarer or of the session."""
        with suppress(zenoh.ZError):
            while (key := self._todo.get()) is not None:
                self._declared.append(self._session.declare_keyexpr(key))
