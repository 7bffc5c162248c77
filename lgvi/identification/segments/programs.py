r"""The two programs of an identification: motion along segments, and its local derivatives.

A segment is a fixed number of steps. `advance` simulates segments side by side. `differentiate`
takes each kick, each drift and each reading for itself, and gives its derivative with respect to
what goes into it: the state before, the inertia, rotors, torques, leaves of a law or of a sensor.
Neither knows what is free, how long a trajectory is, or how many there are: which leaves move, and
in which directions, is algebra on the local derivatives, in `chain`.

A small change of a state is a rotation vector $\xi$, with which the attitude is
$R\operatorname{Exp}(\xi)$, and a change of the body momentum $\pi$.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array

from ...core import so3
from ...core.kernels.dependence import operations_of, reached
from ...core.kernels.quaternions import Quaternion
from ...core.kernels.vectors import Mat3, Vec3, matmul
from ...core.step.equation import (
    Momentum,
    is_on_branch_of_identity,
    jacobian,
    residual_norm,
    rounding,
)
from ...core.step.modified_inertia import modified_inertia, turns_less_than_a_right_angle
from ...core.step.newton import rodrigues_vector
from ...core.trajectory.inertias import rates_of
from ...core.trajectory.kicks import Part, as_arguments
from ...core.trajectory.splitting import Splitting, Stage, splitting_of
from ...core.trajectory.translation import CentrePath, translate
from ...modules.body import RigidBody
from ...modules.centre_of_mass import SpecificForce
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensors.sensor import MotionState, loss_of, require_shapes
from ...modules.sensors.sensor import advance as advance_sensor
from ...modules.torques.forcing import forcing_of
from ...modules.torques.law import Torque, as_law, call
from ..model.model import Model
from ..model.states import state_leaves
from ..running.compilation import compiled, count_devices, on_devices

ArrayOrNumpy = Any  # arrays of JAX within a program, and of NumPy outside
Changes = dict[str, ArrayOrNumpy]  # derivatives by the name of what changes, where it matters


class Segment(NamedTuple):
    """Segments side by side (segments, ...); a step of size zero does nothing."""

    start: ArrayOrNumpy  # (segments,), time of the first node, recorded s
    dt: ArrayOrNumpy  # (segments, steps), recorded s
    readings: dict[str, ArrayOrNumpy]  # (segments, nodes, ...), by channel
    mask: dict[str, ArrayOrNumpy]  # (segments, nodes), whether there is a reading
    inputs: dict[str, ArrayOrNumpy]  # (segments, nodes, columns), recorded torques and rotors
    rates: dict[str, ArrayOrNumpy]  # their slopes, for each recorded s


class Advanced(NamedTuple):
    """Simulated segments."""

    R: ArrayOrNumpy  # (segments, 3, 3), at the end
    omega: ArrayOrNumpy  # (segments, 3)
    own: ArrayOrNumpy  # (segments, m), leaves that are a state
    residuals: dict[str, ArrayOrNumpy]  # (segments, nodes, axes), whitened; zero where masked
    predicted: dict[str, ArrayOrNumpy]  # (segments, nodes, ...)
    speed: ArrayOrNumpy  # (segments,), rad/s, the largest at the nodes
    usable: ArrayOrNumpy  # (segments,), whether all drifts were solved
    cost: ArrayOrNumpy  # (segments,), sum of the losses; infinite if a drift was not solved
    # (segments, nodes, 2), of robust losses by channel: the weight, and its slope.
    weights: dict[str, ArrayOrNumpy]
    motion: "Motion"


class Motion(NamedTuple):
    """Before each drift with its kicks, and at the end, relative to the first attitude."""

    q: Quaternion
    pi: Vec3
    c: Vec3  # Rodrigues vectors of the drifts

    def at_nodes(self, R: Array, stages: int) -> tuple[Array, Array]:
        """Attitudes and momenta at the nodes, where a step has so many drifts."""
        q, pi = jax.tree.map(lambda x: x[::stages], (self.q, self.pi))
        return matmul(R, matrix_of(q)), pi.array()


class Local(NamedTuple):
    """Local derivatives of segments (segments, ...).

    Of the turn of a drift by its own momentum, by the inertia (xx, yy, zz, xy, xz, yz), by the
    momentum of rotors, by the relative size of all steps, and by the momentum at the start, on
    which a modified inertia depends.
    """

    J: ArrayOrNumpy  # (3, 3)
    of_leaves: ArrayOrNumpy  # (6, leaves of the body), of the inertia
    omega: ArrayOrNumpy  # (nodes, 3)
    alpha: ArrayOrNumpy  # (nodes, 3)
    alpha_rate: ArrayOrNumpy | None  # (nodes, 3), rad/s³, where a sensor reads the acceleration
    t: ArrayOrNumpy  # (nodes,), s
    turn: ArrayOrNumpy  # (drifts, 3, 3), the transposed rotation of each drift
    momentum: ArrayOrNumpy  # (drifts, 3), after each drift
    by_momentum: ArrayOrNumpy  # (drifts, 3, 3)
    by_inertia: ArrayOrNumpy  # (drifts, 3, 6)
    by_rotors: ArrayOrNumpy | None  # (drifts, 3, 3)
    by_scale: ArrayOrNumpy  # (drifts, 3)
    by_start: ArrayOrNumpy | None  # (drifts, 3, 3), where no kick changes the momentum
    before: Changes | None  # (drifts, 3, ...), of the kick before each drift
    after: Changes | None  # of the kick after
    acting: Changes | None  # (nodes, 9, ...), of rho, tau and the rate of rho
    own: Changes | None  # (m, ...), of leaves that are a state, at the end
    readings: dict[str, Changes]  # (nodes, axes, ...), of residuals, by channel
    acceleration: Changes | None  # (nodes, 3, ...)
    force: "LocalForce | None"
    path: "LocalPath | None"


class LocalForce(NamedTuple):
    """The specific force at the nodes of segments (segments, nodes, ...), m/s², body frame."""

    value: ArrayOrNumpy  # (3,)
    rate: ArrayOrNumpy  # (3,), along the motion, for each s
    changes: Changes  # (3, ...)


class LocalPath(NamedTuple):
    """The motion of the centre of mass at the nodes of segments (segments, nodes, ...)."""

    R: ArrayOrNumpy  # (3, 3)
    v: ArrayOrNumpy  # (3,), m/s
    acceleration: ArrayOrNumpy  # (3,), m/s², space frame


class Elements(NamedTuple):
    """Kick, drift, kick: the parts of all steps (drifts, ...)."""

    drift: Array  # s
    before: Array  # size of the kick before the drift, s
    after: Array
    gradient: Array  # of the kick after the drift, s³
    t_before: Array
    t_after: Array
    tau_before: Array
    tau_after: Array
    rho: Array


class Acting(NamedTuple):
    """What acts on the body at the nodes of a segment."""

    h: Array  # (steps,), s
    t: Array  # (nodes,), s
    rho: Array  # (nodes, 3), momentum of rotors
    tau: Array  # (nodes, 3), recorded torques and those of rotors
    rho_rate: Array  # (nodes, 3)
    rho_curve: Array  # (nodes, 3), the rate of `rho_rate`
    tau_rate: Array  # (nodes, 3)
    behind: Array | None  # of rotors at the last node
    rotor_force: Array | None  # (nodes, 9), of rotors: thrust, and six numbers of their drag
    rotor_force_rate: Array | None


@compiled("the motion")
def advance_batch(
    model: Model,
    leaves: ArrayOrNumpy,
    R: ArrayOrNumpy,
    omega: ArrayOrNumpy,
    segments: Segment,
    method: MoserVeselovIntegrator,
    mesh: Mesh | None,
) -> Advanced:
    """A batch of segments from the states at their starts, a part on each device."""

    def of_segment(leaves, R, omega, segment):
        return simulate_segment(method, _with_floats(model, leaves), R, omega, segment)

    return on_devices(jax.vmap(of_segment), mesh)(leaves, R, omega, segments)


@compiled("local derivatives")
def differentiate_batch(
    model: Model,
    leaves: ArrayOrNumpy,
    R: ArrayOrNumpy,
    segments: Segment,
    motion: "Motion",
    method: MoserVeselovIntegrator,
    mesh: Mesh | None,
) -> Local:
    """The local derivatives of a batch of segments that are simulated."""

    def of_segment(leaves, R, segment, motion):
        return _differentiate(method, _with_floats(model, leaves), R, segment, motion)

    return on_devices(jax.vmap(of_segment), mesh)(leaves, R, segments, motion)


class Programs(NamedTuple):
    """The two programs for a model: segments are padded to batches of one size."""

    model: Model  # of which the floating-point leaves are not used
    method: MoserVeselovIntegrator
    optimised: bool  # whether compiling is worth the time
    lanes: int  # segments side by side on each device
    mesh: Mesh | None = None

    @property
    def width(self) -> int:
        """Segments side by side on all devices."""
        return self.lanes * count_devices(self.mesh)

    def fractions(self, segments: Segment) -> tuple[np.ndarray, np.ndarray]:
        """The fractions of a step at which its stages begin and end."""
        drift = np.array([s.drift for s in _splitting(self.model, segments, self.method).stages])
        return np.cumsum(drift) - drift, np.cumsum(drift)

    def advance(
        self, leaves: np.ndarray, R: np.ndarray, omega: np.ndarray, segments: Segment
    ) -> Advanced:
        """Segments from the states at their starts.

        Each has floating-point leaves (segments, leaves) of its own, those of all parts of the
        model.
        """
        parts = [
            _cut(self._run(advance_batch, batch), number)
            for number, batch in self._batches(leaves, R, omega, segments)
        ]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts) if len(parts) > 1 else parts[0]

    def differentiate(
        self, leaves: np.ndarray, R: np.ndarray, segments: Segment, motion: "Motion"
    ) -> Iterator[Local]:
        """Local derivatives of segments that are simulated, of some after others."""
        for number, batch in self._batches(leaves, R, segments, motion):
            yield _cut(self._run(differentiate_batch, batch), number)

    def _run(self, program: Callable[..., Any], batch: Any) -> Any:
        return program(self.model, *batch, self.method, self.mesh, optimised=self.optimised)

    def _batches(self, *arrays: Any) -> Iterator[tuple[int, Any]]:
        """The number of segments of each batch, and the batch."""
        total, size = len(arrays[0]), self.width
        for begin in range(0, total, size):
            if begin + size <= total:
                yield size, jax.tree.map(lambda x, at=begin: x[at : at + size], arrays)
            else:
                index = np.minimum(np.arange(begin, begin + size), total - 1)
                yield total - begin, jax.tree.map(lambda x, at=index: x[at], arrays)


def _cut(tree: Any, number: int) -> Any:
    """The first of all arrays, as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x)[:number], tree)


