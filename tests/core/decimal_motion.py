"""Free motion and the discrete Moser-Veselov step in fifty decimal digits, without the library."""

from decimal import Decimal, localcontext
from functools import wraps

import numpy as np

DIGITS = 50
# A body with no special axes and its momentum, and its state one second after the attitude I.
INERTIA = [["2", "0.1", "0.2"], ["0.1", "2.5", "0.3"], ["0.2", "0.3", "3"]]
MOMENTUM = ["0.7", "1.5", "2.45"]
# By `exact_motion` below, which then is good to 1e-48; rounded.
R_AFTER = [
    ["0.6163592034776996148889175", "-0.5936599119929365966793745", "0.5173676073942728565446387"],
    ["0.6986275653816812428834727", "0.7153944911108212985197118", "-0.0114125797764452146410603"],
    ["-0.3633467451033521824435944", "0.3684815205418418277646946", "0.8556871576937285179253826"],
]
MOMENTUM_AFTER = [
    "0.5891932650036987477606449",
    "1.5603095235986888081275073",
    "2.4414719918609580465368441",
]


def digits(function):
    """Run with that many digits."""

    @wraps(function)
    def run(*args):
        with localcontext() as context:
            context.prec = DIGITS
            return function(*args)

    return run


def numbers(values):
    return [numbers(v) if isinstance(v, list) else Decimal(v) for v in values]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def apply(M, v):
    return [dot(row, v) for row in M]


def transpose(M):
    return [list(column) for column in zip(*M, strict=True)]


def inverse(M):
    x, y, z = M
    columns = [cross(y, z), cross(z, x), cross(x, y)]
    return transpose([[entry / dot(x, columns[0]) for entry in column] for column in columns])


def combine(*terms):
    """Sum of numbers times vectors."""
    return [sum(k * v[i] for k, v in terms) for i in range(3)]


def determinant(M):
    return dot(M[0], cross(M[1], M[2]))


def variables(J, pi):
    """What the series of the modified inertia depend on, for an inertia of unit trace."""
    omega = apply(inverse(J), pi)
    Jd = [[(i == j) / Decimal(2) - x for j, x in enumerate(row)] for i, row in enumerate(J)]
    det = determinant(J)
    w = dot(apply(J, omega), apply(Jd, omega)) / (2 * det)
    return 2 * dot(pi, omega), w, 4 * det, determinant(Jd) / (4 * det**2)


@digits
def exact_motion(J, pi, duration, pieces=8, terms=40):
    """Attitude and momentum after a time, from the attitude I, by Taylor series."""
    K, h = inverse(J), duration / pieces
    R = numbers([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    for _ in range(pieces):
        pis, omegas, rows = [pi], [], [[row] for row in R]
        for n in range(terms):
            omegas.append(apply(K, pis[n]))
            pairs = [(pis[i], omegas[n - i]) for i in range(n + 1)]
            pis.append([sum(x) / (n + 1) for x in zip(*(cross(*p) for p in pairs), strict=True)])
            for row in rows:  # a row of R hat(omega) is the row's cross product with omega
                products = [cross(row[i], omegas[n - i]) for i in range(n + 1)]
                row.append([sum(x) / (n + 1) for x in zip(*products, strict=True)])
        pi, *R = (combine(*((h**n, v) for n, v in enumerate(s))) for s in (pis, *rows))
    return R, pi


decimals = np.vectorize(lambda x: Decimal(float(x)), otypes=[object])


@digits
def motion_at(J, pi, t):
    """The same for arrays of decimals, in as many pieces as the motion needs."""
    beta, axes = np.linalg.eigh(np.linalg.inv(J.astype(float)))
    along = axes.T @ pi.astype(float)
    alpha = np.roll(beta, -2) - np.roll(beta, -1)
    x = np.abs(np.roll(alpha, -1) * np.roll(alpha, -2)) * along**2
    fastest = np.linalg.norm(beta * along) + np.sqrt(np.max(x))
    R, end = exact_motion(J.tolist(), pi.tolist(), t, int(3 * fastest * abs(float(t))) + 3)
    return np.array(R), np.array(end)


@digits
def discrete_motion(J, pi, duration, steps, series):
    """The same by discrete Moser-Veselov steps with alpha, beta of `series` in the inertia."""
    h = duration / steps
    alpha = 1 + sum(a * h ** (2 * n) for n, (a, _) in enumerate(series, start=1))
    beta = sum((b * h ** (2 * n) for n, (_, b) in enumerate(series, start=1)), start=Decimal(0))
    K = [[alpha * x for x in row] for row in inverse(J)]
    J = inverse([[x + beta * (i == j) for j, x in enumerate(row)] for i, row in enumerate(K)])
    R = numbers([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    for _ in range(steps):
        F = _relative_rotation(J, [h * x for x in pi])
        R = [apply(transpose(F), row) for row in R]
        pi = apply(transpose(F), pi)
    return R, pi


def _relative_rotation(J, p):
    """F of J c + c x J c = (1 + c.c) p/2 by Newton's method for the rotation F of c."""
    c = apply(inverse(J), [x / 2 for x in p])
    for _ in range(10):
        k, Jc = dot(c, p), apply(J, c)
        r = combine((1, Jc), (Decimal(-1) / 2, p), (Decimal(1) / 2, cross(c, p)), (-k / 2, c))
        hat = transpose([cross(p, unit) for unit in numbers([[1, 0, 0], [0, 1, 0], [0, 0, 1]])])
        A = [
            [J[i][j] - (hat[i][j] + k * (i == j) + c[i] * p[j]) / 2 for j in range(3)]
            for i in range(3)
        ]
        c = combine((1, c), (-1, apply(inverse(A), r)))
    rows = numbers([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    scale = 2 / (1 + dot(c, c))
    turned = [combine((1, v), (scale, cross(c, v)), (scale, cross(c, cross(c, v)))) for v in rows]
    return transpose(turned)
