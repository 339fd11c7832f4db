"""Hash many texts of one buffer by XXH64, without an object per text.

References
----------
Collet, Y., xxHash fast digest algorithm, specification 0.2.0, section XXH64,
https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md.
"""

from typing import Any

import numpy as np

from socast.core.compiled_cache import njit

_P1, _P2, _P3, _P4, _P5 = (
    np.uint64(prime)
    for prime in (
        0x9E3779B185EBCA87,
        0xC2B2AE3D27D4EB4F,
        0x165667B19E3779F9,
        0x85EBCA77C2B2AE63,
        0x27D4EB2F165667C5,
    )
)


@njit(error_model="numpy", inline="always")
def _rotate(value: Any, bits: int) -> Any:
    """Rotate a word to the left."""
    return (value << np.uint64(bits)) | (value >> np.uint64(64 - bits))


@njit(error_model="numpy", inline="always")
def _add(lane: Any, word: Any) -> Any:
    """Return a lane after a word."""
    return _rotate(lane + word * _P2, 31) * _P1


@njit(error_model="numpy", inline="always")
def _merge(mixed: Any, lane: Any) -> Any:
    """Return a hash with a lane."""
    return (mixed ^ _add(np.uint64(0), lane)) * _P1 + _P4


@njit(error_model="numpy", inline="always")
def _mix_end(mixed: Any) -> Any:
    """Let every bit of a hash depend on all of them."""
    mixed = (mixed ^ (mixed >> np.uint64(33))) * _P2
    mixed = (mixed ^ (mixed >> np.uint64(29))) * _P3
    return mixed ^ (mixed >> np.uint64(32))


@njit(cache=True, error_model="numpy")
def hash_texts(text: Any, words: Any, starts: Any, sizes: Any, seeds: Any, out: Any) -> None:
    """Write the hash of each text.

    Units: starts [B], sizes [B].
    """
    for i in range(len(starts)):
        at, stop, seed = starts[i], starts[i] + sizes[i], seeds[i]
        if sizes[i] >= 32:
            first, second, third, fourth = seed + _P1 + _P2, seed + _P2, seed, seed - _P1
            while at + 32 <= stop:
                first, second = _add(first, words[at]), _add(second, words[at + 8])
                third, fourth = _add(third, words[at + 16]), _add(fourth, words[at + 24])
                at += 32
            mixed = _rotate(first, 1) + _rotate(second, 7) + _rotate(third, 12) + _rotate(fourth, 18)
            mixed = _merge(_merge(_merge(_merge(mixed, first), second), third), fourth)
        else:
            mixed = seed + _P5
        mixed += np.uint64(sizes[i])
        while at + 8 <= stop:
            mixed = _rotate(mixed ^ _add(np.uint64(0), words[at]), 27) * _P1 + _P4
            at += 8
        if at + 4 <= stop:
            half = words[at] & np.uint64(0xFFFFFFFF)
            mixed = _rotate(mixed ^ (half * _P1), 23) * _P2 + _P3
            at += 4
        while at < stop:
            mixed = _rotate(mixed ^ (np.uint64(text[at]) * _P5), 11) * _P1
            at += 1
        out[i] = _mix_end(mixed)
