"""Guess from its name which field of the wire contract a column or a signal holds, and in which unit."""

import re
import unicodedata
from typing import Final, NamedTuple

from socast.tools.importers.table.units import FIELD_UNITS, POWER, convertible, spell_unit

TIME: Final = "time"
OTHER_TIME: Final = "other time"
"""Role of a column that probably holds a time, used where no column of the role `TIME` does."""
VEHICLE: Final = "vehicle"
RIDE: Final = "ride"
STATE: Final = "state"
"""Role of a column that may say in words whether the car drives, is parked or charges."""
SIGNAL: Final = "signal"
VALUE: Final = "value"

_UNITS: Final = r"kwh|kw|mwh|kmh|kmph|kph|mph|mps|km/hr?|m/s|mi/h|kv|mv|ma|mah|°?deg[cf]|°[cf]"
_UNIT: Final = re.compile(_UNITS, re.IGNORECASE)
"""Unit that is a word of its own, in any spelling."""
_UNIT_AT_END: Final = re.compile(
    r"(.*?[a-z0-9)])(kWh|KWh|KWH|kW|KW|Kw|MWh|[Kk]mh|KMH|K[Mm]?ph|KPH|Mph|MPH|Mps|MPS|kV|KV|mAh|[dD]eg[CF]|°[CF])"
)
"""Word with a unit at its end, as its letters show."""
_OTHER_QUANTITIES: Final = frozenset({"wh", "kwh", "mwh", "ah", "mah", "rpm", "nm", "bar", "kpa", "psi"})
"""Units, in small letters, of nothing that is read: energy, charge, torque, pressure."""
_NOT_THE_PACK: Final = (
    r"\b(12 ?v|aux|auxiliary|cells?|charger|ac|grid|motor|engine|fan|phase|max|min|limit|limitation|device|wheel|heater"
    r"|hvac|maf|ptc|obd|module)\b"
)
_TIME_NAMES: Final = (
    r"^(time|date|datetime|date time|time ?stamp|utc|epoch|unix|unix time|ts|elapsed( time)?"
    r"|zeit|zeitstempel|uhrzeit|datum|temps|heure|horodatage|fecha|hora|tempo|data e ora|tijd|tijdstip"
    r"|(recorded|created|received|logged) at|m time utc)$"
    r"|\b(timestamp|date time)$"
)
_OTHER_TIME_NAMES: Final = (
    r"^(local|gps|device|log|sample|record|event|utc) ?(time|date ?time)$"
    r"|^(time|date ?time|date|time ?stamp) ?(utc|local|gmt)$"
    r"|^(t|uptime|millis(econds)?|ticks?|seconds|gps (week|tow|seconds)|i?tow|(gps )?time of week"
    r"|(gps )?week|week number|clock( time)?|time of day|tid|tidspunkt|dato|aika|cas|czas)$"
    r"|^(phone|server|host|pc|system|car|vehicle|logger|rel|relative|run|running|session|trip|phase|test|cycle) ?time"
    r"( (s|ms|us|min|h))?$"
    r"|^time since\b"
)
_SPEED_LETTERS: Final = r"^(v|gps|car|vehicle|obd)? ?(kmh|km/h|kph|kmph|mph)$|^v (m/s|mps)$"
_BATTERY: Final = r"(bat|batt|battery|pack|hv|traction|hv (batt|battery)|reess)"
"""Words for the traction battery; UN regulations and ISO standards call it REESS."""
_POWER_LETTERS: Final = rf"^(kw|(p|pwr) k?w|{_BATTERY}( p| pwr)? kw|{_BATTERY} (p|pwr)( k?w)?)$"
_AMBIENT: Final = (
    r"\b(outside|ambient|ext|external|exterior|outdoor|air|v e)\b.*\b(temp|temperature)\b|^oat\b|\bambient\b"
    r"|\b(aussentemperatur|umgebungstemperatur)\b|\btemp(erature)? amb\b|\bamb temp(erature)?\b"
)
_HVAC: Final = r"\b(hvac|climate|heating|heater|air ?con|air conditioning)\b.*\b(power|watts?)\b|\bhvac\b"
_NO_STATE: Final = r"\b(power|rate|current|voltage|kwh|energy|time|mode|dcfc|type)\b"
_WEATHER_RULES: Final = (
    (
        "wind_from_deg",
        r"\bwind ?(dir|direction|from|bearing|deg|degrees)\b|^(wdir|drct)$|\bwindrichtung\b",
        r"\b(relative|apparent|gust|gusts)\b",
    ),
    (
        "wind_speed_kmh",
        (
            r"\bwind ?(speed|spd|velocity)\b|^wind( (kmh|km/h|kph|mph|mps|m/s|kn|kt|kts))?$|^(wspd|sknt)$|"
            r"\bwindgeschwindigkeit\b"
        ),
        r"\b(relative|apparent|gust|gusts|max)\b",
    ),
    (
        "precipitation_mm",
        r"\b(precip|precipitation|rain|rainfall|niederschlag)\b|^(prcp|p01[im])$",
        r"\b(probability|chance|type|sensor|status|duration|flag|hours)\b",
    ),
    (
        "solar_w_m2",
        (
            r"\b(irradiance|insolation|ghi|globalstrahlung|pyranometer|(solar|global|shortwave) (radiation|rad))\b|"
            r"^solar( w/m2| w m2)?$"
        ),
        r"\b(direct|diffuse|normal|tilted|uv)\b",
    ),
    ("humidity_pct", r"\bhumidity\b|^(rhum|rh|relh)$", r"\b(inside|cabin|soil|specific|absolute)\b"),
    (
        "pressure_hpa",
        r"^(air |atmospheric |sea ?level |mean sea ?level |msl )?pressure( msl)?( hpa| mbar)?$|^(pres|mslp|slp|qnh)$",
        "",
    ),
)
"""Rules of the columns of weather; the contract has the pressure at sea level, and no other one is read."""
_CAMEL: Final = r"(?<=[a-z])(?=[A-Z][a-z])|(?<=[a-z])(?=[A-Z]+$)|(?<=REESS)(?=[A-Z])|(?<=\bDA)(?=[A-Z][a-z])"
"""Places within a word at which another one begins: `DAActualSpeed` is `DA Actual Speed`."""
_TIME_UNITS: Final = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "day", "days"), "d"),
}
"""Spelling of a unit of time -> its name in a map."""
_RULES: Final = (
    (TIME, _TIME_NAMES, ""),
    (OTHER_TIME, _OTHER_TIME_NAMES, ""),
    (VEHICLE, r"^(vehicle|veh|car|vin|device|asset|plate|unit)( (id|name|number))?$|^(veh|vehicle|car|device)id$", ""),
    (RIDE, r"^(drive|trip|ride|journey|session)( (id|number))?$|^(trip|drive|ride)id$", ""),
    *_WEATHER_RULES,
    ("latitude_deg", r"\b(lat|latitude)\b", ""),
    ("longitude_deg", r"\b(lon|lng|long|longitude)\b", ""),
    ("elevation_m", r"\b(elevation|altitude|alt)\b", ""),
    (
        "battery_temperature_c",
        r"\b(batt|battery|pack|hv|v b|reess)\b.*\b(temp|temperature)\b",
        r"\b(max|min|cell|inlet)\b",
    ),
    ("ambient_c", _AMBIENT, r"\b(cabin|inside|conditioning)\b"),
    ("hvac_w", _HVAC, r"\b(no power|on|state|set|fan)\b|temp"),
    (
        "battery_voltage_v",
        (
            r"\b(voltage|volts?|spannung|batteriespannung|tension|voltaje|tensione|spanning)\b|"
            rf"^{_BATTERY} [vu]$|^[vu] {_BATTERY}$"
        ),
        _NOT_THE_PACK,
    ),
    (
        POWER,
        rf"\b(power|leistung|puissance|potencia|potenza|vermogen|batterieleistung)\b|{_POWER_LETTERS}",
        rf"{_NOT_THE_PACK}|\bno power\b",
    ),
    (
        "soc_pct",
        (
            r"\b(soc|so c|state of charge|battery level|charge level|ladezustand|ladestand|niveau de charge|"
            r"estado de carga)\b"
        ),
        r"\b(usable|limit|target|max|min)\b",
    ),
    (
        "battery_current_a",
        (
            r"\b(current|amps|amperes?|strom|batteriestrom|courant|corriente|corrente|stroom)\b|"
            rf"^{_BATTERY} [ia]$|^i {_BATTERY}$"
        ),
        rf"{_NOT_THE_PACK}|\blocation\b",
    ),
    (
        "odometer_km",
        r"\b(odo|odometer|mileage|kilometerstand|kilometrage|cuentakilometros|traveled distance|total distance)\b",
        r"\btrip\b",
    ),
    (
        "speed_kmh",
        rf"\b(speed|spd|gpsspeed|gpsspd|velocity|geschwindigkeit|vitesse|velocidad|velocit|snelheid)\b|{_SPEED_LETTERS}",
        r"\b(wind|fan|motor|engine|limit|posted|average|max|rpm|schedule|scheduled|target|desired|reference|ref)\b",
    ),
    ("occupants", r"\b(occupants?|passengers|people)\b", ""),
    ("charging", r"\b(is )?charging( state)?\b|\bcharge state\b", _NO_STATE),
    (STATE, r"^(vehicle |car |drive |driving |shift )?(state|status|mode)$|^gear( position| state)?$|^activity$", ""),
    (SIGNAL, r"^(signal|metric|diagnostic|variable|parameter|key|name)( (id|name))?$", ""),
    (VALUE, r"^(value|data|reading|val)$", ""),
)
"""Role, pattern of the words of a name, and pattern of words that exclude it; the first that fits counts."""