def _splitting(model: Model, segment: Segment, method: MoserVeselovIntegrator) -> Splitting:
    """The parts of a step; without torques one drift, of the order of the method."""
    inputs = segment.inputs
    if model.torque is None and not {"body_torque", "rotor_speed"} & set(inputs):
        return Splitting(0.0, (Stage(1.0, 0.0),), drift_order=method.order)
    return splitting_of(method.order, method.force_gradient and not _has_rotors(segment))


def _has_rotors(segment: Segment) -> bool:
    return "rotor_momentum" in segment.inputs or "rotor_speed" in segment.inputs


def acting_in(model: Model, segment: Segment, scale: Array | float = 1.0) -> Acting:
    """What acts; all times are multiplied by `scale`."""
    dtype = segment.dt.dtype
    scale = scale * model.time_scale.astype(dtype)
    h = scale * segment.dt
    t = scale * segment.start + jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(h)])
    rho = rho_rate = rho_curve = tau = tau_rate = jnp.zeros((len(t), 3), dtype)
    behind = rotor_force = rotor_force_rate = None
    if "body_torque" in segment.inputs:
        tau = tau + segment.inputs["body_torque"]
        tau_rate = tau_rate + segment.rates["body_torque"] / scale
    if "rotor_momentum" in segment.inputs:
        inertia = model.rotor_inertia.astype(dtype)
        factor = inertia[None, :] if inertia.ndim else inertia
        rho = rho + factor * segment.inputs["rotor_momentum"]
        rho_rate = rho_rate + factor * segment.rates["rotor_momentum"] / scale
    if model.rotors is not None:
        commands, rate = segment.inputs["rotor_speed"], segment.rates["rotor_speed"] / scale
        speeds = model.rotors.follow(commands, h).astype(dtype)
        slope, rate = rate, rate.astype(dtype)
        if model.rotors.lag is not None:
            behind = commands - speeds
            rate, behind = (behind / model.rotors.lag).astype(dtype), behind[-1]
            curve = ((slope - rate) / model.rotors.lag).astype(dtype)
            rho_curve = jax.vmap(model.rotors.momentum)(curve).astype(dtype)

        def of_speeds(function: Callable[[Array], Array]) -> list[Array]:
            """What rotors do at the nodes, and its rate."""
            both = jax.jvp(jax.vmap(function), (speeds,), (rate,))
            return [x.astype(dtype) for x in both]

        torque, torque_rate = of_speeds(model.rotors.torque)
        momentum, momentum_rate = of_speeds(model.rotors.momentum)
        tau, tau_rate = tau + torque, tau_rate + torque_rate
        rho, rho_rate = rho + momentum, rho_rate + momentum_rate
        if model.mass is not None:
            rotor_force, rotor_force_rate = of_speeds(partial(_force_of_rotors, model.rotors))
    return Acting(
        h, t, rho, tau, rho_rate, rho_curve, tau_rate, behind, rotor_force, rotor_force_rate
    )


