"""Units of measurement: spellings, factors to SI, and consistent sets of units."""

import re
from dataclasses import dataclass, replace
from math import pi


@dataclass(frozen=True)
class Unit:
    """A unit of measurement."""

    factor: float  # to SI
    si: str  # the SI unit, as in `Channel.unit`
    quantity: str  # that it measures, one of `QUANTITIES` or another word; empty where it does not determine it


STANDARD_GRAVITY = 9.80665  # m/s^2
INCH, FOOT, POUND_FORCE = 0.0254, 0.3048, 4.4482216152605  # m, m, N
DEGREE = pi / 180

# By quantity: the SI unit, then names and factors of all its units. Small and capital letters differ: mN is not MN.
BY_QUANTITY: dict[str, tuple[str, dict[str, float]]] = {
    "time": ("s", {"s": 1, "sec": 1, "secs": 1, "second": 1, "seconds": 1, "ms": 1e-3, "msec": 1e-3, "us": 1e-6,
                   "usec": 1e-6, "ns": 1e-9, "min": 60, "h": 3600, "Sekunde": 1, "Sekunden": 1, "Millisekunden": 1e-3,
                   "seconde": 1, "secondes": 1, "segundos": 1}),
    "frequency": ("Hz", {"Hz": 1, "hz": 1, "HZ": 1, "kHz": 1e3, "MHz": 1e6, "CPM": 1 / 60, "cpm": 1 / 60}),
    "displacement": ("m", {"m": 1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "micron": 1e-6, "microns": 1e-6, "nm": 1e-9,
                           "in": INCH, "inch": INCH, "inches": INCH, "mil": 1e-3 * INCH, "mils": 1e-3 * INCH,
                           "ft": FOOT, "km": 1e3}),
    "velocity": ("m/s", {"m/s": 1, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6, "nm/s": 1e-9, "in/s": INCH, "ips": INCH,
                         "inch/s": INCH, "mil/s": 1e-3 * INCH, "mils/s": 1e-3 * INCH, "ft/s": FOOT, "km/h": 1 / 3.6}),
    "acceleration": ("m/s^2", {"m/s^2": 1, "cm/s^2": 1e-2, "mm/s^2": 1e-3, "um/s^2": 1e-6, "nm/s^2": 1e-9,
                               "in/s^2": INCH, "inch/s^2": INCH, "ft/s^2": FOOT, "Gal": 1e-2,
                               "g": STANDARD_GRAVITY, "G": STANDARD_GRAVITY, "gn": STANDARD_GRAVITY,
                               "mg": 1e-3 * STANDARD_GRAVITY, "ug": 1e-6 * STANDARD_GRAVITY}),
    "slope": ("rad", {"rad": 1, "mrad": 1e-3, "urad": 1e-6, "deg": DEGREE, "degree": DEGREE, "degrees": DEGREE,
                      "°": DEGREE}),
    "angular velocity": ("rad/s", {"rad/s": 1, "mrad/s": 1e-3, "deg/s": DEGREE, "°/s": DEGREE, "dps": DEGREE}),
    "force": ("N", {"N": 1, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "kN": 1e3, "MN": 1e6, "lbf": POUND_FORCE,
                    "lb": POUND_FORCE, "kgf": STANDARD_GRAVITY}),
    "moment": ("N m", {"N m": 1, "Nm": 1, "N mm": 1e-3, "Nmm": 1e-3, "mN m": 1e-3, "mNm": 1e-3, "kN m": 1e3,
                       "kNm": 1e3}),
    "voltage": ("V", {"V": 1, "v": 1, "Volt": 1, "Volts": 1, "volt": 1, "volts": 1, "mV": 1e-3, "uV": 1e-6, "kV": 1e3}),
    "strain": ("1", {"strain": 1, "m/m": 1, "um/m": 1e-6, "ustrain": 1e-6, "ue": 1e-6, "uε": 1e-6}),
    "pressure": ("Pa", {"Pa": 1, "kPa": 1e3, "MPa": 1e6, "bar": 1e5}),
    "": ("counts", {"counts": 1, "count": 1, "Counts": 1, "cts": 1, "ADC": 1}),
}  # fmt: skip
# kg
MASSES = {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "ug": 1e-9, "ng": 1e-12, "pg": 1e-15, "t": 1e3, "Mg": 1e3,
          "lb": 0.45359237, "lbm": 0.45359237, "slug": POUND_FORCE / FOOT, "slinch": POUND_FORCE / INCH}  # fmt: skip
