"""Logs of flight computers, phones, robots and cameras, as signals and as recordings."""

from .contents import describe as describe
from .free_flights import find_free_flights as find_free_flights
from .free_flights import read_intervals as read_intervals
from .log import Log as Log
from .reading import read as read
from .recorded import from_recordings as from_recordings
from .signal import LogError as LogError
from .signal import Signal as Signal
