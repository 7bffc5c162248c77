"""The experiment that tells most, within what the hardware can do."""
