"""Write the results of the league as tables: for the terminal and for the documentation."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Final, NamedTuple

from socast.tools.bench.figures.published import write_table
from socast.tools.bench.league.faults import FAULTS
from socast.tools.bench.league.fleet import CONTROL, DRIVES
from socast.tools.bench.league.laws import AMOUNTS, ODD, UNFIT, WORDS, WRONG, Verdict

REASONS: Final = 3
"""Number of reasons that are named in a line."""


class Line(NamedTuple):
    """Hold what became of the drives with the same faults."""

    name: str
    meaning: str
    drives: int
    words: Counter[str]
    reasons: Counter[str]
    wrong: list[Verdict]


def summarise(name: str, meaning: str, verdicts: Sequence[Verdict]) -> Line:
    """Return the line of some drives."""
    reasons = Counter(each.why for each in verdicts if each.word in {UNFIT, ODD})
    wrong = [each for each in verdicts if each.word == WRONG]
    return Line(name, meaning, len(verdicts), Counter(each.word for each in verdicts), reasons, wrong)


def list_alone(verdicts: Sequence[Verdict]) -> list[Line]:
    """Return a line for each fault alone, and one for no fault."""
    groups = _group(verdicts)
    lines = [summarise(CONTROL, "A logger without a fault.", groups[()])]
    lines += [summarise(each.name, each.meaning, groups[(each.name,)]) for each in FAULTS.values()]
    return [line for line in lines if line.drives]


def list_pairs(verdicts: Sequence[Verdict], most: int) -> list[Line]:
    """Return a line for all pairs together, and for those pairs of which most drives are wrong."""
    groups = {key: each for key, each in _group(verdicts).items() if len(key) > 1}
    lines = [summarise(" + ".join(key), "", each) for key, each in groups.items()]
    worst = sorted((line for line in lines if line.wrong), key=lambda line: (-len(line.wrong), line.name))
    together = summarise("all pairs", "", [each for group in groups.values() for each in group])
    return [together, *worst[:most]] if together.drives else []


def _group(verdicts: Sequence[Verdict]) -> dict[tuple[str, ...], list[Verdict]]:
    """Return the drives by the faults of their car."""
    groups = defaultdict[tuple[str, ...], list[Verdict]](list)
    for each in verdicts:
        groups[each.faults].append(each)
    return groups


def show_shares(line: Line) -> list[str]:
    """Return the shares of a line in percent, by word; empty where there is none."""
    return [f"{100.0 * line.words[word] / line.drives:.1f}" if line.words[word] else "" for word in WORDS]


def show_reasons(line: Line) -> str:
    """Return the most frequent reasons of unfit rides, and what is wrong."""
    unfit = [f"{why} {count}" for why, count in line.reasons.most_common(REASONS)]
    wrong = [f"**{why} {n}**" for why, n in Counter(each.why for each in line.wrong).most_common(REASONS)]
    return ", ".join([*unfit, *wrong])


def name_drive(verdict: Verdict) -> int:
    """Return the number of a drive, as `--drive` takes it."""
    return verdict.car * DRIVES + verdict.drive


def compare(verdict: Verdict) -> str:
    """Return what was found of a drive beside the truth."""
    if not verdict.found:
        return "no ride"
    units = {"distance_km": "km", "energy_kwh": "kWh", "duration_s": "s"}
    parts = [
        f"{verdict.found[name]:.3f} of {verdict.truth[name][0]:.3f} to {verdict.truth[name][1]:.3f} {units[name]}"
        for name in AMOUNTS
    ]
    found = verdict.found
    parts.append(
        f"{found['rides']} rides by {'/'.join(found['source']) or 'nothing'} ± {found['energy_sd_kwh']:.3f} kWh"
    )
    parts += [" ".join(f"{bit}:{count}" for bit, count in found["bits"].items()), " ".join(found["unfit"])]
    return "; ".join(part for part in parts if part)


def make_lines(verdicts: Sequence[Verdict], seed: int, replayed: int, pairs: int) -> list[str]:
    """Return the lines for the page of the documentation."""
    total = summarise("all", "", verdicts)
    shares = zip(WORDS, show_shares(total), strict=True)
    alone = [[f"`{line.name}`", line.meaning, *list_cells(line)] for line in list_alone(verdicts)]
    two = [[line.name, *list_cells(line)] for line in list_pairs(verdicts, pairs)]
    return [
        f"{total.drives:,} drives of seed {seed}: {', '.join(f'{share or 0} % {word}' for word, share in shares)}.",
        f"The forecasts and tables of {replayed:,} drives are the same to the byte when their stream is cut at random.",
        "",
        "### Each fault alone",
        "",
        *write_table(["fault", "what the logger does", "drives", *WORDS, "reasons"], alone),
        "",
        "### Pairs",
        "",
        *write_table(["faults", "drives", *WORDS, "reasons"], two),
    ]


def list_values(verdicts: Sequence[Verdict]) -> dict[str, str]:
    """Return the share of drives that are fit and wrong, for the table of results."""
    total = summarise("all", "", verdicts)
    shares = dict(zip(WORDS, show_shares(total), strict=True))
    return {"wrong": f"{shares[WRONG] or 0} %", "wrong_on": f"{total.drives:,} simulated drives with faults"}


def list_cells(line: Line) -> list[str]:
    """Return the cells of a row after its name."""
    return [str(line.drives), *show_shares(line), show_reasons(line)]
