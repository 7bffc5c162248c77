"""Small arithmetic made fast: by component, with rules of its own for derivatives and batches."""
