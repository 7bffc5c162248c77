"""Sensors, one file for each kind."""

from .attitude import AttitudeSensor
from .gyroscope import Gyroscope

SENSORS = (AttitudeSensor, Gyroscope)  # whose channels recordings know without being told
