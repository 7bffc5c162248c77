"""Sensors, one file for each kind."""

from .accelerometer import Accelerometer
from .attitude import AttitudeSensor
from .direction import DirectionSensor
from .gyroscope import Gyroscope
from .magnetometer import Magnetometer
from .position import PositionSensor
from .velocity import VelocitySensor

# Recordings know the channels of these without being told.
SENSORS = (
    AttitudeSensor,
    Gyroscope,
    Accelerometer,
    Magnetometer,
    DirectionSensor,
    PositionSensor,
    VelocitySensor,
)
