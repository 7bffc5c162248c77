"""Forces and the motion of the centre of mass, against NumPy and SciPy."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.integrate import solve_ivp

import lgvi
from lgvi.modules.forces import law as laws

from ..derivatives import assert_gradient_agrees
from ..systems import GENERIC, PI0, R0, hat, order_of, rng, rotation

ANY: Any = lgvi  # whose arguments a type checker does not know
LAWS: Any = laws
RAISED = (RuntimeError, ValueError, eqx.EquinoxRuntimeError)
BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
SPAN, STEPS, T0 = 2.0, 64, 0.5
MASS, GRAVITY = 1.7, np.array([0.3, -0.2, -9.8])
X0, V0 = np.array([1.0, -2.0, 0.5]), np.array([3.0, 1.0, -2.0])
LINEAR = np.array([[0.3, 0.1, 0.0], [0.0, 0.2, 0.0], [0.0, -0.1, 0.4]])
QUADRATIC, WIND = np.array([0.02, 0.01, 0.03]), np.array([1.0, 2.0, -0.5])
PUSH, STRENGTH = np.array([2.0, -1.0, 3.0]), 0.2
PLACE, THRUST = np.array([0.1, 0.0, -0.2]), np.array([0.5, -1.0, 2.0])
HOOK, PULL = np.array([0.0, 0.2, 0.1]), np.array([-2.0, 1.0, 1.0])
FLIGHT = {"mass": MASS, "gravity": GRAVITY, "x0": X0, "v0": V0}


class Lift(lgvi.AbstractForce):
    """A force across the velocity of a body that spins."""

    strength: Array

    def __call__(self, t, R, omega, v):
        return self.strength * jnp.cross(jnp.asarray(omega), jnp.asarray(R).T @ v)


def gust(t, R, omega, v):
    return jnp.sin(3 * t) * R[1] + 0.3 * omega


def law_of(push, linear, quadratic, wind, strength):
    drag = 2 * lgvi.AirDrag(linear / 2, quadratic / 2, wind)
    return gust + lgvi.AppliedForce(push) + drag + Lift(strength)


FORCE = law_of(PUSH, LINEAR, QUADRATIC, WIND, jnp.asarray(STRENGTH))
THRUSTERS = lgvi.Thruster(PLACE, THRUST) + 0.5 * lgvi.Thruster(HOOK, PULL, "space")


def drag(R, v, linear: Any = LINEAR, quadratic: Any = QUADRATIC, wind: Any = WIND):
    """The drag of the air by its formula, in NumPy."""
    u = R.T @ (v - wind)
    D, C = (x if np.ndim(x) == 2 else np.diag(np.ones(3) * x) for x in (linear, quadratic))
    return -D @ u - np.linalg.norm(u) * C @ u


def all_forces(t, R, omega, v):
    """The force of the law and of the thrusters, body frame, in NumPy."""
    of_motion = np.sin(3 * t) * R[1] + 0.3 * omega + STRENGTH * np.cross(omega, R.T @ v)
    return of_motion + PUSH + drag(R, v) + THRUST + 0.5 * R.T @ PULL


def all_torques(t, R):
    return np.cross(PLACE, THRUST) + 0.5 * np.cross(HOOK, R.T @ PULL)


def turning(t, R, omega, v):
    """A force that turns with the body, and depends on its rate."""
    return PUSH + t * omega - omega[::-1] ** 2


def exact_flight(force, span=SPAN, t0=0.0, torque=None, rate=None):
    """Position and velocity of a continuous body after some time, to about 1e-11.

    `force` and `torque` are functions in the body frame, and `rate` is one of the time and the
    momentum that gives the angular velocity.
    """
    inverse = np.linalg.inv(GENERIC)

    def rates(t, y):
        R, pi, v = y[:9].reshape(3, 3), y[9:12], y[15:]
        omega = inverse @ pi if rate is None else rate(t, pi)
        turn = np.cross(pi, omega) + (0 if torque is None else torque(t, R))
        acceleration = GRAVITY + R @ force(t, R, omega, v) / MASS
        return np.concatenate([(R @ hat(omega)).ravel(), turn, v, acceleration])

    start = np.concatenate([R0.ravel(), PI0, X0, V0])
    y = solve_ivp(rates, (t0, t0 + span), start, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return y[12:15], y[15:]


def simulate(
    dt, body=BODY, R0=R0, pi0=PI0, steps: int | None = STEPS, settings=None, **arguments: Any
) -> Any:
    """In as many steps as all trajectories here, so that a program serves several tests."""
    method = lgvi.MoserVeselovIntegrator(dt, **(settings or {}))
    return method.simulate(body, R0, pi0, steps=steps, **arguments)


fly = partial(simulate, torque=THRUSTERS, force=FORCE, **FLIGHT)


def assert_order_2(simulate, exact):
    """`simulate` gives a trajectory of at least `count` steps that cover `SPAN`."""
    errors = []
    for count in (STEPS // 2, STEPS):
        trajectory = simulate(count)
        state = trajectory.x[count], trajectory.v[count]
        errors.append([np.max(np.abs(x - y)) for x, y in zip(state, exact, strict=True)])
    np.testing.assert_allclose(order_of(np.array(errors)), 2.0, rtol=0, atol=0.04)
    assert np.max(errors) < 0.05


def test_a_constant_force_and_gravity_give_a_parabola():
    """Exactly, though the body turns, and the steps differ."""
    pull, times = np.array([1.0, -3.0, 2.0]), T0 + np.cumsum(rng(181).uniform(0.02, 0.1, 33))
    arguments = FLIGHT | {"times": times, "substeps": 2, "steps": None}
    trajectory = simulate(None, force=lgvi.AppliedForce(pull, "space"), **arguments)
    t, acceleration = (times - times[0])[:, None], GRAVITY + pull / MASS
    np.testing.assert_allclose(trajectory.v, V0 + t * acceleration, rtol=0, atol=3e-14)
    parabola = X0 + t * V0 + t**2 / 2 * acceleration
    np.testing.assert_allclose(trajectory.x, parabola, rtol=0, atol=1e-13)


def test_without_forces_the_body_falls_whatever_its_mass():
    """A torque that has a force too needs the mass."""
    trajectory = simulate(SPAN / STEPS, gravity=GRAVITY)
    t = SPAN * np.linspace(0, 1, STEPS + 1)[:, None]
    np.testing.assert_allclose(trajectory.v, t * GRAVITY, rtol=0, atol=1e-13)
    np.testing.assert_allclose(trajectory.x, t**2 / 2 * GRAVITY, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="`mass` must be given where a `torque` has a force too"):
        simulate(SPAN / STEPS, torque=THRUSTERS, gravity=GRAVITY)
    still = simulate(SPAN / STEPS, torque=THRUSTERS)
    np.testing.assert_allclose(still.pi, fly(SPAN / STEPS).pi, rtol=0, atol=1e-13)


def test_the_order_under_all_forces():
    exact = exact_flight(all_forces, t0=T0, torque=all_torques)
    assert_order_2(lambda count: fly(SPAN / count, t0=T0), exact)


def test_the_order_where_no_force_depends_on_the_velocity():
    exact = exact_flight(turning)
    assert_order_2(lambda count: simulate(SPAN / count, force=turning, **FLIGHT), exact)


@pytest.mark.slow
@pytest.mark.parametrize("torque", [None, THRUSTERS])
def test_the_path_is_of_order_2_though_the_rotation_is_of_order_4(torque):
    exact = exact_flight(all_forces if torque else turning, torque=torque and all_torques)
    force = FORCE if torque else turning
    arguments = FLIGHT | {"settings": {"order": 4}, "force": force, "torque": torque}
    assert_order_2(lambda count: simulate(SPAN / count, **arguments), exact)


def wheel(t):
    return np.array([0.5 + 0.3 * t, -0.2 * t, 0.4])


def growing(t):
    return GENERIC + 0.3 * t * np.eye(3)


@pytest.mark.parametrize("kind", ["rotor", "rotor that speeds up", "inertia that grows"])
def test_a_force_of_the_rate_of_a_body_with_inner_motion_is_of_order_2(kind):
    middle = np.arange(STEPS) + 0.5
    body, rate = {
        "rotor": (
            lambda dt: lgvi.Gyrostat(GENERIC, wheel(1.0)),
            lambda t, pi: np.linalg.solve(GENERIC, pi - wheel(1.0)),
        ),
        "rotor that speeds up": (
            lambda dt: lgvi.Gyrostat(GENERIC, np.stack([wheel(t) for t in middle * dt])),
            lambda t, pi: np.linalg.solve(GENERIC, pi - wheel(t)),
        ),
        "inertia that grows": (
            lambda dt: lgvi.VaryingRigidBody(np.stack([growing(t) for t in middle * dt])),
            lambda t, pi: np.linalg.solve(growing(t), pi),
        ),
    }[kind]

    def run(count):
        return simulate(SPAN / count, body(SPAN / count), force=turning, **FLIGHT)

    assert_order_2(run, exact_flight(turning, rate=rate))


def test_the_momentum_changes_by_the_impulses_alone():
    """Of the forces at the stored states, so that the force at the end of a step is that of it."""
    h = SPAN / STEPS
    trajectory = fly(h, t0=T0)
    R, pi, x, v = (np.asarray(y) for y in (*trajectory[:2], trajectory.x, trajectory.v))
    omega = pi @ np.linalg.inv(GENERIC)
    states = zip(trajectory.t, R, omega, v, strict=True)
    force = np.array([R @ all_forces(t, R, omega, v) for t, R, omega, v in states])
    impulses = h / 2 * (force[:-1] + force[1:]) + MASS * h * GRAVITY
    change = np.cumsum(impulses, axis=0)
    np.testing.assert_allclose(MASS * (v[1:] - v[0]), change, rtol=0, atol=2e-13)
    half = v[:-1] + h / 2 * (GRAVITY + force[:-1] / MASS)
    np.testing.assert_allclose(x[1:] - x[:-1], h * half, rtol=0, atol=1e-14)


def test_backwards_undoes_forwards():
    there = fly(SPAN / STEPS, t0=T0)
    start = {"R0": there.R[-1], "pi0": there.pi[-1], "x0": there.x[-1], "v0": there.v[-1]}
    back = fly(-SPAN / STEPS, t0=T0 + SPAN, **start)
    for name in ("R", "pi", "x", "v", "t"):
        actual, desired = getattr(back, name)[::-1], getattr(there, name)
        np.testing.assert_allclose(actual, desired, rtol=0, atol=2e-13)


def test_both_ways_through_the_steps_agree():
    """Of a force that depends on the velocity, and of one that does not."""

    def drag_of_nothing(t, R, omega, v):
        return turning(t, R, omega, v) + 0 * v

    one, other = (
        simulate(SPAN / STEPS, force=force, **FLIGHT) for force in (turning, drag_of_nothing)
    )
    np.testing.assert_allclose(one.v, other.v, rtol=0, atol=1e-13)
    np.testing.assert_allclose(one.x, other.x, rtol=0, atol=1e-13)


@pytest.mark.parametrize("torque", [None, THRUSTERS])
def test_the_rotation_is_that_without_a_path(torque):
    """To the last bit; and without one of the arguments there is no path."""
    plain = simulate(SPAN / STEPS, torque=torque)
    assert plain.x is None
    assert plain.v is None
    arguments = {"force": FORCE, "t0": T0} if torque else {"force": turning}
    moved = simulate(SPAN / STEPS, torque=torque, **arguments, **FLIGHT)
    for actual, desired in zip(jax.tree.leaves(moved[:]), jax.tree.leaves(plain[:]), strict=True):
        np.testing.assert_array_equal(actual, desired)


PADDED, CHUNK = 26, 8  # pieces of several stored states, or several pieces to the next; not filled


def padded_flight(stride, units, sizes: Any = 1.0):
    """A flight of which each `stride`-th state is stored; the units are factors on arguments."""
    mass, dt, v0, push, air, wind, inertia, place = units
    end = 0.05 * (PADDED + 1)

    def until_the_end(t):  # steps that only fill a piece must not go beyond
        return jnp.where(t < end, push, jnp.nan) * PUSH

    law = law_of(until_the_end, air * LINEAR, air * QUADRATIC, wind * WIND, air * STRENGTH)
    arguments = FLIGHT | {"mass": mass * MASS, "v0": v0 * V0}
    return simulate(
        0.05 * dt * sizes,
        lgvi.RigidBody(GENERIC + (inertia - 1) * np.diag([1.0, -0.5, 0.3])),
        torque=lgvi.Thruster(place * PLACE, THRUST),
        force=law,
        steps=PADDED,
        save_every=stride,
        **arguments,
    )


@pytest.mark.parametrize("sizes", ["equal", pytest.param("each its own", marks=pytest.mark.slow)])
def test_stored_states_are_some_of_all_states(sizes, set_chunk_sizes):
    """In batches of compiled programs too; and one failure of a batch raises."""
    sizes = 1.0 if sizes == "equal" else rng(182).uniform(0.5, 1.0, PADDED)
    units = rng(183).uniform(0.9, 1.0, (2, 8))
    every = [padded_flight(1, factors, sizes) for factors in units]
    set_chunk_sizes(chunk=CHUNK)
    for stride in (2, 13):
        batch = jax.jit(jax.vmap(partial(padded_flight, stride, sizes=sizes)))
        some = batch(units)
        for i, one in enumerate(every):
            for name in ("R", "pi", "x", "v", "t"):
                actual, desired = getattr(some, name)[i], getattr(one, name)[::stride]
                np.testing.assert_allclose(actual, desired, rtol=0, atol=1e-13)
        assert np.all(some.solver_info.converged)
    units[1, 3] = np.nan  # the push
    with pytest.raises(RAISED, match="A value failed a check inside a compiled"):
        jax.block_until_ready(batch(units).x)


@pytest.mark.parametrize("stride", [2, *(pytest.param(x, marks=pytest.mark.slow) for x in (1, 13))])
def test_derivatives(stride, set_chunk_sizes):
    if stride > 1:
        set_chunk_sizes(chunk=CHUNK)

    def last(units):
        trajectory = padded_flight(stride, units)
        return trajectory.x[-1], trajectory.v[-1]

    assert_gradient_agrees(last, np.ones(8), rtol=1e-10, forward=stride == 1)


def test_no_steps():
    trajectory = simulate(0.1, steps=0, force=FORCE, torque=THRUSTERS, **FLIGHT)
    np.testing.assert_array_equal(trajectory.x, X0[None])
    np.testing.assert_array_equal(trajectory.v, V0[None])
    with pytest.raises(RAISED, match="position or the velocity is not finite at 0 s"):
        simulate(0.1, steps=0, x0=np.array([0.0, np.nan, 0.0]))


def test_given_times_have_the_states_of_their_steps():
    times, parts = T0 + SPAN * np.linspace(0, 1, 5), STEPS // 4
    some = fly(None, times=times, substeps=parts, steps=None)
    every = fly(SPAN / STEPS, t0=T0)
    np.testing.assert_allclose(some.t, times, rtol=1e-15)
    for name in ("x", "v", "R"):
        actual, desired = getattr(some, name), getattr(every, name)[::parts]
        np.testing.assert_allclose(actual, desired, rtol=0, atol=1e-13)


def in_single_precision(tree):
    return jax.tree.map(lambda x: x if callable(x) else jnp.asarray(x, jnp.float32), tree)


def test_single_precision_stays():
    law, torque, body = in_single_precision((FORCE, THRUSTERS, BODY))
    arguments = in_single_precision(FLIGHT | {"R0": R0, "pi0": PI0, "t0": T0})
    trajectory = simulate(SPAN / STEPS, body, force=law, torque=torque, **arguments)
    for name in ("R", "pi", "x", "v"):
        actual, desired = getattr(trajectory, name), getattr(fly(SPAN / STEPS, t0=T0), name)
        assert actual.dtype == jnp.float32
        np.testing.assert_allclose(actual, desired, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    "arguments",
    [
        {"gravity": in_single_precision(GRAVITY)},
        {"v0": in_single_precision(V0)},
        {"mass": 2.0, "force": lgvi.AirDrag(0.1)},
        {"mass": 2.0, "force": lgvi.AppliedForce(in_single_precision(PUSH), "space")},
    ],
)
def test_what_is_not_given_has_no_precision(arguments):
    start = in_single_precision((BODY, R0, PI0))
    trajectory = jax.eval_shape(lambda start: simulate(0.1, *start, **arguments), start)
    dtypes = {getattr(trajectory, name).dtype for name in ("R", "pi", "x", "v")}
    assert dtypes == {jnp.dtype("float32")}


SAMPLED = lgvi.SampledVector(np.array([0.0, 1.0]), np.stack([PUSH, PUSH]))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"force": turning}, ValueError, "`mass` must be given where there is a `force`"),
        ({"mass": 0.0}, ValueError, "`mass` must be above 0 kg and finite, but is 0"),
        ({"mass": -1.0}, ValueError, "`mass` must be above 0 kg and finite, but is -1"),
        ({"mass": np.nan}, ValueError, "`mass` must be above 0 kg and finite, but is nan"),
        ({"mass": np.inf}, ValueError, "`mass` must be above 0 kg and finite, but is inf"),
        ({"mass": np.ones(3)}, ValueError, r"`mass` must have shape \(\), .* is \(3,\)"),
        ({"mass": "heavy"}, TypeError, "`mass` must be an array or a number"),
        ({"gravity": 9.81}, ValueError, r"`gravity` must have shape \(3,\), .* is \(\)"),
        ({"x0": np.zeros(2)}, ValueError, r"`x0` must have shape \(3,\), .* is \(2,\)"),
        ({"v0": np.zeros((4, 3))}, ValueError, r"`v0` must have shape \(3,\), .* is \(4, 3\)"),
        ({"force": PUSH}, TypeError, r"`force` must be a function of \(t, R, omega, v\), but is"),
        ({"force": lgvi.AirDrag}, TypeError, r"`force` must be a function of .*class"),
        ({"force": lambda t, R, v, omega: v}, TypeError, "`v` where `omega` is given"),
        ({"force": lambda t, R: PUSH}, TypeError, "`force` must be .*too many positional"),
        (
            {"force": lambda *_: 1.0},
            ValueError,
            r"Argument `force\(t, R, omega, v\)` must have shape",
        ),
        ({"force": lambda *_: None}, TypeError, r"`force\(t, R, omega, v\)` must be an array"),
        (
            {"force": lambda t, R, omega, v: PUSH * float(v[0])},
            TypeError,
            r"`force\(t, R, omega, v\)` must be made of functions of `jax.numpy`",
        ),
        (
            {"force": 2 * lgvi.AppliedForce(SAMPLED) + turning, "t0": 0.7},
            RAISED,
            "`SampledVector` must cover those .* from 0.7 to 1.1 s, but go from 0 to 1 s",
        ),
    ],
)
def test_bad_input_is_named(arguments, error, message, unchecked):
    if "force" in arguments and "`mass`" not in message:
        arguments = {"mass": 1.0} | arguments
    with pytest.raises(error, match=message):
        simulate(0.1, steps=4, **arguments)


BROKEN = {
    "function": lambda t, R, omega, v: jnp.where(t > 0.25, jnp.nan, 1.0) * R[0],
    "of the velocity": lambda t, R, omega, v: jnp.where(t > 0.25, jnp.nan, 1.0) * v,
    "samples": lgvi.AppliedForce(lgvi.SampledVector(np.array([0.0, 1.0]), np.ones((2, 3)))),
}


@pytest.mark.parametrize(
    "force",
    ["function", "samples", pytest.param("of the velocity", marks=pytest.mark.slow)],
)
def test_a_force_that_is_no_number_is_seen(force):
    """And the rotation, which it does not touch, is as it was."""
    arguments = {
        "force": BROKEN[force],
        "steps": 4,
        "t0": 0.7 if force == "samples" else 0.0,
    } | FLIGHT
    quiet = simulate(0.1, settings={"throw": False}, **arguments)
    finite = np.arange(5) < (1 if force == "samples" else 3)
    np.testing.assert_array_equal(quiet.solver_info.converged, finite[1:])
    np.testing.assert_array_equal(np.isfinite(quiet.v).all(axis=1), finite)
    assert np.all(np.isfinite(quiet.pi))
    words = "must cover" if force == "samples" else "velocity is not finite at 0.3 s: the force"
    with pytest.raises(RAISED, match=words):
        simulate(0.1, **arguments)


def test_drag_that_is_too_fast_for_the_step_is_no_answer():
    """Where Newton's method does not find the velocity at the end of a step."""

    def brake(quadratic, **settings):
        force = lgvi.AirDrag(0.0, quadratic)
        arguments = {"steps": 4, "mass": 1.0, "v0": np.array([10.0, 0.0, 0.0])}
        return simulate(0.1, force=force, settings=settings, **arguments)

    slow = brake(0.3)
    v = np.asarray(slow.v[:, 0])
    np.testing.assert_allclose(
        np.diff(v), -0.05 * 0.3 * (v[1:] * abs(v[1:]) + v[:-1] ** 2), rtol=1e-12
    )
    with pytest.raises(RAISED, match="changes too fast with the velocity for the step"):
        brake(30.0)
    assert not brake(30.0, throw=False).solver_info.converged.any()


