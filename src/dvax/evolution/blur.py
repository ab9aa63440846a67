"""Errors that no shorter step lowers."""

from typing import Any, NamedTuple

import jax.numpy as jnp


class Blur(NamedTuple):
    """An error of order p falls by 4ᵖ where a step is cut to a quarter. One that falls by less than 2ᵖ
    is rounding (or of a kink that was left behind), and steps may double while they are kept.

    `longest` and `error` are those of the attempt that shorter ones are compared with: from a length
    to its quarter, since rounding fluctuates and neighbouring lengths tell little. `level` is the
    largest error of rounding that was seen, 0 when none is.
    """

    longest: Any
    error: Any
    level: Any

    def after(self, length: Any, error: Any, keep: Any, patient: Any, order: int) -> "Blur":
        """With one more attempt. `patient` says that one length has been kept for long: twice of it
        is tried, since an error that is there at every length is not found by keeping one."""
        ratio = length / jnp.maximum(length, self.longest)
        short = ratio <= 0.25
        flat = short & (error > 0.1) & (error * error >= self.error * self.error * ratio**order)
        anew = short | (ratio == 1.0)
        seen = keep & ((self.level > 0.0) | flat | patient)
        return Blur(
            jnp.where(anew, length, self.longest),
            jnp.where(anew, error, self.error),
            jnp.where(seen, jnp.maximum(self.level, error), 0.0),
        )
