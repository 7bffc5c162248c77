"""Torque laws, and what an integrator makes of them."""
