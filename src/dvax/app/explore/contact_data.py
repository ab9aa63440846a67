"""The contact law of the page: what its sliders move, and what they do not."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax

from dvax.models import Contact
from dvax.signals import AbstractSignal, Constant, Product

LETTERS = {
    "model.alpha": ("α", "relaxation rate", "rate"),
    "model.beta": ("β", "pressure per reaction", "stiffness"),
    "model.b_x": ("bₓ", "feedback of the indentation on the law", "number"),
    "model.b_u": ("bᵤ", "feedback of the reaction on the law", "number"),
    "model.d_x": ("dₓ", "feedback of the indentation on its rate", "rate"),
    "model.d_u": ("dᵤ", "effect of the pressure on the rate", "rate"),
    "model.kappa0": ("κ₀", "pressure capacity", "pressure"),
}
"""Key: the letter of the paper, the meaning, and the kind of its unit."""


class Data(eqx.Module):
    """What no slider moves: demand and load for the factor 1, the weights, and the initial state."""

    demand: AbstractSignal
    load: AbstractSignal
    weights: jax.Array
    x0: jax.Array

    def model(self, values: Mapping[str, Any]) -> Contact:
        """Return the contact law with these parameters."""
        letters = {key.removeprefix("model."): values[key] for key in LETTERS}
        return Contact(
            **letters,
            g=Product(Constant(values["demand.value"]), self.demand),
            ell=Product(Constant(values["load.value"]), self.load),
            weights=self.weights,
        )
