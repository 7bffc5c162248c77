"""Units in which users have quantities, as factors to the units of the library."""

import math

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
