"""An identity with forward derivatives only: its transpose raises an error."""

from typing import Any

import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ..errors import DifferentiationError


def forward_only(tree: Any) -> Any:
    """Return the values unchanged; their reverse derivative raises a `dvax.DifferentiationError`.

    Without it JAX would raise an error from inside the loop, after `solve` has returned, that does not
    name the options of dvax.
    """
    return jtu.tree_map(_forward_only.bind, tree)


def _refuse(cotangent: Any, x: Any) -> Any:
    raise DifferentiationError(
        'dvax.solve(adjoint="forward") and dvax.Picard cannot be differentiated backward (jax.grad, '
        'jax.vjp), because their loops do not store the steps. Pass adjoint="reverse", the default, '
        "and another method."
    )


# A linear primitive with a forward rule, whose transpose raises.
_forward_only = Primitive("forward_only")
_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
ad.deflinear2(_forward_only, _refuse)
batching.defvectorized(_forward_only)
mlir.register_lowering(_forward_only, lambda context, x: [x])