def _force_of_rotors(rotors: Any, speeds: Array) -> Array:
    """Thrust and six numbers of the drag of rotors (9,) at their speeds."""
    return jnp.concatenate([rotors.thrust_force(speeds), six(rotors.drag_matrix(speeds))])


def _elements(acting: Acting, splitting: Splitting) -> Elements:
    """The parts of all steps, one after another."""
    stages, h = splitting.stages, acting.h
    drift, after, gradient = (
        np.array(fractions)
        for fractions in zip(*((s.drift, s.kick, s.gradient or 0.0) for s in stages), strict=True)
    )
    before, end = np.where(np.arange(len(stages)) == 0, splitting.kick, 0.0), np.cumsum(drift)

    def times(values: Array, fractions: np.ndarray) -> Array:
        """Values (steps, ...) times the fractions, step after step."""
        factors = fractions.reshape(1, -1, *[1] * (values.ndim - 1)).astype(values.dtype)
        products = values[:, None] * factors
        return products.reshape(-1, *values.shape[1:])

    def at(values: Array, fractions: np.ndarray) -> Array:
        """Values (nodes, ...) at fractions of each step."""
        return times(values[:-1], 1 - fractions) + times(values[1:], fractions)

    return Elements(
        times(h, drift),
        times(h, before),
        times(h, after),
        times(h**3, gradient),
        at(acting.t, end - drift),
        at(acting.t, end),
        at(acting.tau, end - drift),
        at(acting.tau, end),
        at(acting.rho, np.full(len(stages), 0.5)),
    )


