"""Immutable, learnable pytree modules over the functional core."""
