"""Which derivatives a loop can serve: forward or backward, not both."""

from typing import Any

import diffrax
import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .._tree import Tree
from ..errors import DifferentiationError

_CHECKPOINT_BYTES = 2**30


def adjoint_for(name: str, max_steps: int, x0: Tree) -> diffrax.AbstractAdjoint:
    """Diffrax's loop for "reverse" or "forward"."""
    if name == "forward":
        return diffrax.ForwardMode()
    # One checkpoint a step is the fast path: nothing is computed more than twice. Larger states get
    # as many as fit the memory set aside, and are recomputed between them.
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jtu.tree_leaves(x0))
    affordable = max(64, _CHECKPOINT_BYTES // (8 * size + 512))
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=min(max_steps, affordable))


def forward_only(tree: Tree) -> Tree:
    """The same values; asking for their reverse derivative says what to do instead.

    Without it the error would come from the loop, after `solve` has returned, and name neither.
    """
    return jtu.tree_map(_forward_only.bind, tree)


def _refuse(cotangent: Any, x: Any) -> Any:
    raise DifferentiationError(
        'dvax.solve(adjoint="forward") cannot be differentiated backward (jax.grad, jax.vjp). Pass '
        'adjoint="reverse", the default: the loop that carries tangents along stores no steps.'
    )


# The identity, linear forward and without a transpose.
_forward_only = Primitive("forward_only")
_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
ad.deflinear2(_forward_only, _refuse)
batching.defvectorized(_forward_only)
mlir.register_lowering(_forward_only, lambda context, x: [x])
