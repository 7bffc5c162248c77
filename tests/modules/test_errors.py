"""Errors that depend on values: those of eager calls name them, those of compiled ones do not."""

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgvi.modules.errors import WITHOUT_VALUES, error_if

# Once a call has succeeded, `jax.jit` turns errors of the running program into ValueError.
RAISED = (RuntimeError, ValueError)
PLAIN = re.escape(WITHOUT_VALUES)


def checked(x, limit):
    return error_if(x, x > limit, lambda x, limit: f"{x:g} exceeds {limit:g}", lambda: (x, limit))


def test_what_passes_comes_back_unchanged_in_its_type(dtype):
    tree = {"a": jnp.asarray([1.5, jnp.inf], dtype), "n": jnp.arange(3)}
    back = jax.jit(lambda tree: error_if(tree, jnp.asarray(False), str, tuple))(tree)
    for name, value in tree.items():
        assert back[name].dtype == value.dtype
        np.testing.assert_array_equal(back[name], value)


def test_an_eager_call_names_its_values():
    one, two, three = (jnp.asarray(float(x)) for x in (1, 2, 3))
    assert checked(one, two) == 1
    for transform in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian):
        with pytest.raises(RuntimeError, match=r"^3 exceeds 2") as raised:
            transform(lambda x: x * checked(x, two))(three)
        assert raised.type is RuntimeError


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_a_compiled_call_raises_without_values(jit):
    run = jit(checked)
    one, two, three = (jnp.asarray(float(x)) for x in (1, 2, 3))
    for _ in range(2):
        assert run(one, two) == 1
        with pytest.raises(RAISED, match=PLAIN):
            run(three, two)


def test_one_failure_in_a_batch_raises():
    x = jnp.array([[0.0, 1.0, 1.5], [0.0, 7.0, 9.0]])
    batch = jax.vmap(jax.vmap(checked, in_axes=(0, None)))
    for run in (batch, jax.jit(batch)):
        np.testing.assert_array_equal(run(x, jnp.array([2.0, 9.0])), x)
        for limits in ([2.0, 8.0], [0.5, 9.0]):
            with pytest.raises(RAISED, match=PLAIN):
                run(x, jnp.array(limits))
        assert run(x[:, :0], jnp.array([2.0, 9.0])).shape == (2, 0)


def test_one_limit_in_a_batch_that_is_exceeded_raises():
    run = jax.jit(jax.vmap(checked, in_axes=(None, 0)))
    with pytest.raises(RAISED, match=PLAIN):
        run(jnp.asarray(3.0), jnp.array([4.0, 2.0, 1.0]))


def test_a_value_of_a_batch_that_is_not_known_is_not_named():
    """Here the failure itself does not depend on the batch."""
    limit = jnp.asarray(2.0)

    def run(x):
        return error_if(x, limit > 1, str, lambda: (x,))

    with pytest.raises(RuntimeError, match=PLAIN):
        jax.vmap(run)(jnp.zeros(3))


def test_the_check_of_a_batch_that_is_not_compiled_compiles_once(caplog):
    batch, x = jax.vmap(lambda x: checked(x, 1.0)), jnp.zeros(7)
    with jax.log_compiles():
        batch(x)
        assert "Compiling" in caplog.text
        caplog.clear()
        batch(x)
    assert "Compiling" not in caplog.text


def test_derivatives_pass_and_do_not_hide_the_failure():
    def f(x):
        return 3 * checked(x, jnp.asarray(2.0))

    def in_a_loop(x):
        return jax.lax.scan(lambda y, _: (jax.checkpoint(checked)(y, 2.0), None), x, length=2)[0]

    for transform in (jax.grad, jax.jacfwd):
        for function, derivative in ((f, 3), (in_a_loop, 1)):
            run = jax.jit(transform(function))
            assert run(1.0) == derivative
            with pytest.raises(RAISED, match=PLAIN):
                run(5.0)


@pytest.mark.parametrize("devices", [1, 2])
def test_the_check_of_a_batch_stays_a_conditional(devices, monkeypatch):
    """Else the callback would run for every batch, whether something failed or not."""
    monkeypatch.setattr(jax, "device_count", lambda: devices)
    batch = jax.vmap(jax.vmap(lambda x: checked(x, jnp.asarray(1.0))))
    assert "cond[" in str(jax.make_jaxpr(jax.jit(batch))(jnp.zeros((2, 3))))


@pytest.mark.parametrize("jit", [None, jax.jit, eqx.filter_jit])
def test_calls_in_threads_keep_their_errors_and_results(jit):
    def eager(x):
        return checked(x, jnp.asarray(0.5))

    run = eager if jit is None else jit(eager)
    run(jnp.array(0.0))

    def is_right(k):
        if k % 4 == 0:
            return run(jnp.array(-float(k))) == -k
        with pytest.raises(RAISED) as error:
            jax.block_until_ready(run(jnp.array(float(k))))
        wanted = rf"(?<!\d){k} exceeds 0\.5" if jit is None else PLAIN
        return re.search(wanted, str(error.value))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(is_right, range(100)))


NOT_A_NUMBER = """
import jax, jax.numpy as jnp
from lgvi.modules.errors import error_if
x = {"a": jnp.ones(2), "n": jnp.array(True)}
run = lambda failed: error_if(x, failed, lambda: "wrong", tuple)
for function in (run, jax.jit(run)):
    good, bad = function(jnp.array(False)), function(jnp.array(True))
    assert jnp.all(good["a"] == 1) and good["n"]
    assert jnp.all(jnp.isnan(bad["a"])) and not bad["n"]
"""


def test_the_variable_of_equinox_turns_failures_into_nan(monkeypatch):
    monkeypatch.setenv("EQX_ON_ERROR", "nan")
    subprocess.run([sys.executable, "-c", NOT_A_NUMBER], check=True)
