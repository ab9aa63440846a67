"""Link costs by the BPR formula, with their integrals and slopes."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from ... import _tree
from ...errors import InputProblem, Problems
from ...formats.road_network import Network

_OVERFLOWS = np.errstate(over="ignore", invalid="ignore", divide="ignore")
"""Costs of extreme links are infinite without a warning; the caller checks them."""


class LinkCosts(eqx.Module):
    """c(v) = t(v) + toll_weight·toll + distance_weight·length for each link, with the travel time

        t(v) = t₀ + s (v/capacity)^p for 0 ≤ v ≤ `most`,    s = t₀b,

    and its tangents outside, where no feasible flow lies. So c is increasing and Lipschitz on the real
    line, with the largest slope at `most`. If the formula is constant (t₀, b or p is 0), s = 0 and the
    constant is in t₀. The methods use NumPy for NumPy arrays, and JAX for JAX arrays.
    """

    time: Any
    charge: Any
    scale: Any
    power: Any
    most: Any = np.inf

    @_OVERFLOWS
    def times(self, v: Any, capacity: Any) -> Any:
        """Return t(v)."""
        lib = _tree.array_module(v, capacity)
        inner = lib.clip(v, 0.0, self.most)
        formula = self.time + self.scale * (inner / capacity) ** self.power
        slope_at_zero = lib.where(self.power == 1.0, self.scale / capacity, 0.0)
        slope_at_most = self.slopes(self.most, capacity)
        below, above = lib.minimum(v, 0.0), lib.maximum(v - self.most, 0.0)
        return formula + slope_at_zero * below + slope_at_most * above

    def up_to(self, most: np.ndarray) -> "LinkCosts":
        """Return the same costs with tangents beyond `most`."""
        return dataclasses.replace(self, most=most)

    def costs(self, v: Any, capacity: Any) -> Any:
        """Return c(v)."""
        return self.times(v, capacity) + self.charge

    @_OVERFLOWS
    def slopes(self, v: Any, capacity: Any) -> Any:
        """Return t′(v), for 0 ≤ v ≤ `most`."""
        return self.scale * self.power / capacity * (v / capacity) ** (self.power - 1.0)

    @_OVERFLOWS
    def integrals(self, v: Any, capacity: Any) -> Any:
        """Return ∫₀ᵛ c, for 0 ≤ v ≤ `most`, the terms of Beckmann's objective."""
        congestion = self.scale * v * (v / capacity) ** self.power / (self.power + 1.0)
        return (self.time + self.charge) * v + congestion


def link_costs(network: Network, toll_weight: Any, distance_weight: Any) -> LinkCosts:
    """Return the costs of a network's links.

    **Raises:** `dvax.InputError` if tolls have a weight but the network has no tolls, or if a power
    lies between 0 and 1: then t′(0) = ∞ and there is no L_F.
    """
    problems = Problems()
    with np.errstate(over="ignore"):  # a charge that overflows is refused below
        charge = distance_weight * network.length
        if network.toll is not None:
            charge = charge + toll_weight * network.toll
    if not np.all(np.isfinite(charge)):
        problems.add(
            "dvax.models.Traffic(toll_weight, distance_weight)",
            f"{toll_weight:g} and {distance_weight:g}",
            f"the cost of a link of {network.name} overflows", "Use smaller weights",
        )  # fmt: skip
    if network.toll is None and toll_weight != 0:
        problems.add(
            "dvax.models.Traffic(toll_weight)", f"{toll_weight:g}",
            f"{network.name} has no column toll, so the weight must be 0",
            "Add the column, or omit the weight",
        )  # fmt: skip
    scale = network.free_flow_time * network.b
    constant = network.power == 0
    problems += [
        InputProblem(
            network.place(i), f"power {network.power[i]:g}",
            "a power between 0 and 1 makes the time infinitely steep at v = 0, so that F is not "
            "Lipschitz",
            "Use a power ≥ 1, or 0 for a constant",
        )
        for i in np.flatnonzero((network.power > 0) & (network.power < 1) & (scale > 0))
    ]  # fmt: skip
    problems.raise_any()
    time = network.free_flow_time + np.where(constant, scale, 0.0)
    scale = np.where(constant, 0.0, scale)
    # For a scale of 0 the power is irrelevant; with 1 the slope is finite everywhere.
    power = np.where(scale > 0, network.power, 1.0)
    return LinkCosts(time, charge, scale, power)
