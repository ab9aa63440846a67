"""Matrix-free operators P, defined by a linear function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.scipy.sparse.linalg
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class MatrixFree(AbstractOperator):
    """P v = fn(v) for a linear function fn, with P⁻¹ by conjugate gradients.

    The inverse satisfies ‖v − P u‖ ≤ tol ‖v‖; the error decreases by a factor e in at most √κ
    iterations (κ = norm/m). If the iteration does not converge, the result is NaN. The derivative, in
    v and in everything that fn depends on, is another solve, not an unrolled iteration.

    **Arguments:** `fn`: linear, traceable; `m`, `norm`: bounds m‖v‖² ≤ ⟨Pv, v⟩ ≤ norm‖v‖², which are
    reported as declared. `weights`: those of the control space, if it has any: P is self-adjoint in
    its inner product, and conjugate gradients are applied to w·P. `tol`: the relative residual.

    **Raises:** `dvax.InputError` unless 0 < m ≤ norm < ∞. `dvax.Problem` raises it if random vectors
    refute the bounds, or that fn is linear and self-adjoint in the control space.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.MatrixFree(lambda v: 3.0 * v + jnp.sum(v), m=3.0, norm=6.0)
    >>> P.inverse(jnp.array([6.0, 6.0, 6.0])).tolist()
    [1.0, 1.0, 1.0]

    ```
    """

    fn: Callable[[Tree], Tree]
    m: jax.Array
    norm: jax.Array
    weights: Tree
    tol: float = eqx.field(static=True)

    def __init__(
        self,
        fn: Callable[[Tree], Tree],
        m: Any,
        norm: Any,
        *,
        weights: Any = 1.0,
        tol: float = 1e-12,
    ):
        name = "dvax.operators.MatrixFree(m, norm)"
        _tree.check_kind(
            fn, Callable, "dvax.operators.MatrixFree(fn)", "it must be a function of v, linear in v",
            "Write lambda v: ..., or use dvax.operators.Dense for a matrix",
        )  # fmt: skip
        _tree.check_tolerance(tol, "dvax.operators.MatrixFree(tol)")
        self.fn, self.tol = fn, tol
        bound = "Give one bound for the whole spectrum of P"
        self.m = _tree.as_number(m, "dvax.operators.MatrixFree(m)", bound)
        self.norm = _tree.as_number(norm, "dvax.operators.MatrixFree(norm)", bound)
        self.weights = _tree.as_float(weights, "dvax.operators.MatrixFree(weights)")
        _tree.require(
            lambda: (self.m > 0) & (self.m <= self.norm) & jnp.isfinite(self.norm),
            name,
            (self.m, self.norm),
            "P must be coercive and bounded: 0 < m ≤ norm < ∞",
            "Give a lower and an upper bound of its spectrum",
        )

    def apply(self, v: Tree) -> Tree:
        return self.fn(v)

    def inverse(self, v: Tree) -> Tree:
        def weighted(u: Tree) -> Tree:
            if _is_number(self.weights):
                return u  # one number for all entries cancels
            return jax.tree_util.tree_map(jnp.multiply, self.weights, u)

        right_side = weighted(v)
        dtype = jnp.result_type(*jax.tree_util.tree_leaves(v))
        tol = max(self.tol, 4.0 * float(jnp.finfo(dtype).eps))
        u, _ = jax.scipy.sparse.linalg.cg(
            lambda u: weighted(self.fn(u)), right_side, tol=0.1 * tol, atol=0.0
        )
        # Check the true residual, from which that of the recursion deviates by roundoff.
        residual = _tree.sub(right_side, weighted(self.fn(u)))
        bound = 10.0 * tol * jnp.sqrt(self.norm / self.m) * _norm(right_side)
        converged = _norm(residual) <= bound
        return jax.tree_util.tree_map(lambda leaf: jnp.where(converged, leaf, jnp.nan), u)

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.MatrixFree(fn)"
        zeros = space.like()
        out = jax.eval_shape(self.fn, zeros)
        if not _tree.same_shape(out, zeros):
            raise input_error(
                name,
                f"a value of shape {_tree.shapes(out)}",
                f"P must map the control space, of shape {_tree.shapes(zeros)}, to itself",
                "Return that shape from fn",
            )
        self._check_weights(space)
        if _tree.is_concrete((self.m, self.norm, space.weights())):
            self._check_properties(space, name)

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(self.m, self.norm, exact=False, declared=True)

    def _check_weights(self, space: AbstractSpace) -> None:
        zeros, given, expected = space.zeros(), self.weights, space.weights()
        if _is_number(given):
            # All weights of the space, and of all its parts, must then be equal.
            fits = all(_is_constant(w) for w in jax.tree_util.tree_leaves(expected))
            first = jnp.stack([jnp.ravel(w)[0] for w in jax.tree_util.tree_leaves(expected)])
            fits = fits and _is_constant(first)
        else:
            fits = _tree.same_shape(given, zeros) and all(
                np.allclose(np.asarray(a), np.asarray(b), rtol=1e-12, atol=0.0)
                for a, b in zip(*map(jax.tree_util.tree_leaves, (given, expected)), strict=True)
            )
        if not fits:
            raise input_error(
                "dvax.operators.MatrixFree(weights)",
                _tree.short(given),
                f"the weights must be those of {space!r}, in which P is self-adjoint",
                "Pass weights=space.weights()",
            )

    def _check_properties(self, space: AbstractSpace, name: str) -> None:
        """Raise an `InputError` if three random vectors refute a declared property of fn."""
        flat, unflatten = jax.flatten_util.ravel_pytree(space.zeros())
        rng = np.random.default_rng(0)
        draws = [unflatten(jnp.asarray(rng.normal(size=flat.size), flat.dtype)) for _ in range(3)]
        images = [self.fn(v) for v in draws]
        a, b = draws[0], draws[1]
        eps = float(jnp.finfo(flat.dtype).eps)
        size = float(self.norm * space.norm(a) * space.norm(b))
        asymmetry = float(jnp.abs(space.inner(images[0], b) - space.inner(a, images[1])))
        joint = self.fn(_tree.add(a, _tree.scale(2.0, b)))
        separate = _tree.add(images[0], _tree.scale(2.0, images[1]))
        nonlinearity = float(space.norm(_tree.sub(joint, separate)))
        slack = 1e5 * eps
        quotients = [
            float(space.inner(p, v) / space.inner(v, v)) for p, v in zip(images, draws, strict=True)
        ]
        low, high = float(self.m) * (1 - slack), float(self.norm) * (1 + slack)
        for wrong, given, rule in (
            (nonlinearity > slack * float(self.norm * (space.norm(a) + space.norm(b))),
             f"‖P(a + 2b) − Pa − 2Pb‖ = {nonlinearity:.3g}", "P must be linear"),
            (asymmetry > slack * size, f"⟨Pa, b⟩ − ⟨a, Pb⟩ = {asymmetry:.3g}",
             f"P must be self-adjoint in {space!r}"),
            (not all(low <= q <= high for q in quotients),
             f"⟨Pv, v⟩/‖v‖² = {min(quotients):.6g} to {max(quotients):.6g} for random v",
             "the declared m and norm must enclose it, or bounds that depend on them are wrong"),
        ):  # fmt: skip
            if wrong:
                raise input_error(name, given, rule, "Correct fn, or m and norm")


def _is_number(weights: Tree) -> bool:
    return not isinstance(weights, tuple) and jnp.ndim(weights) == 0


def _is_constant(a: jax.Array) -> bool:
    return bool(jnp.all(jnp.abs(a - jnp.ravel(a)[0]) <= 1e-12 * jnp.abs(jnp.ravel(a)[0])))


def _norm(v: Tree) -> jax.Array:
    return jnp.sqrt(sum(jnp.sum(leaf * leaf) for leaf in jax.tree_util.tree_leaves(v)))