def _impulse(
    law: Torque | None,
    order: int,
    J: Array,
    size: Array,
    gradient: Array | None,
    t: Array,
    R: Array | None,
    pi: Array,
    rho: Array,
    tau: Array,
) -> Array:
    """Change of the momentum (3,) by what acts at one instant, as of a `Part` of unit time."""
    if law is None or R is None:
        return size * tau
    forcing, _ = forcing_of(law, None, RigidBody(J), order, lambda: t[None], False)
    kicks, acting = as_arguments(forcing, J, t, R, pi)
    tau = kicks.torque(acting, t, R) + tau
    return kicks.impulse(acting, jnp.ones_like(t), rho, Part(0.0, size, gradient), t, R, pi, tau)


def _inertias(J: Array, pi: Array, h: Array, order: int) -> Array:
    """Inertias of drifts of sizes `h`, modified for an order above two."""
    return modified_inertia(J, pi, h, order) if order > 2 else jnp.broadcast_to(J, (*h.shape, 3, 3))


def matrix_of(q: Quaternion) -> Array:
    """Rotation matrices (..., 3, 3)."""
    one, zero = jnp.ones_like(q.w), jnp.zeros_like(q.w)
    axes = Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one)
    return jnp.stack([q.rotate(axis).array() for axis in axes], axis=-1)


def _angular_acceleration(
    law: Torque | None,
    J: Array,
    R: Array,
    pi: Array,
    rho: Array,
    tau: Array,
    rho_rate: Array,
    t: Array,
) -> Array:
    r"""$\dot\omega = J^{-1}(\pi\times\omega + \tau - \dot\rho)$ (3,), rad/s²."""
    omega = rates_of(J, pi - rho)
    total = jnp.cross(pi, omega) + tau - rho_rate
    if law is not None:
        total = total + jnp.asarray(call(as_law("torque", law).of_body(RigidBody(J)), t, R, omega))
    return rates_of(J, total)


def _move(
    model: Model,
    J: Array,
    R: Array,
    omega: Array,
    acting: Acting,
    splitting: Splitting,
    method: MoserVeselovIntegrator,
) -> tuple[Motion, Array]:
    """The motion of one segment, and whether all its drifts were solved."""
    law, kicks, order = model.torque, splitting.kick > 0, splitting.drift_order
    varies = any(stage.gradient for stage in splitting.stages)
    elements, trace = _elements(acting, splitting), jnp.trace(J)
    pi = Vec3.of(matmul(J, omega) + acting.rho[0])
    # Free motion keeps what a modified inertia depends on.
    of_all = None if kicks else _inertias(J, pi.array(), elements.drift, order)
    zero = 0 * pi.x
    q = Quaternion(1 + zero, Vec3(zero, zero, zero))

    def kick(size, gradient, t, q, pi, rho, tau):
        at = None if law is None else matmul(R, matrix_of(q))
        change = _impulse(law, method.order, J, size, gradient, t, at, pi.array(), rho, tau)
        return pi + Vec3.of(change)

    def step(carry, inputs):
        (q, pi), (element, inertia) = carry, inputs
        before = q, pi
        if kicks:
            pi = kick(
                element.before, None, element.t_before, q, pi, element.rho, element.tau_before
            )
            inertia = _inertias(J, pi.array(), element.drift, order)
        g, rho = element.drift / trace, Vec3.of(element.rho)
        unit, p, r = inertia / trace, g * pi, g * rho
        c = Vec3.of(rodrigues_vector(unit, p.array(), method.newton_iters, r.array()))
        solved = residual_norm(Mat3.of(2 * unit), p, c, r) <= rounding(c, r)
        solved &= is_on_branch_of_identity(Mat3.of(unit), c, r)
        if order > 2:
            solved &= turns_less_than_a_right_angle(J, pi.array(), element.drift)
        w = jax.lax.rsqrt(1 + c.dot(c))
        q, pi = q * Quaternion(w, w * c), Quaternion(1.0, c).rotate_back(pi)
        if kicks:
            gradient = element.gradient if varies else None
            pi = kick(
                element.after, gradient, element.t_after, q, pi, element.rho, element.tau_after
            )
        return (q, pi), (before, c, solved)

    last, (states, c, solved) = jax.lax.scan(step, (q, pi), (elements, of_all))
    q, pi = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, last)
    return Motion(q, pi, c), jnp.all(solved)


class _Nodes(NamedTuple):
    """The motion at the nodes of one segment."""

    R: Array
    pi: Array
    omega: Array
    alpha: Array | None  # angular acceleration, where a sensor reads it
    t: Array
    elapsed: Array
    force: Array | None  # over the mass, body frame, where the model has a mass
    x: Array | None  # of the centre of mass, where it moves
    v: Array | None


def _nodes(model: Model, J: Array, acting: Acting, R: Array, pi: Array, read: bool) -> _Nodes:
    omega, alpha = rates_of(J, pi - acting.rho), None
    if read:
        of_node = partial(_angular_acceleration, model.torque, J)
        alpha = jax.vmap(of_node)(R, pi, acting.rho, acting.tau, acting.rho_rate, acting.t)
    instants, v = _Instant(acting.t, R, omega, acting.rotor_force), jnp.zeros_like(omega)
    path = _path(model, instants, acting.h)
    if path is not None:
        v = path.v
    force, law = None, model.specific_force
    if law is not None:
        force = jax.vmap(partial(_specific_force, law))(instants, v)
    elapsed = acting.t - acting.t[0]
    return _Nodes(R, pi, omega, alpha, acting.t, elapsed, force, *(path or (None, None)))


