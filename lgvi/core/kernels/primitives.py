"""Functions that JAX transforms as a whole, by their own rules.

`jax.custom_jvp` has the same purpose, but JAX drops its rule when it linearises a loop, and
second derivatives fail. The rules of a primitive always hold.

The last axes of all arrays are batch axes, so that a component of all bodies of a batch is one
contiguous vector. All arrays have the same number of batch axes, each with the size of the batch
or with size one; those of results have the size of the batch.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Arrays = Sequence[Array]


def differentiable(
    function: Callable[..., Arrays], tangents: Callable[[Arrays, Arrays, Arrays], Arrays]
) -> Callable[..., Arrays]:
    """`function(static, *arrays)`; its derivative is `tangents(out, primals, tangents)`."""
    primitive = _primitive(function)

    def jvp(primals, changes, *, static):
        out = primitive.bind(*primals, static=static)
        return out, tangents(out, primals, [ad.instantiate_zeros(t) for t in changes])

    ad.primitive_jvps[primitive] = jvp
    return lambda static, *arrays: primitive.bind(*arrays, static=static)


class _Signature(NamedTuple):
    """Numbers of arguments of a linear function, and its results in use."""

    at: int  # number of the first arrays, in which the function is not linear
    vectors: int  # number of the arrays that follow, in which the function is linear
    results: tuple[bool, ...]  # which of all results are in use


def linear(
    function: Callable[[Arrays, Arrays], Arrays],
    adjoint: Callable[[Arrays, Sequence[Array | None]], Arrays],
    results: int,
) -> Callable[[Arrays, Arrays], Arrays]:
    """`function(at, vectors)` with a number of `results`, linear in `vectors`.

    The derivative with respect to `at` is that of the code. The transpose is
    `adjoint(at, cotangents)`, with None for cotangents that are zero. There may be more results
    than `vectors`. All batch axes of `vectors` have the size of the batch.
    """

    def evaluate(static, *arrays):
        out = function(arrays[: static.at], arrays[static.at :])
        return [x for x, used in zip(out, static.results, strict=True) if used]

    def evaluate_adjoint(static, *arrays):
        known = iter(arrays[static.at :])
        cotangents = [next(known) if used else None for used in static.results]
        return adjoint(arrays[: static.at], cotangents)[: static.vectors]

    def transpose(cotangents, *arrays, static):
        nonzero = iter([type(ct) is not ad.Zero for ct in cotangents])
        static = static._replace(results=tuple(r and next(nonzero) for r in static.results))
        cotangents = [ct for ct in cotangents if type(ct) is not ad.Zero]
        out = backward.bind(*arrays[: static.at], *cotangents, static=static)
        needed = [ad.is_undefined_primal(x) for x in arrays[static.at :]]
        return [None] * static.at + [x if n else None for x, n in zip(out, needed, strict=True)]

    def transpose_adjoint(cotangents, *arrays, static):
        vectors = [ad.instantiate_zeros(ct) for ct in cotangents]
        out = forward.bind(*arrays[: static.at], *vectors, static=static)
        return [None] * static.at + list(out)

    # The names of both primitives in the compiled program.
    evaluate.__name__, evaluate_adjoint.__name__ = function.__name__, adjoint.__name__
    forward, backward = (_primitive(f, whole=True) for f in (evaluate, evaluate_adjoint))
    ad.primitive_jvps[forward] = partial(_linear_jvp, forward, evaluate)
    ad.primitive_jvps[backward] = partial(_linear_jvp, backward, evaluate_adjoint)
    ad.primitive_transposes[forward] = transpose
    ad.primitive_transposes[backward] = transpose_adjoint

    def call(at, vectors):
        static = _Signature(len(at), len(vectors), (True,) * results)
        return forward.bind(*at, *vectors, static=static)

    return call


def _linear_jvp(primitive, evaluate, primals, tangents, *, static):
    out = primitive.bind(*primals, static=static)
    at, vectors = primals[: static.at], primals[static.at :]
    varied = [type(t) is not ad.Zero for t in tangents]
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    dat, dvectors = tangents[: static.at], tangents[static.at :]
    dout = None
    if any(varied[static.at :]):
        dout = primitive.bind(*at, *dvectors, static=static)
    if any(varied[: static.at]):
        _, more = jax.jvp(lambda *at: evaluate(static, *at, *vectors), tuple(at), tuple(dat))
        dout = more if dout is None else [a + b for a, b in zip(dout, more, strict=True)]
    return out, dout


def _primitive(evaluate: Callable[..., Arrays], whole: bool = False) -> Primitive:
    """`evaluate(static, *arrays)`; if `whole`, batch axes from `static.at` on have full size."""
    primitive = Primitive(evaluate.__name__)
    primitive.multiple_results = True
    compiled = jax.jit(evaluate, static_argnums=0)

    def call(*arrays, static):
        return compiled(static, *arrays)

    @lru_cache
    def shapes(*arrays, static):
        return [jax.typeof(x) for x in compiled.eval_shape(static, *arrays)]

    def batch(arrays, axes, *, static):
        size = next(x.shape[i] for x, i in zip(arrays, axes, strict=True) if i is not None)
        arrays = [
            x[..., None] if i is None else jnp.moveaxis(x, i, -1)
            for x, i in zip(arrays, axes, strict=True)
        ]
        if whole:
            first = static.at
            arrays[first:] = [jnp.broadcast_to(x, (*x.shape[:-1], size)) for x in arrays[first:]]
        out = primitive.bind(*arrays, static=static)
        return out, [x.ndim - 1 for x in out]

    primitive.def_impl(call)
    primitive.def_abstract_eval(shapes)
    mlir.register_lowering(primitive, mlir.lower_fun(call, multiple_results=True))
    batching.primitive_batchers[primitive] = batch
    return primitive
