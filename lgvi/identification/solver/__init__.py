"""The least-squares problem of all windows, and its minimum."""