class _Instant(NamedTuple):
    """What the rotation gives at a node, for the force."""

    t: Array
    R: Array
    omega: Array
    rotor_force: Array | None


def _specific_force(law: SpecificForce, instant: _Instant, v: Array) -> Array:
    """The sum of the forces over the mass (3,), body frame, m/s²."""
    t, R, omega, rotor_force = instant
    force = law(t, R, omega, v).astype(R.dtype)
    if rotor_force is None:
        return force
    drag = Mat3.of_six(rotor_force[3:]).array()
    return force + (rotor_force[:3] - matmul(drag, matmul(R.T, v))) / law.mass.astype(R.dtype)


def _path(model: Model, instants: _Instant, h: Array) -> CentrePath | None:
    """The motion of the centre of mass; None where it is not in the model."""
    if model.gravity is None:
        return None
    vectors: list[Any] = [model.gravity, model.x0, model.v0]
    gravity, x, v = (vector.astype(h.dtype) for vector in vectors)
    law = model.specific_force

    def acceleration(instant: _Instant, v: Array) -> Array:
        if law is None:
            return gravity
        return gravity + matmul(instant.R, _specific_force(law, instant, v))

    begins, ends = (
        jax.tree.map(lambda x, at=at: x[at], instants) for at in (slice(-1), slice(1, None))
    )
    return translate(acceleration, CentrePath(x, v), h, begins, ends)


def _reads_acceleration(sensor: Any) -> bool:
    """Whether a sensor asks for the angular acceleration."""
    asked = []

    def predict(t, R, omega):
        def acceleration():
            asked.append(True)
            return omega

        return sensor.predict(MotionState(t, R, omega, acceleration, t, omega, omega, omega))

    jax.eval_shape(predict, jnp.zeros(()), jnp.eye(3), jnp.zeros(3))
    return bool(asked)


def _read(sensor: Any, node: _Nodes) -> Array:
    def acceleration() -> Any:
        return node.alpha

    centre = node.x, node.v, node.force
    return sensor.predict(
        MotionState(node.t, node.R, node.omega, acceleration, node.elapsed, *centre)
    )


def _own_after(
    model: Model, duration: Array, behind: Array | None, path: tuple[Array, Array] | None = None
) -> Array:
    """The leaves that are a state (m,), some time later, at the end of a path."""
    states = state_leaves(model)
    if states is None:
        return jnp.zeros(0, duration.dtype)
    sensors = {name: advance_sensor(sensor, duration) for name, sensor in model.sensors.items()}
    model = eqx.tree_at(lambda m: m.sensors, model, type(model.sensors)(sensors))
    if behind is not None:
        model = eqx.tree_at(lambda m: m.rotors.behind, model, behind)
    if path is not None:
        model = eqx.tree_at(lambda m: (m.x0, m.v0), model, path)
    leaves = jax.tree.leaves(eqx.filter(model, states))
    return jnp.concatenate([leaf.ravel().astype(duration.dtype) for leaf in leaves])


def read_nodes(
    model: Model, acting: Acting, R: Array, pi: Array
) -> tuple[dict[str, Array], _Nodes]:
    """What each sensor reads at all nodes, without noise, and the motion there."""
    read = any(map(_reads_acceleration, model.sensors.values()))
    J = model.body.inertia.astype(R.dtype)
    nodes = _nodes(model, J, acting, R, pi, read)
    sensors = model.sensors.items()
    return {channel: jax.vmap(partial(_read, sensor))(nodes) for channel, sensor in sensors}, nodes


def simulate_segment(
    method: MoserVeselovIntegrator, model: Model, R: Array, omega: Array, segment: Segment
) -> Advanced:
    """One segment from the state at its start, which JAX can differentiate."""
    splitting, J = _splitting(model, segment, method), model.body.inertia.astype(R.dtype)
    acting = acting_in(model, segment)
    motion, usable = _move(model, J, R, omega, acting, splitting, method)
    predicted, nodes = read_nodes(model, acting, *motion.at_nodes(R, len(splitting.stages)))
    residuals, weights, cost = {}, {}, jnp.zeros((), R.dtype)
    for channel, sensor in model.sensors.items():
        require_shapes(sensor, predicted[channel].shape[1:], R.dtype)
        r = jax.vmap(sensor.compute_residual)(predicted[channel], segment.readings[channel])
        residuals[channel] = r = jnp.where(segment.mask[channel][:, None], r, 0)
        squares, loss = jnp.sum(r * r, axis=1), loss_of(sensor)
        if loss is not None:
            slope = jax.jvp(loss.weight, (squares,), (jnp.ones_like(squares),))
            weights[channel] = jnp.stack(slope, axis=-1)
            squares = jnp.where(segment.mask[channel], loss(squares), 0)
        cost = cost + jnp.sum(squares)
    end = None if nodes.x is None or nodes.v is None else (nodes.x[-1], nodes.v[-1])
    own = _own_after(model, nodes.elapsed[-1], acting.behind, end)
    speed = jnp.sqrt(jnp.max(jnp.sum(nodes.omega**2, axis=1)))
    cost = jnp.where(usable, cost, jnp.inf)
    state = nodes.R[-1], nodes.omega[-1], own
    return Advanced(*state, residuals, predicted, speed, usable, cost, weights, motion)


