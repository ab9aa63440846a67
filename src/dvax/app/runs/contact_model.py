"""The contact law that a configuration and its data describe."""

import jax.numpy as jnp

from dvax.app.runs.contact_inputs import ContactInputs
from dvax.app.runs.settings import Config
from dvax.models import Contact
from dvax.theory import Assumption, verify


def contact_model(config: Config, inputs: ContactInputs) -> Contact:
    """The model, in JAX's current precision."""
    m = config.model
    return Contact(
        alpha=m.alpha, beta=m.beta, b_x=m.b_x, b_u=m.b_u, d_x=m.d_x, d_u=m.d_u,
        kappa0=m.kappa0, g=inputs.demand_signal, ell=inputs.load_signal,
        weights=inputs.boundary.weights,
    )  # fmt: skip


def assumptions(config: Config, inputs: ContactInputs) -> tuple[Assumption, ...]:
    """What is known about each assumption of the theory, with the data as they are."""
    model = contact_model(config, inputs)
    return verify(model.problem, jnp.asarray(inputs.x0), 0.0, config.time.end).assumptions
