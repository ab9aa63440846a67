"""Adversarial functions of time: jumps and kinks between samples of a step, in every form of code. Each
has the list of its jumps and kinks in (0, 1)."""

import jax
import jax.numpy as jnp
import numpy as np


def _count_true(t):
    # Four thresholds passed one after the other, counted by a running sum of truth values.
    passed = t > jnp.array([0.11, 0.37, 0.52, 0.86])
    return jnp.cumsum(passed)[-1].astype(float)


def _flipped(t):
    return jnp.flip(t > jnp.array([0.3, 0.6]))[0].astype(float)


def _dead_zone(equal):
    def rate(t):
        s = 20.0 * t - 10.0
        outside = s - jnp.clip(s, -1.0, 1.0)
        return jnp.where((outside == 0.0) if equal else (outside != 0.0), 1.0, 0.0)

    return rate


RATES = {
    "a jump in the middle": (lambda t: jnp.where(t < 0.5, 0.0, 1.0), [0.5]),
    "a jump at a third": (lambda t: jnp.where(t <= 1 / 3, 2.0, -1.0), [1 / 3]),
    "a pulse that ends see nothing of": (
        lambda t: jnp.where((t > 0.01) & (t < 0.99), 1.0, 0.0), [0.01, 0.99],
    ),
    "a short pulse": (lambda t: jnp.where((t > 0.30) & (t < 0.31), 50.0, 0.0), [0.30, 0.31]),
    "a dead zone by equality": (_dead_zone(True), [0.45, 0.55]),
    "a dead zone by inequality": (_dead_zone(False), [0.45, 0.55]),
    "a number turned into an integer": (
        lambda t: (0.9 + 0.8 * t * (1.0 - t)).astype(int).astype(float),
        [0.5 - np.sqrt(0.125), 0.5 + np.sqrt(0.125)],
    ),
    "rounded": (lambda t: jnp.round(3.0 * t), [1 / 6, 0.5, 5 / 6]),
    "floor": (lambda t: jnp.floor(3.0 * t * t), [np.sqrt(1 / 3), np.sqrt(2 / 3)]),
    "sign": (lambda t: jnp.sign(jnp.sin(9.0 * t)), [np.pi / 9, 2 * np.pi / 9]),
    "a running count": (_count_true, [0.11, 0.37, 0.52, 0.86]),
    "truth values the other way round": (_flipped, [0.6]),
    "a tooth": (lambda t: jnp.maximum(0.0, 1.0 - jnp.abs(40.0 * t - 20.0)), [0.475, 0.5, 0.525]),
    "a fast wave": (lambda t: jnp.sin(8 * np.pi * t) * t, []),
    "a remainder": (lambda t: jnp.mod(3.0 * t, 1.0), [1 / 3, 2 / 3]),
    "a choice among three": (
        lambda t: jax.lax.switch(
            (3.0 * t).astype(int).clip(0, 2), [lambda: 0.0, lambda: 3.0, lambda: -1.0]
        ) + 0.0 * t,
        [1 / 3, 2 / 3],
    ),
    "a condition": (
        lambda t: jax.lax.cond(t < 0.4, lambda s: 1.0 + 0.0 * s, lambda s: 0.0 * s, t), [0.4],
    ),
    "a loop": (
        lambda t: jax.lax.fori_loop(0, 3, lambda i, a: a + jnp.where(t > 0.25 * i, 1.0, 0.0), 0.0),
        [0.25, 0.5],
    ),
    "a table looked up by a moving place": (
        lambda t: jnp.array([0.0, 4.0, -2.0, 1.0, 1.0])[jnp.floor(4.0 * t).astype(int)],
        [0.25, 0.5, 0.75],
    ),
    "rounded to a short type": (lambda t: (2.0 * t).astype(jnp.float16).astype(float), []),
    "the larger of sorted": (lambda t: jnp.sort(jnp.array([0.0, 1.0]) * t - 0.3)[1], []),
}  # fmt: skip