def six(J: Array) -> Array:
    """The numbers xx, yy, zz, xy, xz, yz (..., 6) of symmetric matrices (..., 3, 3)."""
    return jnp.stack([J[..., i, j] for i, j in zip(*SIX, strict=True)], axis=-1)


SIX = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)  # rows and columns of the six numbers


def _changes(function: Callable[..., Array], arguments: Mapping[str, Array]) -> Changes:
    """Derivatives (..., size of the argument) with respect to the arguments that matter."""
    jaxpr = operations_of(function, *arguments.values())
    names = [
        name for i, (name, x) in enumerate(arguments.items()) if x.size and any(reached(jaxpr, [i]))
    ]
    if not names:
        return {}
    ends = np.cumsum([arguments[name].size for name in names])

    def parts(x: Array) -> dict[str, Array]:
        return dict(zip(names, jnp.split(x, ends[:-1], axis=-1), strict=True))

    columns = jax.jacfwd(lambda x: function(*({**arguments, **parts(x)}).values()))(
        jnp.concatenate([arguments[name] for name in names])
    )
    return parts(columns)


def _floats(tree: Any) -> tuple[Array, Callable[[Array], Any]]:
    """The floating-point leaves as one vector, and the tree with others."""
    leaves, rest = eqx.partition(tree, eqx.is_inexact_array)
    flat, back = ravel_pytree(leaves)
    return flat, lambda x: eqx.combine(back(x), rest)


def _with_floats(tree: Any, flat: Array) -> Any:
    """The tree with other floating-point leaves."""
    return _floats(tree)[1](flat)


def _turn_of_drift(
    J: Array, g: Array, over_trace: Array, pi: Vec3, rho: Vec3, c: Vec3
) -> tuple[Array, Array, Array, Array]:
    r"""Derivatives of the turn of a drift by momentum, inertia, rotors and relative size.

    With $A\,dc = P\,dp + Q\,dr - 2\,dJ\,c$ the drift turns by $2(dc - c\times dc)/(1 + c\cdot c)$
    more, for an inertia of unit trace, $p = g\pi$ and $r = g\rho$.
    """
    p, r, outer, zero = g * pi, g * rho, c.outer(c), 0 * c.x
    solve = jacobian(Mat3.of(2 * J), Momentum(p, p - r, p + r), c).inverse()
    of_p, of_r = outer.plus_hat(-1.0 * c).plus_identity(1.0), outer.plus_identity(-1.0)
    w = 2 / (1 + c.dot(c))

    def turn(v: Vec3) -> Array:
        change = solve @ v
        return (w * (change - c.cross(change))).array()

    of_six = (
        Vec3(c.x, zero, zero), Vec3(zero, c.y, zero), Vec3(zero, zero, c.z),
        Vec3(c.y, c.x, zero), Vec3(c.z, zero, c.x), Vec3(zero, c.z, c.y),
    )  # fmt: skip
    return (
        jnp.stack([g * turn(v) for v in of_p.T], axis=-1),
        jnp.stack([-2 * over_trace * turn(v) for v in of_six], axis=-1),
        jnp.stack([g * turn(v) for v in of_r.T], axis=-1),
        turn(of_p @ p + of_r @ r),
    )