def test_a_step_of_the_rotation_that_fails_is_named_before_the_path():
    def law(t, R):
        return jnp.where(t > 0.25, jnp.nan, 0.0) * R[0]

    with pytest.raises(RAISED, match="Step 2 did not converge"):
        simulate(0.1, steps=4, torque=law, force=lgvi.AppliedForce(PUSH), **FLIGHT)


OMEGA, VELOCITY, TIME = np.array([0.3, -1.0, 0.7]), np.array([5.0, -3.0, 2.0]), 0.4
STATE = TIME, rotation(21), OMEGA, VELOCITY


@pytest.mark.parametrize("wind", [(0, 0, 0), WIND, lambda t: t * jnp.asarray(WIND), SAMPLED])
def test_air_drag_is_its_formula(wind):
    t, R, _, v = STATE
    blows = {3: lambda: np.asarray(wind)}.get(np.size(wind), lambda: np.asarray(wind(t)))()
    for D, C in ((0.3, 0.1), (np.diag(LINEAR), LINEAR), (LINEAR, QUADRATIC)):
        force = lgvi.AirDrag(D, C, wind)(*STATE)
        np.testing.assert_allclose(force, drag(R, v, D, C, blows), rtol=1e-13)


def test_air_drag_has_a_slope_in_still_air():
    t, R, omega, _ = STATE
    law = partial(lgvi.AirDrag(LINEAR, QUADRATIC, WIND), t, R, omega)
    force, *slopes = jax.jit(lambda v: (law(v), jax.jacfwd(law)(v), jax.jacrev(law)(v)))(WIND)
    assert not np.any(force)
    for slope in slopes:
        np.testing.assert_allclose(slope, -LINEAR @ R.T, rtol=0, atol=1e-15)


