"""Each modulus with its status: proved, declared, estimated or refuted."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..programs.slope import SlopeEnclosure, is_slope
from .moduli import SMALLNESS, Moduli, moduli
from .region import Region
from .search import Pair, counterexample, least_modulus, steepest
from .status import Status
from .system import System
from .weighted_law import splits

_ROUNDS = 6
"""2⁶ pieces for the least value of a weight."""


class Known(NamedTuple):
    """A modulus, how much is known about it, and from what."""

    value: float
    status: Status
    how: str


class Divided(NamedTuple):
    """A law F = aG: γ = Mμ, and the system without the weight with its moduli."""

    gamma: float
    how: str
    system: System
    moduli: Moduli


class Knowledge(NamedTuple):
    """The moduli by name; the law without its weight where it has one; a counterexample to γ."""

    of: dict[str, Known]
    divided: Divided | None
    pair: Pair | None
    exact_in_u: bool


def knowledge(system: System, region: Region, box: Region, declared: dict[str, float]) -> Knowledge:
    """What is known over `region`: a proof where there is one, else what is declared, else what a
    search in the bounded `box` finds."""
    found = moduli(system, region)
    known = {}
    for name, of, by in (
        ("alpha_f", "f", "x"), ("beta_f", "f", "u"), ("alpha_h", "h", "x"), ("beta_h", "h", "u"),
    ):  # fmt: skip
        value, how = getattr(found, name)
        if np.isfinite(value):
            known[name] = Known(value, "proved", how)
        else:
            least = steepest(system, box, of, by)
            known[name] = _searched(least, declared.get(name), box, _because(found, of, how))
    known["L_F"] = _of_frozen(system, found, known["beta_h"], declared)
    divided = _divided(system, region)
    gamma, how = found.gamma
    if divided is not None and divided.gamma > gamma:
        gamma, how = divided.gamma, divided.how
    how = how if gamma > 0 else _because(found, "h", how)
    known["gamma"], pair = _gamma(system, gamma, how, box, declared)
    if known["gamma"].value > known["L_F"].value:
        # A modulus of pseudomonotonicity may be the larger one; more than L_F is a modulus as well.
        known["L_F"] = known["L_F"]._replace(value=known["gamma"].value)
    if system.spectrum.declared:
        for name in ("gamma", "L_F"):
            if SMALLNESS in known[name].how and known[name].status == "proved":
                known[name] = known[name]._replace(status="declared")
    exact = found.beta_h.how in ("entries", "singular values")
    return Knowledge(known, divided, pair, exact)


def _because(found: Moduli, of: str, how: str) -> str:
    """Why there is no proof."""
    names = found.unknown[of]
    return f"{of} uses {', '.join(names)}, without a rule" if names else how


def _searched(least: float, given: float | None, box: Region, how: str) -> Known:
    where = f"a search over {shown(box)}"
    if given is None:
        return Known(least, "estimated", f"at least, from {where}; no proof from the code ({how})")
    if least > given * (1 + 1e-9):
        return Known(least, "refuted", f"declared as {given:.6g}, but {where} met {least:.6g}")
    return Known(given, "declared", f"declared; {where} met no more than {least:.6g}")


def _of_frozen(system: System, found: Moduli, beta_h: Known, declared: dict[str, float]) -> Known:
    value, how = found.L_F
    if np.isfinite(value):
        return Known(value, "proved", how)
    if "L_F" in declared:
        return Known(declared["L_F"], "declared", "declared")
    value = float(system.spectrum.norm_P_inv) * (1.0 + beta_h.value)
    return Known(value, beta_h.status, "‖P⁻¹‖(1 + β_h)")


def _gamma(
    system: System, gamma: float, how: str, box: Region, declared: dict[str, float]
) -> tuple[Known, Pair | None]:
    if gamma > 0:
        return Known(gamma, "proved", how), None
    where = f"a search over {shown(box)}"
    pair = counterexample(system, box)
    if pair is not None:
        why = (
            f"at t = {pair.t:.6g}, x = {_tree.short(pair.x)}: y = {_tree.short(pair.y)} and "
            f"z = {_tree.short(pair.z)} in K(t) have ⟨F(y), z − y⟩ = {pair.forward:.6g} ≥ 0, but "
            f"⟨F(z), z − y⟩ = {pair.backward:.6g} < 0"
        )
        return Known(pair.gamma, "refuted", why), pair
    if "gamma" in declared:
        return Known(declared["gamma"], "declared", f"declared; {where} did not refute it"), None
    least = least_modulus(system, box)
    return Known(least, "estimated", f"at most, from {where}; no proof from the code ({how})"), None


def _divided(system: System, region: Region) -> Divided | None:
    """γ = Mμ where h is written as u − aG, and what is known of the law without the weight."""
    if system.varied:
        return None
    for weight, problem in splits(system):
        least = _least(weight, system, region)
        if not least > 0:
            continue
        without = System(problem, system.x0, system.args)
        found = moduli(without, region)
        if found.gamma.value > 0:
            how = (
                f"F = aG with a ≥ {least:.6g} and G strongly monotone with {found.gamma.value:.6g}, "
                f"{found.gamma.how} (prop:weighted_strong_pseudomono)"
            )
            return Divided(least * found.gamma.value, how, without, found)
    return None


def _least(weight: Callable[..., Any], system: System, region: Region) -> float:
    """The least value of a(t, x, u) over the region, from below."""
    enclosure = SlopeEnclosure(weight, (jnp.zeros(()), system.x0, system.u0), ())
    pieces = [region]
    for _ in range(_ROUNDS):
        pieces = [half for piece in pieces for half in piece.halves(region)] or pieces
    return min(float(np.min(enclosure(*piece[:3]).out.low)) for piece in pieces)


def shown(box: Region) -> str:
    """A region in a sentence."""

    def span(tree: Tree) -> str:
        leaves = jtu.tree_leaves(tree, is_leaf=is_slope)
        low, high = (
            min(float(v.low.min()) for v in leaves),
            max(float(v.high.max()) for v in leaves),
        )
        return f"[{low:.6g}, {high:.6g}]"

    return f"x in {span(box.x)}, u in {span(box.u)}"
