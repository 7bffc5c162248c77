"""Delimited text, of any origin."""