def test_a_known_force_is_in_its_frame():
    t, R, _, _ = STATE
    space, body = (lgvi.AppliedForce(lambda t: t * jnp.asarray(PUSH), x) for x in ("space", "body"))
    np.testing.assert_allclose(space(*STATE), t * R.T @ PUSH, rtol=1e-14)
    np.testing.assert_allclose(body(*STATE), t * PUSH, rtol=1e-14)


def test_laws_are_added_and_multiplied():
    one, other = lgvi.AppliedForce(PUSH), lgvi.AirDrag(LINEAR)
    known, dragged, turned = (
        PUSH,
        drag(STATE[1], VELOCITY, quadratic=0, wind=0),
        turning(*STATE[:4]),
    )
    for law, force in (
        (one + other, known + dragged),
        (sum([one, other, 2 * one]), 3 * known + dragged),
        (turning + one, turned + known),
        (one + turning, turned + known),
        (-(3 * other) * 0.5 + one, known - 1.5 * dragged),
        (2 * (one + turning), 2 * (known + turned)),
        (sum([one]), known),
    ):
        assert isinstance(law, lgvi.AbstractForce)
        np.testing.assert_allclose(law(*STATE), force, rtol=1e-13)


def test_samples_are_checked_in_sums_and_multiples():
    law = 2 * (turning + lgvi.AppliedForce(SAMPLED)) + lgvi.AirDrag(0.0, wind=SAMPLED)
    for last, covered in ((1.0, True), (1.1, False)):
        checked = law.during(lambda last=last: jnp.array([0.0, last]), False)
        assert np.all(np.isfinite(checked(*STATE))) == covered


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: ANY.AirDrag([1.0, 2.0]), ValueError, r"`linear` must have shape .* is \(2,\)"),
        (lambda: ANY.AirDrag(0, np.ones((2, 3))), ValueError, "`quadratic` must have shape"),
        (lambda: ANY.AirDrag(0, 0, [1.0]), ValueError, "`wind` must have shape"),
        (lambda: ANY.AirDrag(0, 0, lambda: 0), TypeError, "`wind` must be a function"),
        (lambda: ANY.AppliedForce(1.0), ValueError, "`force` must have shape"),
        (lambda: ANY.AppliedForce(PUSH, "earth"), ValueError, '`frame` must be "body" or "space"'),
        (lambda: ANY.Thruster([1.0], PUSH), ValueError, "`place` must have shape"),
        (lambda: ANY.Thruster(PLACE, 1.0), ValueError, "`thrust` must have shape"),
        (lambda: ANY.Thruster(PLACE, PUSH, None), ValueError, "`frame` must be"),
        (lambda: LAWS.ForceSum(()), TypeError, "`terms` must be a tuple of laws"),
        (lambda: LAWS.ForceSum((PUSH,)), TypeError, r"`terms\[0\]` must be a function"),
        (lambda: LAWS.ScaledForce(PUSH, turning), ValueError, "`factor` must have shape"),
        (lambda: "x" * ANY.AppliedForce(PUSH), TypeError, "`factor` must be an array or a number"),
        (lambda: ANY.AppliedForce(PUSH) + 1.0, TypeError, "unsupported operand"),
    ],
)
def test_wrong_laws_are_named(make, error, words, unchecked):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize("frame", ["body", "space"])
def test_a_thruster_turns_and_pushes(frame):
    t, R, _, _ = STATE
    law = lgvi.Thruster(PLACE, THRUST, frame)
    force = THRUST if frame == "body" else R.T @ THRUST
    np.testing.assert_allclose(law(t, R), np.cross(PLACE, force), rtol=1e-13)
    np.testing.assert_allclose(law.force_law(*STATE), force, rtol=1e-14)
    assert law.depends_on_attitude == (frame == "space")
    assert law.highest_order == 8
    assert lgvi.Thruster(PLACE, SAMPLED, frame).highest_order == 2


