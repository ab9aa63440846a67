"""A formula of a configuration at the points of a boundary, as a function of time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dvax.app.runs.expressions import Expression


class Formula(eqx.Module):
    """t -> expression(t, s) at all points.

    The coordinates are leaves, not constants of the traced program: XLA would fold them, which takes
    minutes at a million points. Only coordinates that occur in the text are kept.
    """

    expression: Expression = eqx.field(static=True)
    coordinates: dict[str, jax.Array]

    def __init__(
        self,
        expression: Expression,
        names: tuple[str, ...],
        coordinates: tuple[np.ndarray, ...],
    ):
        self.expression = expression
        self.coordinates = {
            name: jnp.asarray(c)
            for name, c in zip(names, coordinates, strict=True)
            if name in expression.uses
        }

    def __call__(self, t: Any) -> jax.Array:
        # A name that does not occur may have any value.
        variables = dict.fromkeys(self.expression.names, 0.0)
        return self.expression(**{**variables, **self.coordinates, "t": t})
