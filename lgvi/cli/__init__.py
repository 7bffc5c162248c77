"""The command `lgvi`: from a log to an answer, without Python."""
