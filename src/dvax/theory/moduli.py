"""The moduli of a problem's data over a region, proved from the code of f and h."""

import heapq
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..programs.slope import TooLarge
from .blocks import Block
from .matrix_free import AffineMap, frozen_derivative
from .one_sided import one_sided
from .region import Region
from .system import Jacobians, System

_TRIAL_CUTS, _MIN_GAIN = 8, 1e-3
"""Cutting stops after the trial cuts unless they reduced the bound by this fraction."""

_MAX_ENTRIES = 16
"""Largest number of entries of t, x and u together for which a region is cut."""


SMALLNESS = "(remark:assstrong (i))"
"""Marks the reason of a modulus that follows from the spectrum of P."""


class ProvedBound(NamedTuple):
    """A proved upper bound of a modulus (for γ a lower bound), infinite if there is none, and the
    method that proves it."""

    value: float
    method: str


class Moduli(NamedTuple):
    """The moduli that the code of f and h proves.

    `gamma` may be negative: then F is not proved strongly monotone. `unknown` lists the operations in f
    and h that have no rule.
    """

    alpha_f: ProvedBound
    beta_f: ProvedBound
    alpha_h: ProvedBound
    beta_h: ProvedBound
    gamma: ProvedBound
    L_F: ProvedBound
    unknown: dict[str, tuple[str, ...]]


def moduli(system: System, region: Region) -> Moduli:
    """Return the moduli over this region."""
    subdivision = Subdivision(system, region)
    alpha_f, beta_f = (subdivision.norm(name, "f") for name in ("f_x", "f_u"))
    alpha_h, beta_h = (subdivision.norm(name, "h") for name in ("h_x", "h_u"))
    gamma, L_F = subdivision.frozen_moduli()
    by_smallness = _smallness(system, beta_h.value)
    if by_smallness[0] > gamma.value:
        gamma = ProvedBound(by_smallness[0], f"m_P − β_h‖P⁻¹‖ {SMALLNESS}")
    if by_smallness[1] < L_F.value:
        L_F = ProvedBound(by_smallness[1], f"‖P⁻¹‖(1 + β_h) {SMALLNESS}")
    return Moduli(alpha_f, beta_f, alpha_h, beta_h, gamma, L_F, subdivision.whole.unknown)


def sharp_rate(
    system: System, region: Region, gamma: float, alpha_h: float, pointwise: bool
) -> float:
    """Return the μ of `one_sided` over this region."""
    subdivision = Subdivision(system, region)
    return subdivision.maximum(
        lambda J: one_sided(system, J, gamma, alpha_h, pointwise),
        exact=all(b is not None and b.exact for b in subdivision.whole[:4]),
    )


class Subdivision:
    """Bounds on the derivatives over a region, sharpened by cutting it into pieces."""

    def __init__(self, system: System, region: Region):
        self.system, self.region = system, region
        self.whole = system.at(region)
        self._affine: dict[str, AffineMap | None] = {}

    def norm(self, name: str, of: str) -> ProvedBound:
        """Return a bound on sup ‖∂f/∂x‖, for `name` "f_x" of the function `of` "f", and so on."""
        first: Block | None = getattr(self.whole, name)
        if first is None:
            return self._without_matrix(name, of)
        value = self.maximum(lambda J: _norm(getattr(J, name)), first.exact)
        if np.isinf(value) and self._affine_map(of) is not None:
            # Some linear operations have no slope rule, such as sparse products and transforms.
            return self._without_matrix(name, of)
        return ProvedBound(value, _method(first, self.region))

    def frozen_moduli(self) -> tuple[ProvedBound, ProvedBound]:
        """Return γ and L_F from ∂F/∂y."""
        h_u = self.whole.h_u
        try:
            if h_u is None:
                raise TooLarge
            self.system.frozen(h_u)
        except TooLarge:
            return self._frozen_without_matrix()
        gamma = -self.maximum(
            lambda J: -_of_frozen(self.system, J, Block.smallest_quotient, -np.inf), h_u.exact
        )
        L_F = self.maximum(lambda J: _of_frozen(self.system, J, Block.norm, np.inf), h_u.exact)
        if np.isinf(L_F) and self._affine_map("h") is not None:
            return self._frozen_without_matrix()
        method = f"{_method(h_u, self.region)} of ∂F/∂y"
        return ProvedBound(gamma, method), ProvedBound(L_F, method)

    def maximum(self, measure: Callable[[Jacobians], float], exact: bool) -> float:
        """Return a bound on the maximum of `measure` over the region, by branch and bound."""
        value = measure(self.whole)
        entries = sum(np.size(v.low) for v in self.region.leaves)
        if exact or entries > _MAX_ENTRIES or np.isnan(value):
            return value
        order = itertools.count()
        queue = [(-value, next(order), self.region)]
        for cut in range(self.system.max_cuts):
            worst, _, piece = queue[0]
            if cut == _TRIAL_CUTS and -worst > (1.0 - _MIN_GAIN) * value:
                break
            halves = list(piece.halves(self.region))
            if not halves:
                break
            heapq.heappop(queue)
            for half in halves:
                # The bound of a piece holds for its halves as well, even if their enclosures are wider.
                bound = min(measure(self.system.at(half)), -worst)
                heapq.heappush(queue, (-bound, next(order), half))
        return -queue[0][0]

    def _without_matrix(self, name: str, of: str) -> ProvedBound:
        affine = self._affine_map(of)
        if affine is None:
            return ProvedBound(np.inf, "too large for a matrix, and not shown to be affine")
        derivative = affine.by_state() if name.endswith("x") else affine.by_response()
        return ProvedBound(derivative.norm(), _LANCZOS)

    def _frozen_without_matrix(self) -> tuple[ProvedBound, ProvedBound]:
        affine = self._affine_map("h")
        if affine is None:
            why = "too large for a matrix, and not shown to be affine"
            return ProvedBound(-np.inf, why), ProvedBound(np.inf, why)
        F = frozen_derivative(self.system, affine)
        return ProvedBound(F.smallest_quotient(), _LANCZOS), ProvedBound(F.norm(), _LANCZOS)

    def _affine_map(self, of: str) -> AffineMap | None:
        """Return f or h as an affine map, or None if it is not proved to be one."""
        if self.system.varied:
            return None  # the map can be applied for one parameter only
        if of not in self._affine:
            affine = AffineMap(self.system, of, float(self.region.t.low))
            self._affine[of] = affine if affine.is_proved() else None
        return self._affine[of]


_LANCZOS = "Lanczos on an affine map; fails with a probability of at most 1e-12"


def _method(first: Block, region: Region) -> str:
    if first.exact:
        return "singular values" if first.center.shape[1:] != (1, 1) else "entries"
    return "interval enclosure" + ("" if region.is_everywhere else " over the region")


def _norm(block: Block | None) -> float:
    return np.inf if block is None else block.norm()


def _of_frozen(
    system: System, J: Jacobians, measure: Callable[[Block], float], default: float
) -> float:
    """Return `measure` of ∂F/∂y, or `default` if that is too large for a matrix."""
    if J.h_u is None:
        return default
    try:
        return measure(system.frozen(J.h_u))
    except TooLarge:
        return default


def _smallness(system: System, beta_h: float) -> tuple[float, float]:
    """Return γ and L_F by the smallness of β_h (remark:assstrong (i))."""
    m_P, norm = float(system.spectrum.m_P), float(system.spectrum.norm_P_inv)
    if not np.isfinite(beta_h):
        return -np.inf, np.inf
    return m_P - beta_h * norm, norm * (1.0 + beta_h)
