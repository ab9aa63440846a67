"""Could a firm gain by making something else?"""

import numpy as np

_HALVINGS = 200
"""Until an interval of doubles has no middle any more."""


def largest_gain(
    price: np.ndarray,
    made: np.ndarray,
    capacity: np.ndarray,
    cost: np.ndarray,
    slope: np.ndarray,
    firms: np.ndarray,
    b: float,
) -> float:
    """The most that one firm can gain by deviating, over all firms and moments.

    A firm f that makes v where it made u, the others as before, moves the price to p − b(V − U) with
    V = Σvᵢ, U = Σuᵢ, and earns (p − b(V − U))V − Σ(cᵢvᵢ + aᵢvᵢ²/2). The best v makes all at one
    marginal cost λ, vᵢ = clip((λ − cᵢ)/aᵢ, 0, capᵢ), where λ is the marginal revenue p + bU − 2bV(λ):
    that falls with λ, so the λ where they meet is found by halving. The gain is written in d = v − u,
    so that two large profits are not subtracted.

    **Arguments:** `price` (m,); `made` and `capacity` (m, n), for m moments; `cost`, `slope` (n,);
    `firms` (n, k) of zeros and ones. In NumPy, and without the law or its solver.

    ```python
    >>> import numpy as np
    >>> from dvax.models.market import largest_gain
    >>> one = np.ones((1, 1))
    >>> gain = largest_gain(      # a free unit that stands still at a price of 1
    ...     np.ones(1), 0 * one, one, np.zeros(1), np.ones(1), one, b=0.5)
    >>> round(gain, 12)           # max of v − v²/2 − v²/2
    0.25

    ```
    """
    best = 0.0
    for f in range(firms.shape[1]):
        own = firms[:, f] > 0.5
        c, a, cap, u = cost[own], slope[own], capacity[:, own], made[:, own]
        alone = price + b * u.sum(axis=1)  # the price if the firm made nothing

        def offer(level: np.ndarray, c=c, a=a, cap=cap) -> np.ndarray:
            return np.clip((level[:, None] - c) / a, 0.0, cap)

        low = np.minimum(alone - 2 * b * cap.sum(axis=1), c.min()) - 1.0
        high = alone + 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            rising = alone - 2 * b * offer(middle).sum(axis=1) > middle
            low, high = np.where(rising, middle, low), np.where(rising, high, middle)
        d = offer(0.5 * (low + high)) - u
        first = ((price - b * u.sum(axis=1))[:, None] - c - a * u) * d
        second = 0.5 * (a * d * d).sum(axis=1) + b * d.sum(axis=1) ** 2
        best = max(best, float(np.max(first.sum(axis=1) - second)))
    return best
