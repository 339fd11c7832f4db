"""The keys of received samples: as numbers for the consumer, and as declared key expressions for its session."""

from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import zenoh

_MOST_KEYS, _MOST_CHARACTERS, _LONGEST_KEY = 100_000, 1 << 23, 512  # that are remembered as text
_FORGET: Final = ""
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
    """Declare keys of samples to a session, from a thread of its own.

    A client of a router compares each sample of a key that is not declared with every key that it knows, such as those
    of the tokens of publishers: 0.2 ms for 1,000 cars (zenoh 1.10). A declaration waits for samples that are being
    delivered, and these may wait for the thread that takes samples, which must therefore not make it.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._todo: SimpleQueue[str | None] = SimpleQueue()
        self._thread: Thread | None = None

    def add(self, key: str) -> None:
        """Let a key be declared; return at once."""
        if self._thread is None:
            self._thread = Thread(target=self._work, name="zenoh-keys", daemon=True)
            self._thread.start()
        self._todo.put(key)

    def forget(self) -> None:
        """Let all keys be undeclared; return at once."""
        self._todo.put(_FORGET)

    def close(self) -> None:
        """Declare no more; the keys remain declared until the session ends. A second call has no effect."""
        self._todo.put(None)
        if self._thread is not None:
            self._thread.join(END_S)

    def _work(self) -> None:
        """Declare keys until the end of the declarer or of the session."""
        declared: list[Any] = []
        with suppress(zenoh.ZError):
            while (key := self._todo.get()) is not None:
                if key == _FORGET:
                    while declared:
                        self._session.undeclare(declared.pop())
                else:
                    declared.append(self._session.declare_keyexpr(key))
