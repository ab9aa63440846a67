"""A check of Nash equilibria: the largest profit that a firm can gain by deviating."""

import numpy as np

_BISECTIONS = 200
"""Enough bisections to reduce any interval to adjacent floating-point numbers."""


def largest_gain(
    price: np.ndarray,
    output: np.ndarray,
    capacity: np.ndarray,
    cost: np.ndarray,
    slope: np.ndarray,
    firms: np.ndarray,
    b: float,
) -> float:
    """Return the largest gain of any firm by a unilateral deviation at any time.

    If firm f produces v instead of u while the others do not change, the price becomes p − b(V − U)
    with V = Σvᵢ, U = Σuᵢ, and its profit (p − b(V − U))V − Σ(cᵢvᵢ + aᵢvᵢ²/2). The optimal v has one
    marginal cost λ for all units, vᵢ = clip((λ − cᵢ)/aᵢ, 0, capᵢ), equal to the marginal revenue
    p + bU − 2bV(λ), which decreases with λ. Bisection determines λ. The gain is a function of
    d = v − u, which avoids the cancellation of two large profits.

    **Arguments:** `price` (m,); `output` and `capacity` (m, n), for m times; `cost`, `slope` (n,);
    `firms` (n, k) of zeros and ones. The computation uses NumPy, not the law or its solver.

    ```python
    >>> import numpy as np
    >>> from dvax.models.market import largest_gain
    >>> one = np.ones((1, 1))
    >>> gain = largest_gain(      # a unit without marginal cost at 0, idle at a price of 1
    ...     np.ones(1), 0 * one, one, np.zeros(1), np.ones(1), one, b=0.5)
    >>> round(gain, 12)           # max of v − v²/2 − v²/2
    0.25

    ```
    """
    return float(largest_gains(price, output, capacity, cost, slope, firms, b).max())


def largest_gains(
    price: np.ndarray,
    output: np.ndarray,
    capacity: np.ndarray,
    cost: np.ndarray,
    slope: np.ndarray,
    firms: np.ndarray,
    b: float,
) -> np.ndarray:
    """Return the largest gain of any firm by a unilateral deviation, or 0, at each time."""
    best = np.zeros(len(price))
    for f in range(firms.shape[1]):
        units = firms[:, f] > 0.5
        c, a, cap, u = cost[units], slope[units], capacity[:, units], output[:, units]
        price_without = price + b * u.sum(axis=1)  # the price if the firm produced nothing

        def offer(level: np.ndarray, c=c, a=a, cap=cap) -> np.ndarray:
            return np.clip((level[:, None] - c) / a, 0.0, cap)

        low = np.minimum(price_without - 2 * b * cap.sum(axis=1), c.min()) - 1.0
        high = price_without + 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below_root = price_without - 2 * b * offer(middle).sum(axis=1) > middle
            low, high = np.where(below_root, middle, low), np.where(below_root, high, middle)
        d = offer(0.5 * (low + high)) - u
        first = ((price - b * u.sum(axis=1))[:, None] - c - a * u) * d
        second = 0.5 * (a * d * d).sum(axis=1) + b * d.sum(axis=1) ** 2
        best = np.maximum(best, first.sum(axis=1) - second)
    return best
