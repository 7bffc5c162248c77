"""Trajectories as chains of segments of one shape: two compiled programs, and algebra in NumPy."""
