"""Errors that no shorter step lowers."""

from typing import Any, NamedTuple

import jax.numpy as jnp

_PATIENCE = 128.0
"""Steps of one length until twice of it is tried, for the first time."""


SMALLEST_NOISE, _MOST = 0.1, 1e4
"""In tolerances: less does not matter, and more is no rounding."""


class RoundoffGuard(NamedTuple):
    """An error of order p falls by 4ᵖ where a step is cut to a quarter. One that falls by less than 2ᵖ
    is rounding (or of a kink that was left behind), and steps may double while they are kept.

    `reference_size` and `reference_error` are those of the attempt that shorter ones are compared
    with: from a length to its quarter, since rounding fluctuates and neighbouring lengths tell little.
    `noise_floor` is the largest error of rounding that was seen, 0 when none is; `last_error` is that
    of the last step that was kept: it is seldom small where it is rounding, and small between jumps.
    """

    reference_size: Any
    reference_error: Any
    noise_floor: Any
    wait: Any
    last_error: Any

    @staticmethod
    def at_start(like: Any) -> "RoundoffGuard":
        zero = jnp.zeros_like(like)
        return RoundoffGuard(zero, zero, zero, jnp.full_like(like, _PATIENCE), zero)

    def after(self, length: Any, error: Any, keep: Any, calm: Any, order: int) -> "RoundoffGuard":
        """With one more attempt. Where one length has been kept for as many steps as there is to
        `wait`, twice of it is tried, since an error that is there at every length is not found by
        keeping one. Each trial that finds nothing doubles the wait: it has cost propagators."""
        ratio = length / jnp.maximum(length, self.reference_size)
        short = ratio <= 0.25
        # An error far above the tolerance that no shorter step lowers is that of a jump.
        noise = (error > SMALLEST_NOISE) & (error < _MOST)
        flat = (
            short
            & noise
            & (error * error >= self.reference_error * self.reference_error * ratio**order)
        )
        anew = short | (ratio == 1.0)
        tries = keep & (calm >= self.wait)
        seen = keep & ((self.noise_floor > 0.0) | flat | tries)
        found = keep & (self.noise_floor > 0.0)
        return RoundoffGuard(
            jnp.where(anew, length, self.reference_size),
            jnp.where(anew, error, self.reference_error),
            jnp.where(seen, jnp.maximum(self.noise_floor, error), 0.0),
            jnp.where(found, _PATIENCE, jnp.where(tries, 2.0 * self.wait, self.wait)),
            jnp.where(keep, error, self.last_error),
        )