def faces(count=9):
    random = rng(184)
    areas, normals, centres = random.uniform(size=count), *random.normal(size=(2, count, 3))
    return lgvi.Facets(areas, normals, centres)


def loop_over_faces(facets, vector, force_on):
    """Force and torque: the sums over the faces that look towards a vector, in NumPy."""
    force, torque = np.zeros(3), np.zeros(3)
    for i, (area, normal, centre) in enumerate(
        zip(facets.areas, facets.normals, facets.centres, strict=True)
    ):
        n = np.asarray(normal) / np.linalg.norm(normal)
        if n @ vector > 0:
            f = float(area) * (n @ vector) * force_on(i, n)
            force, torque = force + f, torque + np.cross(centre, f)
    return force, torque


def test_sunlight_pushes_as_the_sum_over_the_faces():
    t, R, _, _ = STATE
    facets, sun = faces(), np.array([0.3, 2.0, -1.0])
    mirrored, diffuse, pressure = *rng(185).uniform(0, 0.5, (2, 9)), 3e-3
    s = R.T @ sun / np.linalg.norm(sun)

    def on_face(i, n):
        along = 2 * (mirrored[i] * (n @ s) + diffuse[i] / 3)
        return -pressure * ((1 - mirrored[i]) * s + along * n)

    force, torque = loop_over_faces(facets, s, on_face)
    law = lgvi.SolarPressure(facets, sun, mirrored, diffuse, pressure)
    np.testing.assert_allclose(law.force_law(*STATE), force, rtol=1e-12)
    np.testing.assert_allclose(law(t, R), torque, rtol=1e-12)


