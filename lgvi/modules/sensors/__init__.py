"""Sensors, one file for each kind."""

from .attitude import AttitudeSensor
from .gyroscope import Gyroscope

# Recordings know the channels of these without being told.
SENSORS = (AttitudeSensor, Gyroscope)
