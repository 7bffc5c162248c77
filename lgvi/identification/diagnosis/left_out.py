"""What a model may leave out, as numbers that are zero where it leaves nothing out."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ...modules.sensors.base import AbstractSensor
from ..model.model import Model
from ..segments.chain import Directions, Places

TIME_OFFSET, DRAG = "time_offset", "drag"  # for which None is zero
# Leaves to which numbers can be added.
OF_SENSORS = "bias", "scale", "alignment", "gravity_scale", "length_scale", DRAG
LINEAR, QUADRATIC, TIME_SCALE = "linear damping", "quadratic drag", "time_scale"
DELAY = "rotor_delay"


class LeftOut(NamedTuple):
    """Something that a model may leave out: a leaf of a sensor, or what acts on the body."""

    channel: str  # empty where it is no sensor's
    leaf: str
    number: int  # of numbers

    @property
    def name(self) -> str:
        return f"{self.channel}.{self.leaf}" if self.channel else self.leaf

    @property
    def is_of_rotor(self) -> bool:
        """Whether it is only where a rotor is recorded."""
        return self.leaf == DELAY

    def is_chosen(self, selected: Any) -> bool:
        """Whether a model of True, where a leaf is free, has it among these."""
        node = selected
        if self.channel:
            node = selected.sensors.get(self.channel)
        return any(jax.tree.leaves(getattr(node, self.leaf, None)))

    def directions(self, model: Model, places: Places) -> Directions:
        """The directions of its numbers, one column for each; zero where a model has no such leaf.

        Parameters
        ----------
        model
            A model with all its leaves.
        places
            Where they are.
        """
        found = Directions(np.zeros((places.number, self.number)), np.zeros((2, self.number)))
        if self.leaf in (LINEAR, QUADRATIC):  # 1/s, or 1/rad
            found.damping[int(self.leaf == QUADRATIC), 0] = 1
        elif self.leaf == TIME_SCALE:
            found.leaves[places.part(TIME_SCALE), 0] = float(model.time_scale)
        elif self.leaf == DELAY:
            found.leaves[places.rotor_delay, 0] = 1
        elif self.channel in model.sensors:
            at = places.leaf(self.channel, self.leaf)
            if len(at) == self.number:
                found.leaves[at, np.arange(self.number)] = 1
        return found


def all_left_out(models: Iterable[Model], depends_on_time: bool, has_rotor: bool) -> list[LeftOut]:
    """All that is suspected of some models, which share it.

    Unless something that acts depends on time, time offsets count from the first sensor's.
    """
    found: dict[LeftOut, None] = {}
    for model in models:
        first = None if depends_on_time else next(iter(model.sensors))
        for channel, sensor in model.sensors.items():
            leaves = OF_SENSORS if channel == first else (*OF_SENSORS, TIME_OFFSET)
            for leaf in leaves:
                if number := _number_of(sensor, leaf):
                    found[LeftOut(channel, leaf, number)] = None
    acting = [LeftOut("", leaf, 1) for leaf in (LINEAR, QUADRATIC, TIME_SCALE)]
    if has_rotor:
        acting.append(LeftOut("", DELAY, 1))
    return [*found, *acting]


def _number_of(sensor: AbstractSensor, leaf: str) -> int:
    """How many numbers a leaf of a sensor has, to which others can be added; 0 if it is no leaf."""
    learnable = {each.name for each in fields(sensor) if not each.metadata.get("static")}
    value = getattr(sensor, leaf, None)
    if leaf not in learnable or not (value is None or eqx.is_inexact_array(value)):
        return 0
    return int(leaf in (TIME_OFFSET, DRAG)) if value is None else np.size(value)
