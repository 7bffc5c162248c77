"""What a model may leave out, as numbers that are zero where it leaves nothing out."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...modules.sensors.base import AbstractSensor
from ...modules.torques.base import AbstractTorque, as_law
from ...modules.torques.damping import LinearDamping, QuadraticDamping
from ..model.model import Model

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

    def add(self, model: Model, numbers: Array) -> Model:
        """The model with the numbers (n,); as it is where it has no such leaf."""
        if self.channel:
            sensor = model.sensors.get(self.channel)
            fits = sensor is not None and _number_of(sensor, self.leaf) == self.number
            return self._add_to_sensor(model, numbers) if fits else model
        if self.leaf == TIME_SCALE:
            return eqx.tree_at(lambda m: m.time_scale, model, model.time_scale * (1 + numbers[0]))
        if self.leaf == DELAY:
            new = numbers[0] if model.rotor_delay is None else model.rotor_delay + numbers[0]
            return eqx.tree_at(
                lambda m: m.rotor_delay, model, new, is_leaf=lambda node: node is None
            )
        # In proportion to a third of the trace of the inertia: 1/s, or 1/rad.
        law = LinearDamping if self.leaf == LINEAR else QuadraticDamping
        size = numbers[0] * jnp.trace(model.body.inertia) / 3
        return _with_torque(model, law(size * jnp.eye(3, dtype=size.dtype)))

    def _add_to_sensor(self, model: Model, numbers: Array) -> Model:
        def where(model: Model) -> Any:
            return getattr(model.sensors[self.channel], self.leaf)

        given = where(model)
        new = numbers[0] if given is None else given + numbers.reshape(given.shape)
        return eqx.tree_at(where, model, new, is_leaf=lambda node: node is None)


def _with_torque(model: Model, law: AbstractTorque) -> Model:
    torque = law if model.torque is None else as_law("torque", model.torque) + law
    return eqx.tree_at(lambda m: m.torque, model, torque, is_leaf=lambda node: node is None)


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