class NamedColumn(NamedTuple):
    """Hold what the name of a column says: its role or field, and its unit where the name has one."""

    name: str
    role: str
    unit: str | None


def guess_name(name: str, unit: str | None = None) -> NamedColumn | None:
    """Return the role of a column by its name; None where the name says nothing.

    Examples
    --------
    >>> guess_name("Speed [km/h]")
    NamedColumn(name='Speed [km/h]', role='speed_kmh', unit='km/h')
    >>> guess_name("batt_current_A").unit, guess_name("tyre pressure")
    ('A', None)
    """
    bare, bracketed = _take_brackets(name.partition("#")[0])
    bracketed = bracketed or unit
    words = _split_words(bare)
    text = " ".join(words).lower()
    last = (bracketed or (words[-1] if words else "")).lower()
    if last in _OTHER_QUANTITIES:
        return None
    for role, pattern, unless in _RULES:
        if re.search(pattern, text) and not (unless and re.search(unless, text)):
            return NamedColumn(name, role, _find_unit(role, bracketed, words))
    # a time in milliseconds, and so on, ends in its unit
    of_time = _TIME_UNITS.get(words[-1].lower()) if words else None
    before = " ".join(words[:-1]).lower()
    if of_time and re.search(_TIME_NAMES, before):
        return NamedColumn(name, TIME, of_time)
    if of_time and re.search(_OTHER_TIME_NAMES, before):
        return NamedColumn(name, OTHER_TIME, of_time)
    return None


