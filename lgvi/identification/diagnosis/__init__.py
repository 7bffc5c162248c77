"""Whether the model holds: what it may leave out, and mistakes in a log."""
