"""Write the card of exported data sets: what they are, their columns, how they were made, and how to be judged."""

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from socast.core import effects
from socast.tools.bench.hidden.judge import GOALS
from socast.tools.bench.hidden.parts import ABSORBED
from socast.tools.bench.hidden.visibility import RATIO

CONDITIONS: Final = MappingProxyType(
    {
        "ride": "number of the ride",
        "vehicle": "number of the car",
        "vehicle_model": "vehicle model",
        "day": "number of the vehicle-day; errors of different vehicle-days are independent",
        "start_s": "start of the window, seconds since 1970 [s]",
        "duration_s": "duration [s]",
        "average_speed_kmh": "mean speed [km/h]",
        "ambient_c": "outside temperature [°C]",
    }
)
"""Columns of a window besides energies."""

CARD: Final = """\
# Hidden effects in the energy of electric cars

{count} simulated data sets: {parts}.
In each, the energy of a small fleet holds an effect that the base model lacks, two of them, or none. The task: name the
missing effect from the measured energy.

## Files

- `cases.json`: description of each data set without its truth.
- `windows/NAME.parquet`: the windows of a data set. With voltage and current (`vi`) a window is about one minute, with
  the state of charge only (`soc`) a whole ride.
- `truth.json` and `truth/NAME.parquet`: what is hidden, its right names, and its energy in each window [kWh]. Only the
  judge may read them.

## Columns of the windows

| column | meaning |
|---|---|
{conditions}
| `measured_kwh` | measured energy [kWh] |
| `predicted_kwh` | energy that the base model predicts [kWh] |
| `base_TERM` | energy of a term of the base model [kWh per unit of its coefficient] |
| `effect_VARIANT` | energy of a candidate effect [kWh per unit of its coefficient] |

A candidate may have several variants, `EFFECT@PARAMETER=VALUE`. The answer is the name of the effect. Every data set
lacks the candidates of one effect at random, so a missing column says nothing about the truth. Cars whose base model is
`road_load_constant` have no climate control, and only heating or cooling of the cabin is hidden in them; a method must
not use that.

| effect | unit of the coefficient | power |
|---|---|---|
{effects}

## How it was made

A simulator drives 8 cars of 2 models on 39 days each over ten months, with weather, traffic, passengers and noisy
loggers. A hidden effect adds to the power of the cars, with a stated share of the energy, in one of three families of
shapes: linear ones as in the library, others that bend, saturate or lag, and random bends. The tables are those of the
product for the recorded messages. The base model is fitted to the data set that holds the effect.

`python -m socast.tools.bench.hidden --export DIR` in the repository of `socast` makes these files. The same options
make the same data.

## How to be judged

Write a JSON file with a ranking for each data set:

    {{"00000": ["snow", "wet_road"], "00001": []}}

The first name counts; of two effects, the first two. Answer `none` or an empty list where nothing is missing, and
`not in the library` where no candidate fits. Then run in the repository:

    python -m socast.tools.bench.hidden.judge DIR answers.json

It prints with Wilson intervals:

{goals}

An effect is *visible* if its true energy is at least {ratio:g} times more likely than the best form of every other
effect. Effects that the base model absorbs ({absorbed}) do not count.

## Licence

The data have the licence of the repository that made them: that of its file `LICENSE`. If there is none, ask the
authors before you pass the data on.
"""


def make_card(made: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the card of data sets, in Markdown."""
    parts = Counter(each["part"] for each in made.values())
    library = sorted(effects.get_library().items())
    return CARD.format(
        count=f"{len(made):,}",
        parts=", ".join(f"{count:,} of part `{part}`" for part, count in parts.items()),
        conditions="\n".join(f"| `{name}` | {what} |" for name, what in CONDITIONS.items()),
        effects="\n".join(f"| `{name}` | {effect.unit} | {_escape(effect.formula)} |" for name, effect in library),
        goals="\n".join(f"- {what}" for what in GOALS),
        ratio=RATIO,
        absorbed=", ".join(ABSORBED),
    )


def _escape(text: str) -> str:
    """Return text for a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|")