def test_thin_air_pushes_as_the_sum_over_the_faces():
    t, R, _, _ = STATE
    facets, velocity = faces(), np.array([500.0, -7000.0, 2500.0])
    u = R.T @ velocity
    force, torque = loop_over_faces(facets, u, lambda i, n: -1.1 * 2e-9 * u)
    law = lgvi.FreeMolecularDrag(facets, velocity, 2e-9)
    np.testing.assert_allclose(law.force_law(*STATE), force, rtol=1e-12)
    np.testing.assert_allclose(law(t, R), torque, rtol=1e-12)


def test_a_ball_is_pushed_by_what_falls_on_its_shadow():
    R, radius, count = STATE[1], 0.7, 20_000
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)  # faces of equal area on a spiral
    across = np.sqrt(1 - z**2)
    normals = np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
    ball = lgvi.Facets(np.full(count, 4 * np.pi * radius**2 / count), normals, radius * normals)
    shadow, sun, speed = np.pi * radius**2, np.array([0.6, 0.0, 0.8]), 7e3
    for law, expected in (
        (lgvi.SolarPressure(ball, sun, pressure=2e-5), -2e-5 * shadow * R.T @ sun),
        (
            lgvi.FreeMolecularDrag(ball, speed * sun, 1e-11, 2.0),
            -1e-11 * speed**2 * shadow * R.T @ sun,
        ),
    ):
        error = law.force_law(*STATE) - expected
        assert np.linalg.norm(error) < 1e-3 * np.linalg.norm(expected)


def test_sums_and_multiples_of_torques_have_those_of_the_forces():
    R, thruster = STATE[1], lgvi.Thruster(PLACE, THRUST)
    sun = lgvi.SolarPressure(faces(), WIND, pressure=1.0)
    torque: Any = 3 * (thruster - lgvi.Thruster(HOOK, PULL, "space") / 2) + sun
    torque += lgvi.ConstantTorque(PUSH)
    expected = 3 * THRUST - 1.5 * R.T @ PULL + np.asarray(sun.force_law(*STATE))
    np.testing.assert_allclose(torque.force_law(*STATE), expected, rtol=1e-13)
    without = lgvi.ConstantTorque(PUSH) - lgvi.LinearDamping(np.eye(3)) + (lambda t, R: R[0])
    assert without.force_law is None
    assert (2 * without).force_law is None
