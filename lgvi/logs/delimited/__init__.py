"""Delimited text: the reader `read`."""

from .reading_text import read as read
