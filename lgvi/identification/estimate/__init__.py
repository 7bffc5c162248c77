"""What a fit tells, in numbers and words."""
