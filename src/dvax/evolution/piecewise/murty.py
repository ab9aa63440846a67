"""The mode of a law at one state, by Murty's rule: of the violated conditions the first is changed,
which ends for matrices whose principal minors are positive."""

from collections.abc import Callable

import numpy as np

from .inputs import Piece
from .modes import Equations, Mode, changed, inverse
from .system import Affine

Array = np.ndarray


def law_mode(
    of: Callable[[Mode], Equations], mode: Mode, x: Array, piece: Piece, off: Array
) -> Mode | None:
    """That of the law at x, which may be `off`, and at the start of a piece; None where there is none.
    The search begins with `mode`."""
    return _solve(of, mode, x, piece.at(np.zeros(1))[0, len(x) :], piece, off)


def implicit_mode(
    system: Affine,
    weights: Array,
    mode: Mode,
    x: Array,
    piece: Piece,
    begin: float,
    h: float,
    off: Array,
) -> Mode | None:  # fmt: skip
    """That of the law at the end of a step of the implicit Euler method of length h from `begin`."""
    n = len(x)
    after = system.C @ inverse(np.eye(n) - h * system.A)
    if not np.isfinite(after).all():
        return None
    implicit = system._replace(C=after, M=system.M + h * after @ system.B)
    given = piece.at(np.array([(begin + h) / piece.length]))[0]
    of = lambda mode: Equations(implicit, mode, weights)  # noqa: E731
    return _solve(of, mode, x + h * given[:n], given[n:], piece, off)


def _solve(
    of: Callable[[Mode], Equations], mode: Mode, x: Array, q: Array, piece: Piece, off: Array
) -> Mode | None:
    sizes = np.abs(piece.coefficients[:, len(x) :]).sum(axis=0)
    for _ in range(_MOST_CHANGES):
        own = of(mode)
        y, w, slack_y, slack_w = own.at(x, q, sizes, off)
        for c in own.conditions:
            value, slack = (w, slack_w) if c.of_w else (y, slack_y)
            if c.sign * (value[c.i] - c.bound) < -slack[c.i]:
                mode = changed(mode, c)
                break
        else:
            return mode
    return None


_MOST_CHANGES = 4096