def _take_brackets(name: str) -> tuple[str, str | None]:
    """Return a name without the unit in brackets at its end, and that unit."""
    found = re.match(r"^(.*?)\s*[\[(]([^\])]*)[\])]+\s*$", name)
    return (found[1], found[2].strip()) if found else (name, None)


def _split_words(name: str) -> list[str]:
    """Return the words of a name, divided at signs, and where small letters meet capitals; units stay whole.

    >>> _split_words("DiagnosticStateOfChargeId"), _split_words("batt_current_A"), _split_words("PackPowerkW")
    (['Diagnostic', 'State', 'Of', 'Charge', 'Id'], ['batt', 'current', 'A'], ['Pack', 'Power', 'kW'])
    """
    plain = unicodedata.normalize("NFKD", name.replace("ß", "ss"))
    name = "".join(letter for letter in plain if not unicodedata.combining(letter))
    words = []
    for token in re.findall(r"[kK][mM]/h(?:r)?\b|m/s\b|mi/h\b|[A-Za-z0-9°%]+", name):
        found = _UNIT_AT_END.fullmatch(token)
        rest, unit = found.groups() if found else (token, None)
        if not rest or _UNIT.fullmatch(token):
            words.append(token)
            continue
        words += re.sub(_CAMEL, " ", rest).split()
        words += [unit] if unit else []
    return words


def _find_unit(role: str, bracketed: str | None, words: list[str]) -> str | None:
    """Return the unit that a name gives."""
    if role in {TIME, OTHER_TIME}:
        last = bracketed or (words[-1] if len(words) > 1 else "")
        return _TIME_UNITS.get(last.lower())
    if role not in FIELD_UNITS:
        return None
    if bracketed and convertible(bracketed, role):
        return bracketed
    endings = [words[-1], "/".join(words[-2:])] if len(words) > 1 else words if _UNIT.fullmatch("".join(words)) else []
    return next((unit for unit in endings if _is_unit(unit, role)), None)


def _is_unit(word: str, role: str) -> bool:
    """Return whether the last word of a name is a unit of its field and no name of it."""
    if not FIELD_UNITS[role] or not convertible(word, role):
        return False
    return spell_unit(word, role) not in {"", "1"}
