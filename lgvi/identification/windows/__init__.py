"""Parts of trajectories side by side, simulated and compared with what was recorded."""
