"""Errors raised while a compiled program runs, with the values that caused them."""

import re
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgvi.modules.errors import error_if

# Once a call has succeeded, `jax.jit` turns errors of the running program into ValueError.
RAISED = (RuntimeError, ValueError)


def checked(x, limit):
    return error_if(x, x > limit, lambda x, limit: f"{x:g} exceeds {limit:g}", lambda: (x, limit))


def test_what_passes_comes_back_unchanged_in_its_type(dtype):
    tree = {"a": jnp.asarray([1.5, jnp.inf], dtype), "n": jnp.arange(3)}
    back = jax.jit(lambda tree: error_if(tree, jnp.asarray(False), str, tuple))(tree)
    for name, value in tree.items():
        assert back[name].dtype == value.dtype
        np.testing.assert_array_equal(back[name], value)


def test_the_message_holds_the_values_of_this_call():
    run = jax.jit(checked)
    assert run(1.0, 2.0) == 1
    for value in (3.0, 4.0):
        with pytest.raises(RAISED, match=f"{value:g} exceeds 2"):
            run(value, 2.0)
    assert run(1.0, 2.0) == 1


def test_under_vmap_the_message_describes_the_first_failure():
    x = jnp.array([[0.0, 1.0, 1.5], [0.0, 7.0, 9.0]])
    run = jax.jit(jax.vmap(jax.vmap(checked, in_axes=(0, None)), in_axes=(0, 0)))
    np.testing.assert_array_equal(run(x, jnp.array([2.0, 9.0])), x)
    with pytest.raises(RAISED, match="7 exceeds 2"):
        run(x, jnp.array([2.0, 2.0]))
    with pytest.raises(RAISED, match=r"1 exceeds 0\.5"):
        run(x, jnp.array([0.5, 2.0]))
    assert run(x[:, :0], jnp.array([2.0, 9.0])).shape == (2, 0)


def test_under_vmap_a_condition_of_the_limit_alone_is_described():
    run = jax.jit(jax.vmap(checked, in_axes=(None, 0)))
    with pytest.raises(RAISED, match="3 exceeds 2"):
        run(jnp.asarray(3.0), jnp.array([4.0, 2.0, 1.0]))


def test_derivatives_pass_and_do_not_hide_the_failure():
    def f(x):
        return 3 * checked(x, jnp.asarray(2.0))

    for transform in (jax.grad, jax.jacfwd):
        run = jax.jit(transform(f))
        assert run(1.0) == 3
        with pytest.raises(RAISED, match="5 exceeds 2"):
            run(5.0)


def test_the_check_of_a_batch_stays_a_conditional():
    """Else the callback would run for every batch, whether something failed or not."""
    batch = jax.vmap(jax.vmap(lambda x: checked(x, jnp.asarray(1.0))))
    assert "cond[" in str(jax.make_jaxpr(batch)(jnp.zeros((2, 3))))


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_calls_in_threads_keep_their_messages_and_results(jit):
    run = jit(lambda x: checked(x, jnp.asarray(0.5)))
    run(jnp.array(0.0))

    def is_right(k):
        if k % 4 == 0:
            return run(jnp.array(-float(k))) == -k
        with pytest.raises(RAISED) as error:
            jax.block_until_ready(run(jnp.array(float(k))))
        return re.search(rf"(?<!\d){k} exceeds 0\.5", str(error.value))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(is_right, range(100)))


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_a_failure_while_another_one_is_handled_has_its_message(jit):
    run = jit(lambda x: checked(x, jnp.asarray(0.5)))
    try:
        run(jnp.array(3.0))
    except RAISED:
        with pytest.raises(RAISED) as error:
            run(jnp.array(4.0))
        assert "4 exceeds 0.5" in str(error.value)
    else:
        pytest.fail("nothing was raised")
