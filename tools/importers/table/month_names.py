"""Find months by their names and abbreviations, in the languages in which loggers and phones write them."""

import unicodedata
from collections.abc import Mapping
from functools import cache
from typing import Final

_STEMS: Final = (
    "jan gen ene ian jaan led sty tammi oca sau xan urt yan sij ιαν янв яну јан січ сту",
    "feb fev feu unor uno lut helmi sub febr vas veebr ots velj φεβ фев феб лют",
    "mar mrt marc maa maer brez bre maalis kov ozu μαρ мар бер сак",
    "apr avr abr avril dub kwi huhti nis bal ebr api trav tra απρ апр кві кра",
    "may mai maj mei mag kve touko maig geg svi μαι май маи мая мај тра",
    "jun juin giu cze cvn cervn cerven kesa haz iun juun xun birz eka lipanj lipnj ιουν июн юни јун чер чэр",
    "jul juil lug lip cvc cervenc cervenec heina tem iul juul liep xul uzt srpanj srpnj ιουλ июл юли јул лип ліп",
    "aug ago agost aou avg agu sie srp elo ogo rugp abu kolo αυγ авг сер жні",
    "sep set wrz zar syys szep rugs eyl ira ruj σεπ сен сеп вер",
    "oct okt ott out paz rij loka eki spal urr οκτ окт жов кас",
    "nov lis marras kas noi lapkr aza noy studen νοε ноя ное нов лис ліс",
    "dec dez dic des dek pro gru joulu ara det dis gruod abe δεκ дек дец гру сне",
)
"""First letters of the names of each month, without accents, in some thirty languages; the longest that fits counts."""
_SHORT: Final[Mapping[str, int]] = {"ag": 8, "kol": 8, "stu": 11}
"""Abbreviations that are no first letters of others."""
_DOUBTFUL: Final[Mapping[str, str]] = {
    "lip": "July in Polish, June in Croatian",
    "srp": "August in Czech, July in Croatian",
    "lis": "November in Polish and Czech, October in Croatian",
}
"""First letters of names that mean two months: what they are read as, and what else they mean."""
_LETTERS: Final = str.maketrans({"ł": "l", "ø": "o", "ß": "ss", "ı": "i", "đ": "d", "æ": "ae"})
_LONGEST: Final = 14
"""Letters of the longest name of a month."""


@cache
def find_month(word: str) -> int | None:
    """Return the number of the month that a word names, None where it names none.

    Examples
    --------
    >>> [find_month(word) for word in ("ago.", "Mär", "DÉC.", "août", "červenec", "lunes")]
    [8, 3, 12, 8, 7, None]
    """
    plain = fold_word(word)
    if plain in _SHORT or len(plain) > _LONGEST:
        return _SHORT.get(plain)
    fits = [
        (len(stem), month)
        for month, stems in enumerate(_STEMS, start=1)
        for stem in stems.split()
        if plain.startswith(stem)
    ]
    return max(fits)[1] if fits else None


def describe_doubt(word: str) -> str:
    """Return what a month means in two languages, empty where it means the same in all.

    Examples
    --------
    >>> describe_doubt("lis."), describe_doubt("lug")
    ('November in Polish and Czech, October in Croatian', '')
    """
    plain = fold_word(word)
    return _DOUBTFUL.get(plain[:3], "") if plain in {*_DOUBTFUL, "listopad", "listopada"} else ""


def fold_word(word: str) -> str:
    """Return a word in small letters, without accents and points.

    Examples
    --------
    >>> fold_word("Févr.")
    'fevr'
    """
    apart = unicodedata.normalize("NFKD", word.casefold().translate(_LETTERS))
    return "".join(letter for letter in apart if letter.isalpha())
