"""Small arithmetic made fast: by component, with own rules for derivatives and batches."""
