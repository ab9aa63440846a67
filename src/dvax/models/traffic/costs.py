"""What a link costs: the BPR formula, its integral and its slope."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from ... import _tree
from ...errors import InputProblem, Problems
from ...formats.road_network import Network


class LinkCosts(eqx.Module):
    """c(v) = t(v) + toll_weight·toll + distance_weight·length, link by link, with the time

        t(v) = t₀ + s (v/capacity)^p for 0 ≤ v ≤ `most`,    s = t₀b,

    and its tangents beyond: no feasible flow lies there, and so c is increasing and Lipschitz on
    the whole line, with the largest slope at `most`. Where the formula is constant (t₀, b or p is
    0), s = 0 and t₀ takes it all.

    Of NumPy arrays it computes with NumPy, of JAX's with JAX.
    """

    time: Any
    charge: Any
    scale: Any
    power: Any
    most: Any = np.inf

    def times(self, v: Any, capacity: Any) -> Any:
        """t(v)."""
        lib = _tree.array_module(v, capacity)
        inner = lib.clip(v, 0.0, self.most)
        formula = self.time + self.scale * (inner / capacity) ** self.power
        first = lib.where(self.power == 1.0, self.scale / capacity, 0.0)  # t′(0)
        last = self.slopes(self.most, capacity)
        return formula + first * lib.minimum(v, 0.0) + last * lib.maximum(v - self.most, 0.0)

    def up_to(self, most: np.ndarray) -> "LinkCosts":
        """The same with tangents from `most` on."""
        return dataclasses.replace(self, most=most)

    def costs(self, v: Any, capacity: Any) -> Any:
        """c(v)."""
        return self.times(v, capacity) + self.charge

    def slopes(self, v: Any, capacity: Any) -> Any:
        """t′(v), for 0 ≤ v ≤ `most`."""
        return self.scale * self.power / capacity * (v / capacity) ** (self.power - 1.0)

    def integrals(self, v: Any, capacity: Any) -> Any:
        """∫₀ᵛ c, for 0 ≤ v ≤ `most`: the terms of Beckmann's objective."""
        bent = self.scale * v * (v / capacity) ** self.power / (self.power + 1.0)
        return (self.time + self.charge) * v + bent


def link_costs(network: Network, toll_weight: Any, distance_weight: Any) -> LinkCosts:
    """The costs of a network's links.

    **Raises:** `dvax.InputError` where tolls have a weight and the network has none, or a power lies
    between 0 and 1: t′(0) = ∞, so that no L_F is large enough.
    """
    problems = Problems()
    charge = distance_weight * network.length
    if network.toll is not None:
        charge = charge + toll_weight * network.toll
    elif toll_weight != 0:
        problems.add(
            "dvax.models.Traffic(toll_weight)", f"{toll_weight:g}",
            f"{network.name} has no column toll, so there is nothing to weigh",
            "Add the column, or leave out the weight",
        )  # fmt: skip
    scale = network.free_flow_time * network.b
    constant = network.power == 0
    problems += [
        InputProblem(
            network.place(i), f"power {network.power[i]:g}",
            "a power between 0 and 1 makes the time infinitely steep at v = 0: F is not Lipschitz "
            "and the problem is outside the class",
            "Use 1 or more, or 0 for a constant",
        )
        for i in np.flatnonzero((network.power > 0) & (network.power < 1) & (scale > 0))
    ]  # fmt: skip
    problems.raise_any()
    time = network.free_flow_time + np.where(constant, scale, 0.0)
    scale = np.where(constant, 0.0, scale)
    # Where nothing is scaled the power is of no account; 1 has a slope everywhere.
    power = np.where(scale > 0, network.power, 1.0)
    return LinkCosts(time, charge, scale, power)
