"""Functions of exponential decay, smooth where their closed forms divide by zero."""

import jax.numpy as jnp
from jaxtyping import Array

from .so3.series import alternating, horner

SMALL = 0.5  # below it the closed form of `fall` loses more than a digit
_COEFFICIENTS = [c / 2 for c in alternating(14, lambda k: (1, k + 2))]


def fall(z: Array) -> Array:
    r"""$(e^{-z} - 1 + z)/z^2$, which is 1/2 at zero."""
    small = jnp.abs(z) < SMALL
    other = jnp.where(small, 1, z)
    return jnp.where(small, horner(z, _COEFFICIENTS), (jnp.expm1(-other) + other) / other**2)