def _differentiate(
    method: MoserVeselovIntegrator, model: Model, R0: Array, segment: Segment, motion: Motion
) -> Local:
    splitting, dtype = _splitting(model, segment, method), R0.dtype
    kicks, order, law = splitting.kick > 0, splitting.drift_order, model.torque
    J = model.body.inertia.astype(dtype)
    acting = acting_in(model, segment)
    elements = _elements(acting, splitting)
    pi = jax.tree.map(lambda x: x[:-1], motion.pi)
    rho, c = Vec3.of(elements.rho), motion.c
    before = after = None
    flat_law, law_of = _floats(law)
    attitudes = matmul(R0, matrix_of(motion.q)) if kicks else None
    zero, one = jnp.zeros(3, dtype), jnp.ones(1, dtype)

    def kick(gradient, turn, pi, J6, rho, tau, scale, t, leaves, *, R, size):
        inertia = Mat3.of_six(J6).array()
        at = R + matmul(R, so3.hat(turn))
        size, gradient = scale[0] * size, None if gradient is None else scale[0] ** 3 * gradient
        moved_law = None if law is None else law_of(leaves)
        return _impulse(moved_law, method.order, inertia, size, gradient, t[0], at, pi, rho, tau)

    def of_kick(gradient, R, pi, rho, tau, t, size):
        function = partial(kick, gradient, R=R, size=size)
        arguments = {
            "turn": zero, "momentum": pi, "inertia": six(J), "rho": rho, "tau": tau,
            "scale": one, "t": t[None], "law": flat_law,
        }  # fmt: skip
        return _changes(function, arguments), function(*arguments.values())

    if kicks:
        assert attitudes is not None
        arguments = (
            pi.array(),
            elements.rho,
            elements.tau_before,
            elements.t_before,
            elements.before,
        )
        before, change = jax.vmap(partial(of_kick, None))(attitudes[:-1], *arguments)
        pi = pi + Vec3.of(change)
    drifted = Quaternion(1.0, c).rotate_back(pi)
    if kicks:
        assert attitudes is not None
        arguments = (
            drifted.array(),
            elements.rho,
            elements.tau_after,
            elements.t_after,
            elements.after,
        )
        gradient = elements.gradient if any(s.gradient for s in splitting.stages) else None
        after, _ = jax.vmap(of_kick, (None if gradient is None else 0, *[0] * 6))(
            gradient, attitudes[1:], *arguments
        )

    inertias = _inertias(J, pi.array()[0], elements.drift, order) if not kicks else None
    if inertias is None:
        inertias = jax.vmap(partial(_inertias, J, order=order))(pi.array(), elements.drift)
    trace = jnp.trace(J)
    by_momentum, by_inertia, by_rotors, by_scale = jax.vmap(_turn_of_drift, (0, 0, None, 0, 0, 0))(
        inertias / trace, elements.drift / trace, 1 / trace, pi, rho, c
    )
    by_start = None
    if order > 2:
        at = jnp.concatenate([six(J), zero, one])

        def modify(x, pi, h):
            return six(modified_inertia(Mat3.of_six(x[:6]).array(), pi + x[6:9], x[9] * h, order))

        if kicks:
            modified = jax.vmap(jax.jacfwd(modify), (None, 0, 0))(at, pi.array(), elements.drift)
        else:
            modified = jax.jacfwd(modify)(at, pi.array()[0], elements.drift)
        # Six terms by hand: faster than a sum over an axis.
        by_inertia = sum(by_inertia[:, :, i, None] * modified[:, None, i] for i in range(6))
        by_inertia, by_start, of_scale = jnp.split(by_inertia, (6, 9), axis=2)
        by_scale = by_scale + of_scale[..., 0]
        if kicks:
            by_momentum, by_start = by_momentum + by_start, None

    at_nodes = motion.at_nodes(R0, len(splitting.stages))
    nodes = _nodes(model, J, acting, *at_nodes, True)
    of_body, body_of = _floats(model.body)
    reads = any(map(_reads_acceleration, model.sensors.values()))
    return Local(
        J,
        jax.jacfwd(lambda x: six(body_of(x).inertia.astype(dtype)))(of_body),
        nodes.omega,
        nodes.alpha,
        _rate_of_acceleration(law, J, nodes, acting) if reads else None,
        nodes.t,
        jnp.swapaxes(matrix_of(Quaternion(jnp.ones_like(c.x), c)), -1, -2),
        drifted.array(),
        by_momentum,
        by_inertia,
        by_rotors if _has_rotors(segment) else None,
        by_scale,
        by_start,
        before,
        after,
        *_of_acting(model, segment),
        {
            channel: _of_readings(sensor, nodes, segment, channel)
            for channel, sensor in model.sensors.items()
        },
        _of_acceleration(law, J, nodes, acting) if reads else None,
        _of_force(model, nodes, acting),
        _local_path(model, nodes),
    )


def _of_acting(model: Model, segment: Segment) -> tuple[Changes | None, Changes | None]:
    """Derivatives of what acts at the nodes, and of the leaves that are a state at the end."""
    has_states, has_rotors = state_leaves(model) is not None, _has_rotors(segment)
    if not has_rotors and not has_states:
        return None, None
    inertia, inertia_of = _floats(model.rotor_inertia)
    rotors, rotors_of = _floats(model.rotors)
    sensors, sensors_of = _floats(model.sensors)
    names = "rotor_inertia", "rotors", "sensors", "scale"

    def moved(*values: Array) -> tuple[Model, Acting]:
        parts = [of(x) for of, x in zip((inertia_of, rotors_of, sensors_of), values, strict=False)]

        def chosen(m):
            return [m.rotor_inertia, m.rotors, m.sensors]

        moved_model = eqx.tree_at(chosen, model, parts, is_leaf=lambda x: x is None)
        return moved_model, acting_in(moved_model, segment, values[-1][0])

    def acting(*values: Array) -> Array:
        _, moved_model = moved(*values)
        parts = moved_model.rho, moved_model.tau, moved_model.rho_rate, moved_model.rotor_force
        return jnp.concatenate([part for part in parts if part is not None], axis=1)

    def own(*values: Array) -> Array:
        moved_model, acts = moved(*values)
        return _own_after(moved_model, acts.t[-1] - acts.t[0], acts.behind)

    values = inertia, rotors, sensors, jnp.ones(1, segment.dt.dtype)
    arguments: dict[str, Array] = dict(zip(names, values, strict=True))
    return (
        _changes(acting, arguments) if has_rotors else None,
        _changes(own, arguments) if has_states else None,
    )


