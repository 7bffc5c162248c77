"""What was recorded, from arrays or files, checked."""
