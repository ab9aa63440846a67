"""The percentage that `progress=True` prints."""

from typing import Any

import diffrax
import jax

_METER = diffrax.TextProgressMeter()


def begin() -> Any:
    """Return the meter's state, after printing 0 %."""
    return _METER.init()


def advance(meter: Any, share: jax.Array) -> Any:
    """Return the meter's state after printing the completed share of the run, in [0, 1], if it grew."""
    return _METER.step(meter, share)


def keep(state: Any) -> Any:
    """Return the state of a loop after a use of its meter, if it has one.

    JAX ≥ 0.12 removes callbacks with unused results from a loop.
    """
    if state.meter is not None:
        jax.debug.callback(lambda _: None, state.meter.meter_idx)
    return state
