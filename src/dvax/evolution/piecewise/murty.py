"""The mode of a law at one state, by Murty's least-index pivoting rule.

Each pass changes the first violated condition. The rule terminates for matrices whose principal minors
are all positive (P-matrices).
"""

from collections.abc import Callable

import numpy as np

from .inputs import Piece
from .modes import Equations, Mode, inverse, mode_after
from .system import Affine

Array = np.ndarray


def law_mode(
    equations_of: Callable[[Mode], Equations], mode: Mode, x: Array, piece: Piece, x_error: Array
) -> Mode | None:
    """Return the mode of the law at x and at the start of a piece, or None if there is none.

    `x_error` bounds the error of x. The search starts from `mode`.
    """
    q = piece.evaluate(np.zeros(1))[0, len(x) :]
    return _solve(equations_of, mode, x, q, piece, x_error)


def implicit_mode(
    system: Affine,
    weights: Array,
    mode: Mode,
    x: Array,
    piece: Piece,
    begin: float,
    h: float,
    x_error: Array,
) -> Mode | None:  # fmt: skip
    """Return the mode of the law at the end of an implicit Euler step of length h from `begin`, or None
    if there is none."""
    n = len(x)
    after = system.C @ inverse(np.eye(n) - h * system.A)
    if not np.isfinite(after).all():
        return None
    implicit = system._replace(C=after, M=system.M + h * after @ system.B)
    inputs = piece.evaluate(np.array([(begin + h) / piece.length]))[0]

    def equations_of(mode: Mode) -> Equations:
        return Equations(implicit, mode, weights)

    return _solve(equations_of, mode, x + h * inputs[:n], inputs[n:], piece, x_error)


def _solve(
    equations_of: Callable[[Mode], Equations],
    mode: Mode,
    x: Array,
    q: Array,
    piece: Piece,
    x_error: Array,
) -> Mode | None:
    sizes = np.abs(piece.coefficients[:, len(x) :]).sum(axis=0)
    for _ in range(_MAX_CHANGES):
        equations = equations_of(mode)
        y, w, slack_y, slack_w = equations.law_at(x, q, sizes, x_error)
        for c in equations.conditions:
            value, slack = (w, slack_w) if c.of_w else (y, slack_y)
            if c.sign * (value[c.i] - c.bound) < -slack[c.i]:
                mode = mode_after(mode, c)
                break
        else:
            return mode
    return None


_MAX_CHANGES = 4096
