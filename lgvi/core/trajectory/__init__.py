"""Many steps, and their derivatives."""
