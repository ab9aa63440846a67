"""The moduli of a problem's data over a region, proved from its code."""

import heapq
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..programs.slope import TooLarge
from .blocks import Block
from .matrix_free import Affine, frozen
from .one_sided import one_sided
from .region import Region
from .system import Jacobians, System

PIECES = 40
"""Into so many pieces a region is cut, where that makes an enclosure sharper."""

_PATIENCE, _GAIN = 8, 1e-3
"""After so many cuts the bound must be smaller by this share, or the region stays whole."""

_SMALL = 16
"""Up to so many entries of t, x and u together a region is cut at all."""


SMALLNESS = "(remark:assstrong (i))"
"""The mark of a modulus that rests on the spectrum of P."""


class Proved(NamedTuple):
    """An upper bound of a modulus (for γ: a lower one), infinite where there is none, and how it was
    found."""

    value: float
    how: str


class Moduli(NamedTuple):
    """What the code of f and h proves. `gamma` may be negative: F is not strongly monotone there."""

    alpha_f: Proved
    beta_f: Proved
    alpha_h: Proved
    beta_h: Proved
    gamma: Proved
    L_F: Proved
    unknown: dict[str, tuple[str, ...]]


def moduli(system: System, region: Region) -> Moduli:
    """The moduli over this region."""
    pieces = Pieces(system, region)
    alpha_f, beta_f = (pieces.norm(name, "f") for name in ("f_x", "f_u"))
    alpha_h, beta_h = (pieces.norm(name, "h") for name in ("h_x", "h_u"))
    gamma, L_F = pieces.frozen()
    by_smallness = _smallness(system, beta_h.value)
    if by_smallness[0] > gamma.value:
        gamma = Proved(by_smallness[0], f"m_P − β_h‖P⁻¹‖ {SMALLNESS}")
    if by_smallness[1] < L_F.value:
        L_F = Proved(by_smallness[1], f"‖P⁻¹‖(1 + β_h) {SMALLNESS}")
    return Moduli(alpha_f, beta_f, alpha_h, beta_h, gamma, L_F, pieces.whole.unknown)


def sharp_rate(
    system: System, region: Region, gamma: float, alpha_h: float, pointwise: bool
) -> float:
    """μ of `one_sided` over this region."""
    pieces = Pieces(system, region)
    return pieces.worst(
        lambda J: one_sided(system, J, gamma, alpha_h, pointwise),
        exact=all(b is not None and b.exact for b in pieces.whole[:4]),
    )


class Pieces:
    """A region, and the derivatives over the pieces that it is cut into."""

    def __init__(self, system: System, region: Region):
        self.system, self.region = system, region
        self.whole = system.at(region)
        self._affine: dict[str, Affine | None] = {}

    def norm(self, name: str, of: str) -> Proved:
        """sup ‖∂f/∂x‖ and the like."""
        first: Block | None = getattr(self.whole, name)
        if first is None:
            return self._without_matrix(name, of)
        value = self.worst(lambda J: _norm(getattr(J, name)), first.exact)
        if np.isinf(value) and self._proved_affine(of) is not None:
            # Linear operations without a rule of slope arithmetic: sparse products, transforms.
            return self._without_matrix(name, of)
        return Proved(value, _how(first, self.region))

    def frozen(self) -> tuple[Proved, Proved]:
        """γ and L_F from ∂F/∂y."""
        h_u = self.whole.h_u
        try:
            if h_u is None:
                raise TooLarge
            self.system.frozen(h_u)
        except TooLarge:
            return self._frozen_without_matrix()
        gamma = -self.worst(lambda J: -_of(self.system, J, Block.least, -np.inf), h_u.exact)
        L_F = self.worst(lambda J: _of(self.system, J, Block.norm, np.inf), h_u.exact)
        if np.isinf(L_F) and self._proved_affine("h") is not None:
            return self._frozen_without_matrix()
        how = _how(h_u, self.region)
        return Proved(gamma, f"{how} of ∂F/∂y"), Proved(L_F, f"{how} of ∂F/∂y")

    def worst(self, measure: Callable[[Jacobians], float], exact: bool) -> float:
        """The largest `measure` over the pieces: branch and bound, the worst piece cut first."""
        value = measure(self.whole)
        entries = sum(np.size(v.low) for v in self.region.leaves)
        if exact or entries > _SMALL or np.isnan(value):
            return value
        order = itertools.count()
        waiting = [(-value, next(order), self.region)]
        for cut in range(PIECES):
            worst, _, piece = waiting[0]
            if cut == _PATIENCE and -worst > (1.0 - _GAIN) * value:
                break
            halves = list(piece.halves(self.region))
            if not halves:
                break
            heapq.heappop(waiting)
            for half in halves:
                # A half is never worse than its whole, whatever its own enclosure says.
                bound = min(measure(self.system.at(half)), -worst)
                heapq.heappush(waiting, (-bound, next(order), half))
        return -waiting[0][0]

    def _without_matrix(self, name: str, of: str) -> Proved:
        affine = self._proved_affine(of)
        if affine is None:
            return Proved(np.inf, "too large for a matrix, and not shown to be affine")
        linear = affine.by_state() if name.endswith("x") else affine.by_response()
        return Proved(linear.norm(), _LANCZOS)

    def _frozen_without_matrix(self) -> tuple[Proved, Proved]:
        affine = self._proved_affine("h")
        if affine is None:
            why = "too large for a matrix, and not shown to be affine"
            return Proved(-np.inf, why), Proved(np.inf, why)
        F = frozen(self.system, affine)
        return Proved(F.least(), _LANCZOS), Proved(F.norm(), _LANCZOS)

    def _proved_affine(self, of: str) -> Affine | None:
        if self.system.varied:
            return None  # its action is known at one parameter only
        if of not in self._affine:
            affine = Affine(self.system, of, float(self.region.t.low))
            self._affine[of] = affine if affine.proved() else None
        return self._affine[of]


_LANCZOS = "Lanczos on an affine map; fails with a probability of at most 1e-12"


def _how(first: Block, region: Region) -> str:
    if first.exact:
        return "singular values" if first.center.shape[1:] != (1, 1) else "entries"
    return "interval enclosure" + ("" if region.everywhere else " over the region")


def _norm(block: Block | None) -> float:
    return np.inf if block is None else block.norm()


def _of(system: System, J: Jacobians, measure: Callable[[Block], float], none: float) -> float:
    if J.h_u is None:
        return none
    try:
        return measure(system.frozen(J.h_u))
    except TooLarge:
        return none


def _smallness(system: System, beta_h: float) -> tuple[float, float]:
    m_P, norm = float(system.spectrum.m_P), float(system.spectrum.norm_P_inv)
    if not np.isfinite(beta_h):
        return -np.inf, np.inf
    return m_P - beta_h * norm, norm * (1.0 + beta_h)