def _of_readings(sensor: Any, nodes: _Nodes, segment: Segment, channel: str) -> Changes:
    """Derivatives of the residuals of all nodes."""
    flat, sensor_of = _floats(sensor)

    def of_node(node, measured, mask):
        def residual(turn, omega, alpha, times, leaves, *of_centre):
            moved = sensor_of(leaves)
            at = node._replace(
                R=node.R + matmul(node.R, so3.hat(turn)),
                omega=omega,
                alpha=alpha,
                t=node.t + times[0],
                elapsed=node.elapsed + times[1],
                **dict(zip(centre, of_centre, strict=True)),
            )
            return jnp.where(mask, moved.compute_residual(_read(moved, at), measured), 0)

        zero = jnp.zeros(3, node.R.dtype)
        alpha = zero if node.alpha is None else node.alpha
        centre = {name: getattr(node, name) for name in ("x", "v", "force")}
        centre = {name: value for name, value in centre.items() if value is not None}
        arguments = {
            "turn": zero, "omega": node.omega, "alpha": alpha, "times": zero[:2], "leaves": flat
        }  # fmt: skip
        return _changes(residual, arguments | centre)

    return jax.vmap(of_node)(nodes, segment.readings[channel], segment.mask[channel])


def _of_force(model: Model, nodes: _Nodes, acting: Acting) -> LocalForce | None:
    """The specific force at all nodes, with its derivatives."""
    if nodes.force is None:
        return None
    laws = {name: _floats(getattr(model, name)) for name in ("mass", "force", "torque")}
    acceleration = _acceleration(model, nodes)

    def of_node(R, omega, alpha, a, v, t, rotor_force, rotor_force_rate):
        def force(turn, omega, v, t, *others):
            mass, law, torque, *of_rotors = others
            parts = {
                name: back(value)
                for (name, (_, back)), value in zip(laws.items(), (mass, law, torque), strict=True)
            }
            law = SpecificForce.of(parts["mass"], parts["force"], parts["torque"])
            at = _Instant(t[0], R + matmul(R, so3.hat(turn)), omega, *(of_rotors or (None,)))
            return _specific_force(law, at, v)

        zero, one = jnp.zeros(3, R.dtype), jnp.ones(1, R.dtype)
        arguments = {"turn": zero, "omega": omega, "v": v, "t": t[None]}
        rates = {"turn": omega, "omega": alpha, "v": a, "t": one}
        flat = {name: leaves for name, (leaves, _) in laws.items()}
        still = {name: jnp.zeros_like(leaves) for name, leaves in flat.items()}
        arguments, rates = arguments | flat, rates | still
        if rotor_force is not None:
            arguments |= {"rotor_force": rotor_force}
            rates |= {"rotor_force": rotor_force_rate}
        value, rate = jax.jvp(force, (*arguments.values(),), (*rates.values(),))
        return LocalForce(value, rate, _changes(force, arguments))

    v = jnp.zeros_like(nodes.omega) if nodes.v is None else nodes.v
    state = nodes.R, nodes.omega, nodes.alpha, acceleration, v, nodes.t
    return jax.vmap(of_node)(*state, acting.rotor_force, acting.rotor_force_rate)


def _acceleration(model: Model, nodes: _Nodes) -> Array:
    """The acceleration of the centre of mass (nodes, 3), space frame; zero without its motion."""
    if model.gravity is None:
        return jnp.zeros_like(nodes.omega)
    a = jnp.broadcast_to(model.gravity.astype(nodes.omega.dtype), nodes.omega.shape)
    return a if nodes.force is None else a + jax.vmap(matmul)(nodes.R, nodes.force)


def _local_path(model: Model, nodes: _Nodes) -> LocalPath | None:
    if nodes.v is None:
        return None
    return LocalPath(nodes.R, nodes.v, _acceleration(model, nodes))


def _rate_of_acceleration(law: Torque | None, J: Array, nodes: _Nodes, acting: Acting) -> Array:
    """How fast the angular acceleration changes along the motion (nodes, 3), rad/s³."""

    def of_node(R, omega, alpha, pi, rho, tau, rho_rate, rho_curve, tau_rate, t):
        pi_rate = matmul(J, alpha) + rho_rate
        rates = (
            matmul(R, so3.hat(omega)),
            pi_rate,
            rho_rate,
            tau_rate,
            rho_curve,
            jnp.ones_like(t),
        )
        function = partial(_angular_acceleration, law, J)
        return jax.jvp(function, (R, pi, rho, tau, rho_rate, t), rates)[1]

    state = nodes.R, nodes.omega, nodes.alpha, nodes.pi
    acts = acting.rho, acting.tau, acting.rho_rate, acting.rho_curve, acting.tau_rate
    return jax.vmap(of_node)(*state, *acts, nodes.t)


def _of_acceleration(law: Torque | None, J: Array, nodes: _Nodes, acting: Acting) -> Changes:
    """Derivatives of the angular acceleration at all nodes."""
    flat, law_of = _floats(law)

    def of_node(R, pi, rho, tau, rho_rate, t):
        def acceleration(turn, pi, J6, rho, tau, rho_rate, t, leaves):
            at, moved_law = R + matmul(R, so3.hat(turn)), None if law is None else law_of(leaves)
            inertia = Mat3.of_six(J6).array()
            return _angular_acceleration(moved_law, inertia, at, pi, rho, tau, rho_rate, t[0])

        arguments = {
            "turn": jnp.zeros(3, R.dtype), "momentum": pi, "inertia": six(J), "rho": rho,
            "tau": tau, "rho_rate": rho_rate, "t": t[None], "law": flat,
        }  # fmt: skip
        return _changes(acceleration, arguments)

    return jax.vmap(of_node)(nodes.R, nodes.pi, acting.rho, acting.tau, acting.rho_rate, nodes.t)
