"""The identity, which refuses to be transposed."""

from typing import Any

import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ..errors import DifferentiationError


def forward_only(tree: Any) -> Any:
    """Return the same values; their reverse derivative raises an error that says what to do instead.

    Without it the error would come from the loop, after `solve` has returned, and name neither.
    """
    return jtu.tree_map(_forward_only.bind, tree)


def _refuse(cotangent: Any, x: Any) -> Any:
    raise DifferentiationError(
        'dvax.solve(adjoint="forward") and dvax.Picard cannot be differentiated backward (jax.grad, '
        'jax.vjp). Pass adjoint="reverse", the default, and another method: a loop that carries '
        "tangents along stores no steps."
    )


# Linear, with a forward rule and without a transpose.
_forward_only = Primitive("forward_only")
_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
ad.deflinear2(_forward_only, _refuse)
batching.defvectorized(_forward_only)
mlir.register_lowering(_forward_only, lambda context, x: [x])
