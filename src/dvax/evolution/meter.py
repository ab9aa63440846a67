"""The lines that `progress=True` prints: share of the run, steps, method, time left."""

import sys
import time
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._batch import any_lane, largest_of_lanes
from .._jax.callbacks import io_callback

_LINE = 20
"""Thousandths of a run between two lines."""

_START = time.monotonic()


class Meter(NamedTuple):
    """The share of the last line in thousandths, and when the run began, in milliseconds of this
    process."""

    shown: jax.Array
    began: jax.Array


def begin() -> Meter:
    """Return the meter of a run that begins now."""
    began = io_callback(now, jax.ShapeDtypeStruct((), jnp.int32))
    return Meter(jnp.asarray(0, jnp.int32), began)


def advance(meter: Meter, share: jax.Array, steps: jax.Array, method: str) -> Meter:
    """Return the meter, after a line if the completed share of the run, in [0, 1], grew enough.

    Under `jax.vmap` the share is that of the slowest lane, and the steps are those of the longest.
    """
    share = lax.stop_gradient(share)
    done = -largest_of_lanes(-jnp.floor(1000 * share).astype(jnp.int32))
    count = largest_of_lanes(steps.astype(jnp.int32))
    began = largest_of_lanes(meter.began)
    # Lanes that have ended keep their meters, so that all lanes must have advanced.
    grew = (done >= meter.shown + _LINE) | ((done >= 1000) & (meter.shown < 1000))
    is_due = ~any_lane(~grew)

    def line() -> None:
        jax.debug.callback(partial(show, method), done, count, began)

    lax.cond(is_due, line, lambda: None)
    return Meter(jnp.where(is_due, done, meter.shown), meter.began)


def now() -> np.ndarray:
    """Return the time of this process in milliseconds."""
    return np.asarray(1000 * (time.monotonic() - _START), np.int32)


def show(method: str, done: Any, steps: Any, began: Any) -> None:
    """Print the line of a run of which so many thousandths are done."""
    share, spent = int(done) / 1000, (int(now()) - int(began)) / 1000
    rest = f"{spent * (1 - share) / share:.3g} s left" if share < 1 else f"{spent:.3g} s"
    sys.stderr.write(f"dvax.solve: {share:.0%}, {int(steps)} steps of {method}, {rest}\n")
    sys.stderr.flush()
