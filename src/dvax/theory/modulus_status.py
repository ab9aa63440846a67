"""The moduli of a problem, each with its status: proved, declared, estimated or refuted."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..programs.slope import SlopeEnclosure, is_slope
from .counterexample_search import (
    CounterexamplePair,
    find_counterexample,
    search_slope,
    smallest_monotonicity,
)
from .moduli import SMALLNESS, Moduli, moduli
from .region import Region
from .status import Status
from .system import System
from .weighted_law import splits

_HALVINGS = 6
"""The region is cut into 2⁶ pieces for the minimum of a weight."""


class ModulusStatus(NamedTuple):
    """A modulus with its status and the reason for it."""

    value: float
    status: Status
    reason: str


class UnweightedLaw(NamedTuple):
    """For a law F = aG: γ = Mμ with its reason, and the system of the law G with its moduli."""

    gamma: float
    reason: str
    system: System
    moduli: Moduli


class ModulusStatuses(NamedTuple):
    """The moduli by name; the law without its weight, if it has one; a counterexample to γ, if one was
    found; and whether β_h is the exact modulus of h in u."""

    by_name: dict[str, ModulusStatus]
    unweighted: UnweightedLaw | None
    counterexample: CounterexamplePair | None
    exact_in_u: bool


def modulus_statuses(
    system: System, region: Region, box: Region | None, declared: dict[str, float]
) -> ModulusStatuses:
    """Return every modulus over `region`: a proved value, or else the declared one, or else an estimate
    from a search in the bounded `box`; without a box, the estimate is the value for which there is no
    proof."""
    proved = moduli(system, region)
    by_name = {}
    for name, of, by in (
        ("alpha_f", "f", "x"), ("beta_f", "f", "u"), ("alpha_h", "h", "x"), ("beta_h", "h", "u"),
    ):  # fmt: skip
        value, method = getattr(proved, name)
        if np.isfinite(value):
            by_name[name] = ModulusStatus(value, "proved", method)
        elif box is None:
            why = _reason_without_proof(proved, of, method, value)
            by_name[name] = ModulusStatus(value, "estimated", why)
        else:
            found = search_slope(system, box, of, by)
            why = _reason_without_proof(proved, of, method, value)
            by_name[name] = _estimate(found.value, declared.get(name), box, why)
            if found.jump is not None:
                place = f"{by} = {_tree.short(found.jump.place)}"
                reason = (
                    f"{of} jumps by {found.jump.height:.6g} at {place}, so no constant holds. Write "
                    "a switch, such as the sign in a friction force, as a law u ∈ h − N_K(P u)"
                )
                by_name[name] = ModulusStatus(np.inf, "refuted", reason)
    by_name["L_F"] = _lipschitz_status(system, proved, by_name["beta_h"], declared)
    unweighted = _unweighted_law(system, region)
    gamma, reason = proved.gamma
    if unweighted is not None and unweighted.gamma > gamma:
        gamma, reason = unweighted.gamma, unweighted.reason
    reason = reason if gamma > 0 else _reason_without_proof(proved, "h", reason, gamma)
    by_name["gamma"], pair = _gamma_status(system, gamma, reason, box, declared)
    if by_name["gamma"].value > by_name["L_F"].value:
        # γ of a pseudomonotone law may exceed L_F. `Constants` needs γ ≤ L_F, and a larger L_F
        # holds too.
        by_name["L_F"] = by_name["L_F"]._replace(value=by_name["gamma"].value)
    if system.spectrum.declared:
        for name in ("gamma", "L_F"):
            entry = by_name[name]
            if SMALLNESS in entry.reason and entry.status == "proved":
                by_name[name] = entry._replace(status="declared")
    exact = proved.beta_h.method in ("entries", "singular values")
    return ModulusStatuses(by_name, unweighted, pair, exact)


def _reason_without_proof(proved: Moduli, of: str, method: str, value: float) -> str:
    """Return why there is no proof: operations without a rule, or what the method proves."""
    names = proved.unknown[of]
    if names:
        return f"{of} uses {', '.join(names)}, without a rule"
    return f"{method} " + (
        f"proves only γ ≥ {value:.6g}" if np.isfinite(value) else "gives no bound"
    )


def _estimate(lower: float, declared: float | None, box: Region, why: str) -> ModulusStatus:
    """Return the status of a modulus without proof, from the lower bound that a search found."""
    search = f"a search over {describe(box)}"
    if declared is None:
        reason = f"a lower bound from {search}; no proof from the code ({why})"
        return ModulusStatus(lower, "estimated", reason)
    if lower > declared * (1 + 1e-9):
        reason = f"declared as {declared:.6g}, but {search} found {lower:.6g}"
        return ModulusStatus(lower, "refuted", reason)
    reason = f"declared; {search} found at most {lower:.6g}"
    return ModulusStatus(declared, "declared", reason)


def _lipschitz_status(
    system: System, proved: Moduli, beta_h: ModulusStatus, declared: dict[str, float]
) -> ModulusStatus:
    value, method = proved.L_F
    if np.isfinite(value):
        return ModulusStatus(value, "proved", method)
    if "L_F" in declared:
        return ModulusStatus(declared["L_F"], "declared", "declared")
    value = float(system.spectrum.norm_P_inv) * (1.0 + beta_h.value)
    return ModulusStatus(value, beta_h.status, "‖P⁻¹‖(1 + β_h)")


def _gamma_status(
    system: System, gamma: float, reason: str, box: Region | None, declared: dict[str, float]
) -> tuple[ModulusStatus, CounterexamplePair | None]:
    if gamma > 0:
        return ModulusStatus(gamma, "proved", reason), None
    if box is None:
        return ModulusStatus(gamma, "estimated", reason), None
    search = f"a search over {describe(box)}"
    pair, upper = find_counterexample(system, box), np.inf
    if pair is None:
        upper, pair = smallest_monotonicity(system, box)
    if pair is not None:
        why = (
            f"at t = {pair.t:.6g}, x = {_tree.short(pair.x)}: y = {_tree.short(pair.y)} and "
            f"z = {_tree.short(pair.z)} in K(t) have ⟨F(y), z − y⟩ = {pair.forward:.6g} ≥ 0, but "
            f"⟨F(z), z − y⟩ = {pair.backward:.6g} < 0"
        )
        return ModulusStatus(pair.gamma, "refuted", why), pair
    if "gamma" in declared:
        reason = f"declared; {search} did not refute it"
        return ModulusStatus(declared["gamma"], "declared", reason), None
    reason = (
        f"an upper bound of the modulus of strong monotonicity from {search}; no proof from the code "
        f"({reason})"
    )
    return ModulusStatus(upper, "estimated", reason), None


def _unweighted_law(system: System, region: Region) -> UnweightedLaw | None:
    """Return γ = Mμ and the law G with its moduli if h is written as u − aG, or None."""
    if system.varied:
        return None
    for weight, problem in splits(system):
        M = _minimum_of_weight(weight, system, region)
        if not M > 0:
            continue
        unweighted = System(problem, system.x0, system.args, max_cuts=system.max_cuts)
        proved = moduli(unweighted, region)
        mu, method = proved.gamma
        if mu > 0:
            reason = (
                f"F = aG with a ≥ {M:.6g} and G strongly monotone with {mu:.6g}, {method} "
                "(prop:weighted_strong_pseudomono)"
            )
            return UnweightedLaw(M * mu, reason, unweighted, proved)
    return None


def _minimum_of_weight(weight: Callable[..., Any], system: System, region: Region) -> float:
    """Return a lower bound of a(t, x, u) over the region."""
    enclosure = SlopeEnclosure(weight, (jnp.zeros(()), system.x0, system.u0), ())
    pieces = [region]
    for _ in range(_HALVINGS):
        pieces = [half for piece in pieces for half in piece.halves(region)] or pieces
    return min(float(np.min(enclosure(*piece[:3]).out.low)) for piece in pieces)


def describe(box: Region) -> str:
    """Return the bounds of x and u in words."""

    def span(tree: Tree) -> str:
        leaves = jtu.tree_leaves(tree, is_leaf=is_slope)
        low, high = (
            min(float(v.low.min()) for v in leaves),
            max(float(v.high.max()) for v in leaves),
        )
        return f"[{low:.6g}, {high:.6g}]"

    return f"x in {span(box.x)}, u in {span(box.u)}"
