"""Checks of the numerical arguments of models."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import Problems


def positive(
    place: str,
    value: Any,
    wrong: Problems,
    *,
    zero: bool = False,
    why: str = "",
    fix: str = "Fix the number, or its unit",
) -> jax.Array:
    """Return `value` as an array: a positive number, with `zero` also 0.

    Any other value is added to `wrong`, and 1 is returned in its place. Of a traced value only the
    shape is checked. `why` is the reason for the rule.
    """
    with wrong.collect():
        number = _tree.as_float(value, place)
        holds = jnp.ndim(number) == 0
        if holds and _tree.is_concrete(number):
            # By NumPy: XLA takes numbers below 1e-308 for 0.
            value = np.asarray(number)
            holds = bool(np.isfinite(value) and (value >= 0 if zero else value > 0))
        if holds:
            return number
        rule = "it must be a number ≥ 0" if zero else "it must be a positive number"
        wrong.add(place, _tree.short(number), rule + (f": {why}" if why else ""), fix)
    return jnp.ones(())
