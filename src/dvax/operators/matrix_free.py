"""P known by what it does."""

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
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class MatrixFree(AbstractOperator):
    """P v = fn(v) for a linear function; P⁻¹ by conjugate gradients.

    The inverse is solved to ‖v − P u‖ ≤ tol ‖v‖, in at most √κ steps a factor e (κ = norm/m); what
    does not get there is NaN. Its derivative, in v and in whatever fn depends on, is another solve
    and no unrolled iteration.

    **Arguments:** `fn`: linear, traceable; `m`, `norm`: bounds m‖v‖² ≤ ⟨Pv, v⟩ ≤ norm‖v‖², which
    nothing here proves: they are labelled as declared. `weights`: those of the control space, where
    it has any: P is self-adjoint for them, so w·P is what conjugate gradients can use. `tol`.

    **Raises:** `dvax.InputError` where the bounds are no bounds; and, when a `dvax.Problem` is made
    of it, where random vectors refute them, or that fn is linear or self-adjoint there.

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
        bound = "Give one bound of the spectrum of P"
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
                return u  # one number for all cancels
            return jax.tree_util.tree_map(jnp.multiply, self.weights, u)

        goal = weighted(v)
        dtype = jnp.result_type(*jax.tree_util.tree_leaves(v))
        tol = max(self.tol, 4.0 * float(jnp.finfo(dtype).eps))
        u, _ = jax.scipy.sparse.linalg.cg(
            lambda u: weighted(self.fn(u)), goal, tol=0.1 * tol, atol=0.0
        )
        # The recursion's residual drifts from the true one, which is the one that counts.
        rest = _tree.sub(goal, weighted(self.fn(u)))
        reached = _size(rest) <= 10.0 * tol * jnp.sqrt(self.norm / self.m) * _size(goal)
        return jax.tree_util.tree_map(lambda leaf: jnp.where(reached, leaf, jnp.nan), u)

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.MatrixFree(fn)"
        zeros = space.zeros()
        out = jax.eval_shape(self.fn, zeros)
        if not _tree.same_shape(out, zeros):
            raise InputError(
                InputProblem(
                    name,
                    f"a value of shape {_tree.shapes(out)}",
                    f"P maps the control space to itself: elements have shape {_tree.shapes(zeros)}",
                    "Return that shape from fn",
                )
            )
        self._check_weights(space)
        if _tree.is_concrete((self.m, self.norm, space.weights())):
            self._check_action(space, name)

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(self.m, self.norm, exact=False, declared=True)

    def _check_weights(self, space: AbstractSpace) -> None:
        zeros, own, theirs = space.zeros(), self.weights, space.weights()
        if _is_number(own):
            # Any one number for all entries will do, and a product space has one a part.
            fits = all(_flat(w) for w in jax.tree_util.tree_leaves(theirs))
            first = jnp.stack([jnp.ravel(w)[0] for w in jax.tree_util.tree_leaves(theirs)])
            fits = fits and _flat(first)
        else:
            fits = _tree.same_shape(own, zeros) and all(
                np.allclose(np.asarray(a), np.asarray(b), rtol=1e-12, atol=0.0)
                for a, b in zip(*map(jax.tree_util.tree_leaves, (own, theirs)), strict=True)
            )
        if not fits:
            raise InputError(
                InputProblem(
                    "dvax.operators.MatrixFree(weights)",
                    _tree.short(own),
                    f"conjugate gradients need the weights of {space!r}, where P is self-adjoint",
                    "Pass weights=space.weights()",
                )
            )

    def _check_action(self, space: AbstractSpace, name: str) -> None:
        """A few vectors can refute what is claimed of fn; they prove nothing."""
        flat, unflatten = jax.flatten_util.ravel_pytree(space.zeros())
        rng = np.random.default_rng(0)
        draws = [unflatten(jnp.asarray(rng.normal(size=flat.size), flat.dtype)) for _ in range(3)]
        acted = [self.fn(v) for v in draws]
        a, b = draws[0], draws[1]
        eps = float(jnp.finfo(flat.dtype).eps)
        size = float(self.norm * space.norm(a) * space.norm(b))
        skew = float(jnp.abs(space.inner(acted[0], b) - space.inner(a, acted[1])))
        joint = self.fn(_tree.add(a, _tree.scale(2.0, b)))
        bent = float(space.norm(_tree.sub(joint, _tree.add(acted[0], _tree.scale(2.0, acted[1])))))
        slack = 1e5 * eps
        forms = [
            float(space.inner(p, v) / space.inner(v, v)) for p, v in zip(acted, draws, strict=True)
        ]
        low, high = float(self.m) * (1 - slack), float(self.norm) * (1 + slack)
        for wrong, given, rule in (
            (bent > slack * float(self.norm * (space.norm(a) + space.norm(b))),
             f"‖P(a + 2b) − Pa − 2Pb‖ = {bent:.3g}", "P must be linear"),
            (skew > slack * size, f"⟨Pa, b⟩ − ⟨a, Pb⟩ = {skew:.3g}",
             f"P must be self-adjoint in {space!r}"),
            (not all(low <= q <= high for q in forms),
             f"⟨Pv, v⟩/‖v‖² = {min(forms):.6g} to {max(forms):.6g} for random v",
             "the declared m and norm must enclose it, or no bound built on them holds"),
        ):  # fmt: skip
            if wrong:
                raise InputError(InputProblem(name, given, rule, "Mend fn, or m and norm"))


def _is_number(weights: Tree) -> bool:
    return not isinstance(weights, tuple) and jnp.ndim(weights) == 0


def _flat(a: jax.Array) -> bool:
    return bool(jnp.all(jnp.abs(a - jnp.ravel(a)[0]) <= 1e-12 * jnp.abs(jnp.ravel(a)[0])))


def _size(v: Tree) -> jax.Array:
    return jnp.sqrt(sum(jnp.sum(leaf * leaf) for leaf in jax.tree_util.tree_leaves(v)))
