"""Segments: their motion, their derivatives and their chains."""