UNITS = {
    name: Unit(float(factor), si, quantity)
    for quantity, (si, names) in BY_QUANTITY.items()
    for name, factor in names.items()
}

# One spelling for each letter and exponent: the micro sign and the Greek mu, ² and **2 and s2, sec and s.
SPELLINGS = (
    ("µ", "u"), ("μ", "u"), ("²", "^2"), ("**", "^"), ("·", " "), ("*", " "), ("⋅", " "), ("º", "°"),
    ("/sec", "/s"), ("/s/s", "/s^2"), ("/s2", "/s^2"), (" s^-2", "/s^2"), (" s^-1", "/s"), ("/(s^2)", "/s^2"),
)  # fmt: skip
# of the motions that are measured most, for messages
LIKELY = "m/s^2, mm/s^2, in/s^2, ft/s^2, g, m/s, mm/s, in/s, ft/s, m, mm, um, in, ft"
# Text in brackets that is a unit, if not a known one: with an exponent, as furlong/s^2, or one of these words.
EXPONENT = re.compile(r"[A-Za-z)](?:\^|\*\*)-?\d|[²³]")
PER = ("time", "displacement")  # quantities below the stroke of a unit
FOREIGN = ("rpm", "psi", "ksi", "mph", "kph", "yd", "kip", "dyn", "oz", "mA", "pC", "dB")
SI_NAME = re.compile(r"\b(m|kg|s|N|Hz|J)(?![^\W²³])")
POWERS = re.compile(r"(/?)\s*([A-Za-z]+)(?:\^(\d))?")
BRACKETED = re.compile(r"(.*?)\s*(?:\[\s*([^\[\]]*)\]|\(\s*((?:[^()]++|\([^()]*+\))*+)\))")
AFTER_SLASH = re.compile(r"(.*\S)\s+(?:/|in)\s+(\S.*)")  # axis labels of DIN and ISO
TIME = {"t", "time", "zeit", "temps", "tiempo", "x-axis", "timestamp", "time stamp", "elapsed time", "relative time"}
# the clocks of Arduino, the instants of LabVIEW, and units that stand alone
TIME_AS_UNIT = {"x_value": "s", "millis": "ms", "micros": "us", "milliseconds": "ms", "microseconds": "us",
                "seconds": "s"}  # fmt: skip
TIME_UNDERSCORE = re.compile(r"(t|time)_(s|sec|ms|us)", re.IGNORECASE)
NUMBERED = re.compile(r"(\S\D*?\S)\s+\d+\b.*")  # one time of several, as catman's `Time 1 - default sample rate`


def unit_named(text: str) -> Unit | None:
    """The unit with a name, in any usual spelling; None for an unknown one."""
    return UNITS.get(_our_spelling(text))


def _our_spelling(text: str) -> str:
    for spelling, ours in SPELLINGS:
        text = text.replace(spelling, ours)
    return " ".join(text.split())


