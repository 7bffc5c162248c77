"""Where a fit begins: initial states from readings."""
