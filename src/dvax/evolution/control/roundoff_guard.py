"""The roundoff guard: error estimates that no smaller step reduces."""

from typing import Any, NamedTuple

import jax.numpy as jnp

_PATIENCE = 128.0
"""Accepted steps of one size until twice the size is tried, for the first time."""

_SMALLEST_NOISE, _LARGEST_NOISE = 0.1, 1e4
"""Range of roundoff in error estimates, in tolerances: less has no effect, and more is a jump."""


class RoundoffGuard(NamedTuple):
    """Detect error estimates that are dominated by roundoff, and let steps grow there.

    An error estimate of order p falls by 4ᵖ where a step is cut to a quarter. One that falls by less
    than 2ᵖ is roundoff (or comes from a kink that was passed); steps may then double while they are
    accepted.

    - `reference_size`, `reference_error`: the attempt that smaller ones are compared with, down to a
      quarter of its size, since roundoff fluctuates between neighbouring sizes;
    - `noise_floor`: the largest error of roundoff so far, 0 while there is none;
    - `wait`: accepted steps until twice the size is tried;
    - `last_error`: of the last accepted step. Where errors are roundoff it is seldom small; between
      two jumps it is.
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

    def is_noise(self, error: Any, order: int) -> Any:
        """Return whether an error is roundoff: until it grows with the step size."""
        return error <= 2.0 ** min(1.0, 0.5 * order) * self.noise_floor

    def had_noise(self) -> Any:
        """Return whether the last accepted step had an error that roundoff would leave."""
        return self.last_error > _SMALLEST_NOISE

    def after(
        self, size: Any, error: Any, accepted: Any, in_a_row: Any, order: int
    ) -> "RoundoffGuard":
        """Return the guard after an attempt. After `wait` accepted steps of one size the guard tries
        twice the size, since equal steps cannot tell roundoff from the error of the method. A trial
        that finds no roundoff doubles the wait: it has cost new φ-functions."""
        ratio = size / jnp.maximum(size, self.reference_size)
        short = ratio <= 0.25
        noise = (error > _SMALLEST_NOISE) & (error < _LARGEST_NOISE)
        fallen = self.reference_error * self.reference_error * ratio**order
        flat = short & noise & (error * error >= fallen)
        is_reference = short | (ratio == 1.0)
        tries = accepted & (in_a_row >= self.wait)
        found = accepted & (self.noise_floor > 0.0)
        seen = found | (accepted & (flat | tries))
        wait = jnp.where(tries, 2.0 * self.wait, self.wait)
        return RoundoffGuard(
            reference_size=jnp.where(is_reference, size, self.reference_size),
            reference_error=jnp.where(is_reference, error, self.reference_error),
            noise_floor=jnp.where(seen, jnp.maximum(self.noise_floor, error), 0.0),
            wait=jnp.where(found, _PATIENCE, wait),
            last_error=jnp.where(accepted, error, self.last_error),
        )

    def lengthen(self, size: Any, attempt_size: Any, accepted: Any) -> Any:
        """Return the next step size: at least doubled while errors are roundoff."""
        noisy = accepted & (self.noise_floor > 0.0)
        return jnp.where(noisy, jnp.maximum(size, 2.0 * attempt_size), size)
