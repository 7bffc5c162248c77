"""Units in which users have quantities: factors to the units of the library, and spellings."""

import math
import re

STANDARD_GRAVITY = 9.80665  # m/s², by definition

# The factors of other units, by the unit of the library.
FACTORS = {
    "rad/s": {"deg/s": math.pi / 180, "rpm": 2 * math.pi / 60, "rev/s": 2 * math.pi},
    "m": {"cm": 1e-2, "mm": 1e-3},
    "m/s²": {"g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000},
    "T": {"mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "N m": {"mN m": 1e-3},
    "rad": {"deg": math.pi / 180},
}
SPELLINGS = {
    **dict.fromkeys(("dps", "°/s", "deg/sec", "degrees/s"), "deg/s"),
    **dict.fromkeys(("rad/sec", "radians/s"), "rad/s"),
    **dict.fromkeys(("m/s^2", "m/s/s", "m/s2", "m/s**2"), "m/s²"),
    **dict.fromkeys(("µT", "μT", "microtesla"), "uT"),
    **dict.fromkeys(("gauss", "Gauss", "Gs"), "G"),
    **dict.fromkeys(("mGauss", "milligauss"), "mG"),
    **dict.fromkeys(("RPM", "rev/min", "r/min", "1/min"), "rpm"),
    **dict.fromkeys(("Hz", "rps"), "rev/s"),
    **dict.fromkeys(("°", "degrees", "degree"), "deg"),
    **dict.fromkeys(("radians", "radian"), "rad"),
    **dict.fromkeys(("meters", "meter", "metres", "metre"), "m"),
    **dict.fromkeys(("millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("Nm", "N*m", "N·m"), "N m"),
    **dict.fromkeys(("-", "unitless"), "1"),
}
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(
        ("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"), "us"
    ),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"), "ns"),
}
NAMED = {  # units that are known, some for what has no factor here
    *("rad/s²", "deg/s²", "m/s", "km/h", "km", "ft", "N", "V", "mV", "A", "mA", "mAh", "W", "K"),
    *("C", "°C", "degC", "Pa", "kPa", "hPa", "mbar", "bar", "Hz", "kHz", "%", "lx", "dB", "dBm"),
    *("kg", "flags", "min"),
    *FACTORS,
    *(unit for factors in FACTORS.values() for unit in factors),
}
ENDINGS = {  # units in names such as acc_x_g
    **{spelling: unit for spelling, unit in TIME_UNITS.items() if spelling.isascii()},
    **dict.fromkeys(("rad_s", "rad_per_s", "rad_per_sec", "rad_sec", "radps"), "rad/s"),
    **dict.fromkeys(("deg_s", "deg_per_s", "deg_per_sec", "deg_sec", "degps", "dps"), "deg/s"),
    **dict.fromkeys(("m_s2", "m_s_2", "m_per_s2", "mps2", "ms2", "mss"), "m/s²"),
    **dict.fromkeys(("m_s", "m_per_s", "mps"), "m/s"),
    **dict.fromkeys(("ut", "uT"), "uT"),
    **dict.fromkeys(("ga", "gauss"), "G"),
    **{unit: unit for unit in ("rpm", "rad", "deg", "g", "m", "mm", "cm", "nT", "mG")},
}
# What is in front of a unit, and the unit.
WITH_UNIT = (
    r"(.*\S)\s*[\[(]([^\[\]()]*)[\])]",
    r"(.*\S)\s*,\s+(\S+)",
    r"(.*\S)\s+/\s+(\S.*)",
    r"(.*\S)[ _](\S+/\S+)",
    r"(?!\w+/[mun]?s$)(\w+)/(\w+)",  # `rpm/s` is no quantity `rpm` in s
    r"((?i:t|time|timestamp))/([mun]?s)",
)


def standard_spelling(unit: str) -> str:
    """The unit as it is spelled here."""
    plain = re.sub(r"\s*/\s*", "/", unit.strip())
    plain = re.sub(r"[ .·*]s\^?[-−⁻][1¹]$", "/s", plain)
    plain = re.sub(r"[ .·*]s\^?[-−⁻][2²]$", "/s²", plain)
    return SPELLINGS.get(plain, plain)


def known_unit(written: str) -> str:
    """The unit that is written, perhaps in brackets; empty if it is none that is known."""
    written = re.sub(r"^[\[(]|[\])]$", "", written.strip()).strip()
    unit = written if written in NAMED else standard_spelling(written)  # Hz may be no rotation
    is_pure = unit == "1" != written  # `x [-]` has no unit, and `x [1]` is the first of several
    return unit if is_pure or unit in NAMED else TIME_UNITS.get(unit.lower(), "")


def split_unit(name: str) -> tuple[str, str]:
    """A name without its unit, as in `gyro_x [deg/s]`, `acc_x_g`, `t/us` and `TimeUS`."""
    if known_unit(name):
        return name, ""
    for pattern in WITH_UNIT:
        parts = re.fullmatch(pattern, name)
        if parts and (unit := known_unit(parts[2] or "-")):
            return parts[1].strip(), unit
    words = re.split(r"[_ .]", name)
    for count in (3, 2, 1):
        ending = "_".join(words[-count:])
        unit = ENDINGS.get(ending) or TIME_UNITS.get(ending.lower())
        # A dot and one letter are a component, such as `box.m`.
        if len(words) > count and unit and not (len(ending) == 1 and name[-2] == "."):
            return name[: -len(ending) - 1], unit
    if parts := re.fullmatch(r"(.*[a-z])(US|MS|NS)", name):
        return parts[1], parts[2].lower()
    return name, ""
