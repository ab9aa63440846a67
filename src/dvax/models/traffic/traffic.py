"""Day-to-day traffic: how trips find their paths on a congested network."""

import sys
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...errors import InputError
from ...evolution import Solution
from ...formats.road_network import Network, Trips
from ...generators import Scalar
from ...operators import Scaling
from ...problem import Problem
from ...signals import AbstractSignal
from ...theory import Constants
from .bounds import largest_flows, largest_slope
from .changes import Incident, capacities, demand_factor, demand_set
from .checks import agreement, loaded, numbers
from .costs import LinkCosts, link_costs
from .equilibrium import all_or_nothing
from .generation import generated, typical_rho
from .law import Choices, LinkNewton, Proposal
from .paths import Incidence, Paths
from .shortest import ShortestPaths


class Traffic(eqx.Module):
    """Trips that change their paths from day to day toward what costs less.

        x' = κ(u − x)
        u = argmin over K(t) of ½‖u − x‖² + ρ Φ_t(Δu)

    (Friesz and others 1994 have the explicit step, u = proj_K(x − ρΔᵀc(Δx)), in its place). x are
    the flows on paths and u what they head for; K(t) = {u ≥ 0, the paths of a pair sum up to its
    demand d(t)}; v = Δu are the flows on links, c(v) = t(v) + toll_weight·toll +
    distance_weight·length what a link costs (BPR, see `Network`), and Φ_t(v) = Σ ∫₀ᵛ c. In the form
    of the class: A = −κ, f = κu, P = I, and the law is u ∈ h − N_K(t)(u) with h = x − ρ Δᵀc(Δu).
    Where x = u is Wardrop's equilibrium: nobody has a path that costs less.

    **Units:** κ (`rate`) in 1/day, flows in trips, costs in the unit of the times, ρ in trips per
    unit of cost.

    **Arguments:**

    - `network`, `trips`: what `read_network` and `read_trips` return, or the names of TNTP files;
    - `toll_weight`, `distance_weight` ≥ 0: what a unit of toll, or of length, costs;
    - `rate` > 0; `rho` > 0, by default 1000 mean flows over the mean cost of the empty network. They
      decide how the equilibrium is reached, and not which one;
    - `demand`: the factor of all trips as a signal or callable of t, one number or one for each
      pair; `peak`, the most that it comes to, where it is neither constant nor a table;
    - `incidents`: `Incident`s, which cut capacities for a time;
    - `gap` > 0: the relative gap of the equilibria for which paths are generated, 10⁻¹² by default;
    - `progress`: print a line on standard error every two seconds while paths are generated.

    Paths are generated until no path of the network costs less at the equilibrium, for the trips
    as they are and at their peak, with all capacities that incidents bring about. `paths` are
    these, and `gap` is what was reached.

    **Raises:** `dvax.InputError` with all that is wrong: parameters, files (with their lines),
    pairs without a path; `dvax.SolveError` where rounding does not allow `gap`.

    `constants` are proved. `fit` says how the model fits the class.

    ```python
    >>> import dvax, jax
    >>> from dvax.models.traffic import Network, Traffic, Trips
    >>> jax.config.update("jax_enable_x64", True)
    >>> roads = Network(zones=2, nodes=2, first_thru_node=1, init_node=[1, 2], term_node=[2, 1],
    ...                 capacity=[10.0, 10.0], length=[1.0, 1.0], free_flow_time=[5.0, 5.0],
    ...                 b=[0.15, 0.15], power=[4.0, 4.0])
    >>> model = Traffic(roads, Trips(zones=2, origin=[1], destination=[2], flow=[10.0]))
    >>> float(model.objective(0.0, model.equilibrium)), float(model.constants.growth_rate)
    (51.5, 0.0)

    ```
    """

    network: Network = eqx.field(static=True)
    trips: Trips = eqx.field(static=True)
    paths: Paths = eqx.field(static=True)
    gap: float = eqx.field(static=True)
    rate: float = eqx.field(static=True)
    rho: float = eqx.field(static=True)
    equilibrium: jax.Array
    incidence: Incidence
    link_costs: LinkCosts
    capacity: AbstractSignal
    factor: AbstractSignal | None
    peak: Any
    worst: Any

    def __init__(
        self,
        network: Any,
        trips: Any,
        *,
        toll_weight: Any = 0.0,
        distance_weight: Any = 0.0,
        rate: Any = 1.0,
        rho: Any = None,
        demand: Any = None,
        peak: Any = None,
        incidents: Sequence[Incident] = (),
        gap: Any = 1e-12,
        progress: bool = False,
    ):
        wrong = numbers(
            toll_weight=toll_weight, distance_weight=distance_weight, rate=rate, rho=rho, gap=gap
        )
        found: dict[str, Any] = {}

        def attempt(name: str, make: Any) -> None:
            try:
                found[name] = make()
            except InputError as error:
                wrong.extend(error.problems)

        attempt("files", lambda: loaded(network, trips))
        if "files" in found:
            roads, table = found["files"]
            wrong += agreement(roads, table)
            attempt("demand", lambda: demand_factor(demand, peak, len(table)))
            attempt("capacity", lambda: capacities(roads, incidents))
            if not wrong:
                attempt("costs", lambda: link_costs(roads, toll_weight, distance_weight))
        if wrong:
            raise InputError(*wrong)
        self.network, self.trips = found["files"]
        self.factor, self.peak = found["demand"]
        self.capacity, each = found["capacity"]
        self.rate, self.worst = float(rate), each.min(axis=0)
        most = self.peak * self.trips.flow
        costs = found["costs"]
        reached = generated(
            costs, self.network, self.trips, each, most, float(gap), _say if progress else None
        )
        self.paths, self.gap = reached.paths, reached.gap
        self.equilibrium = jnp.asarray(reached.flows)
        self.incidence = Incidence(self.paths.lengths, self.paths.links, self.paths.count)
        self.link_costs = costs.up_to(largest_flows(self.paths, most))
        self.rho = typical_rho(costs, self.network, self.trips) if rho is None else float(rho)

    @property
    def problem(self) -> Problem:
        """A = −κI, f = κu, P = I, h = x − ρΔᵀc(Δu) and K(t), a simplex a pair."""
        costs = jax.tree_util.tree_map(jnp.asarray, self.link_costs)
        return Problem(
            A=Scalar(-self.rate),
            P=Scaling(1.0),
            K=demand_set(self.trips.flow, self.paths.sizes, self.factor, self.peak),
            f=_Rate(jnp.asarray(self.rate)),
            h=Proposal(self.incidence, costs, self.capacity, jnp.asarray(self.rho)),
        )

    @property
    def constants(self) -> Constants:
        """γ = 1, L_F = 1 + ρ‖ΔᵀDΔ‖, α_h = 1, β_h = L_F − 1, α_f = 0, β_f = κ, M = 1, ω = −κ, and the
        one-sided rate 0.

        γ = 1 for every ρ: c increases link by link, so ⟨F(y) − F(z), y − z⟩ = ‖y − z‖² + ρ⟨c(Δy) −
        c(Δz), Δy − Δz⟩ ≥ ‖y − z‖². D holds the largest slopes: of flows up to those that peak demand
        can bring onto a link, at the least capacity; beyond, c goes on by its tangents. ΔᵀDΔ has no
        negative entry, so for any z > 0 its norm is at most max (ΔᵀDΔz)ᵢ/zᵢ (Collatz and Wielandt).
        The proximal map is firmly nonexpansive, ⟨u − u', x − x'⟩ ≤ ‖x − x'‖², hence the rate 0: two
        trajectories never separate.
        """
        steep = self.rho * largest_slope(self.link_costs, self.paths, self.worst)
        return Constants(
            gamma=1.0, L_F=1.0 + steep, alpha_h=1.0, beta_h=steep, alpha_f=0.0, beta_f=self.rate,
            M=1.0, omega=-self.rate, m_P=1.0, norm_P_inv=1.0, one_sided=0.0, status="proved",
        )  # fmt: skip

    @property
    def fit(self) -> str:
        """How the model fits the class of problems."""
        return (
            f"exact, on {len(self.paths.lengths)} generated paths: at the equilibrium no other path "
            f"of the network would save more than {self.gap:.0e} of the cost"
        )

    @property
    def vi_solver(self) -> LinkNewton:
        """The solver for the law, Newton's method on link flows: to 10⁻¹⁰ of all trips, or to what
        rounding allows."""
        least = float(1e-10 * np.sum(self.peak * self.trips.flow))
        v = np.asarray(self.link_flows(self.equilibrium))
        stiffness = self.rho * self.link_costs.slopes(v, self.worst)
        choices = Choices(self.paths, stiffness, np.asarray(self.equilibrium))
        return LinkNewton(choices, jnp.asarray(v), least)

    def all_or_nothing(self) -> jax.Array:
        """All trips on the paths that cost least on the empty network, for a `demand` of 1."""
        c = self.link_costs.costs(np.zeros(len(self.network)), self.network.capacity)
        return jnp.asarray(all_or_nothing(self.paths, c, self.trips.flow))

    def demands(self, t: Any) -> jax.Array:
        """d(t), a number a pair."""
        trips = jnp.asarray(self.trips.flow)
        return trips if self.factor is None else self.factor(t) * trips

    def link_flows(self, x: Any) -> jax.Array:
        """v = Δx, in the order of the network's links."""
        return self.incidence.flows(jnp.asarray(x))

    def costs(self, t: Any, x: Any) -> jax.Array:
        """c(Δx) at time t, in the order of the network's links."""
        costs = jax.tree_util.tree_map(jnp.asarray, self.link_costs)
        return jnp.asarray(costs.costs(self.link_flows(x), self.capacity(t)))

    def objective(self, t: Any, x: Any) -> jax.Array:
        """Beckmann's Φ_t(Δx) = Σ ∫₀ᵛ c, least at the equilibrium."""
        costs = jax.tree_util.tree_map(jnp.asarray, self.link_costs)
        return jnp.sum(costs.integrals(self.link_flows(x), self.capacity(t)))

    def total_travel_time(self, t: Any, x: Any) -> jax.Array:
        """Σ v t(v): what all trips together spend, tolls and lengths apart."""
        costs, v = jax.tree_util.tree_map(jnp.asarray, self.link_costs), self.link_flows(x)
        return jnp.sum(v * costs.times(v, self.capacity(t)))

    def relative_gap(self, t: Any, x: Any) -> float:
        """The share of Σ xc that would be saved if everybody took the least cost path of the whole
        network, generated or not, at these costs."""
        c, x = np.asarray(self.costs(t, x)), np.asarray(x)
        least, _ = ShortestPaths(self.network, self.trips).find(c)
        along = self.paths.incidence() @ c
        return float(x @ (along - np.repeat(least, self.paths.sizes)) / (x @ along))

    def figures(self, solution: Solution) -> dict[str, float]:
        """`objective` and `total_travel_time` at the last saved time, and `max_conservation_error`: the
        largest |Σ flows/d(t) − 1| of any pair at any saved time, of u, and of x too where d rests."""
        t, x = float(solution.ts[-1]), solution.xs[-1]
        every = [np.asarray(solution.us)]
        if self.factor is None:
            every.append(np.asarray(solution.xs))
        worst = 0.0
        for k, time in enumerate(np.asarray(solution.ts)):
            d = np.asarray(self.demands(time))
            for flows in every:
                sums = np.add.reduceat(flows[k], self.paths.starts)
                # Where a pair has no trips now, its error is measured by those it has.
                scale = np.where(d > 0, d, self.trips.flow)
                worst = max(worst, float(np.max(np.abs(sums - d) / scale)))
        return {
            "objective": float(self.objective(t, x)),
            "total_travel_time": float(self.total_travel_time(t, x)),
            "max_conservation_error": worst,
        }


def _say(words: str) -> None:
    sys.stderr.write(f"generating paths, {words}\n")
    sys.stderr.flush()


class _Rate(eqx.Module):
    """f = κu."""

    rate: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.rate * u
