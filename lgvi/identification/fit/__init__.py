"""Fits, from short windows to whole trajectories."""