def split_unit(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit as written, of `Acc [g]`, `Acc (g)`, `Acc / g` and `Acc in g`.

    Text in brackets that is not a unit belongs to the name.
    """
    for pattern in (BRACKETED, AFTER_SLASH):
        found = pattern.fullmatch(name.strip())
        if found and found[1]:
            text = next(group for group in found.groups()[1:] if group is not None).strip()
            if unit_named(text) is not None:
                return found[1], text
    return name, ""


def unknown_unit(name: str) -> str:
    """What the brackets at the end of a name state as its unit, if that is not a known one; else empty.

    Round brackets may hold any remark, as in `x (left)`: only what looks like a unit is taken for one.
    """
    found = BRACKETED.fullmatch(name.strip())
    if not found or not found[1]:
        return ""
    text = (found[2] or found[3] or "").strip()
    if unit_named(text) is not None or not any(sign.isalpha() for sign in text):
        return ""
    return text if found[2] or _is_like_unit(text) else ""


def contradiction(name: str) -> tuple[str, str] | None:
    """Two units at the end of a name that cannot both be right, as in `a [ft/min] [m/s^2]`; None for other names."""
    base, outer = split_unit(name)
    found = BRACKETED.fullmatch(base.strip()) if outer else None
    if found is None:
        return None
    inner = (found[2] or found[3] or "").strip()
    first, second = unit_named(inner), unit_named(outer)
    if first is None or second is None:
        return (inner, outer) if _is_like_unit(inner) else None
    # in round brackets one letter may be a direction or a place: `Acc (N) [g]`
    alike = found[2] is not None or _is_like_unit(inner) or first.quantity == second.quantity
    return (inner, outer) if alike and first != second else None


def _is_like_unit(text: str) -> bool:
    _, slash, below = text.rpartition("/")
    per = unit_named(below.strip(" ()").rstrip("0123456789")) if slash else None
    return text in FOREIGN or bool(EXPONENT.search(text)) or (per is not None and per.quantity in PER)


def time_factor(name: str) -> float | None:
    """Factor to seconds of a column of sample instants; None where the name is not that of a time."""
    if not time_base(name):
        return None
    unit = unit_named(time_unit(name) or "s")
    return unit.factor if unit is not None and unit.quantity == "time" else None


def time_unit(name: str) -> str:
    """The unit that the name of a column of sample instants states, as `time_ms`, `t [ms]` and `millis`; else empty."""
    underscore = TIME_UNDERSCORE.fullmatch(name)
    return underscore[2].lower() if underscore else split_unit(name)[1] or TIME_AS_UNIT.get(name.strip().lower(), "")


def time_base(name: str) -> str:
    """The name of a column of sample instants without unit and number, in small letters; empty for other columns."""
    underscore, base = TIME_UNDERSCORE.fullmatch(name), split_unit(name)[0].strip()
    numbered = NUMBERED.fullmatch(base)
    base = (underscore[1] if underscore else numbered[1] if numbered else base).lower()
    return base if base in TIME or base in TIME_AS_UNIT else ""


NAMED_BY = {"length": "displacement", "time": "time", "force": "force"}  # names of `Units` but mass, by quantity


@dataclass(frozen=True)
class Units:
    """Names of a consistent set of units, for input and results.

    Attributes:
        length, mass, time, force: such as "mm", "t", "s", "N"; force is that of mass · length / time².
    """

    length: str = "m"
    mass: str = "kg"
    time: str = "s"
    force: str = "N"

    def named(self, unit: str) -> str:
        """A unit in SI names, such as N s^2/m^2, with the names of this set."""
        own = self._by_si()
        return SI_NAME.sub(lambda name: own[name[0]], unit)

    def taken(self, unit: Unit) -> Unit:
        """A unit with its factor to this set instead of SI: that of mm/s^2 is 1 for lengths in mm and times in s."""
        factor, own = unit.factor, self._by_si()
        for below, name, power in POWERS.findall(unit.si):
            if own.get(name, name) != name:
                factor *= _in_si(own[name], name) ** (int(power or 1) * (1 if below else -1))
        return replace(unit, factor=factor, si=self.named(unit.si))

    @property
    def consistency(self) -> float | None:
        """A force of mass · length / time² in the unit of force; None where a name's factor to SI is not known."""
        length, time, force = (unit_named(name) for name in (self.length, self.time, self.force))
        mass = MASSES.get(_our_spelling(self.mass))
        if mass is None or length is None or time is None or force is None:
            return None
        return mass * length.factor / time.factor**2 / force.factor

    def check_known(self) -> None:
        """Refuse, by a ValueError, a name whose factor to SI is not known, or that is of another quantity."""
        names = {what: BY_QUANTITY[quantity][1] for what, quantity in NAMED_BY.items()}
        for what, known in (*names.items(), ("mass", MASSES)):
            name = getattr(self, what)
            if _our_spelling(name) not in known:
                raise ValueError(f"{what} = {name!r:.60} is not known; name one of {', '.join(known)}")

    def _by_si(self) -> dict[str, str]:
        hertz = "Hz" if self.time == "s" else f"1/{self.time}"
        energy = "J" if (self.force, self.length) == ("N", "m") else f"{self.force} {self.length}"
        return {"m": self.length, "kg": self.mass, "s": self.time, "N": self.force, "Hz": hertz, "J": energy}


def _in_si(text: str, si: str) -> float:
    unit = unit_named(text)
    if unit is None or unit.si != si:
        known = ", ".join(name for name, one in UNITS.items() if one.si == si)
        raise ValueError(
            f"{text!r} of [units] is not known in {si}: name one of {known}, or leave units out of the file"
        )
    return unit.factor


SI = Units()
