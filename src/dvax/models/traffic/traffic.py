"""Day-to-day route choice on a congested road network."""

import sys
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...evolution import Solution
from ...formats.road_network import Network, Trips
from ...generators import Scalar
from ...operators import Scaling
from ...problem import Problem
from ...signals import AbstractSignal
from ...theory import Constants
from .bounds import largest_flows, largest_slope
from .changes import Incident, capacities, demand_factor, demand_set
from .checks import consistency_problems, load, number_problems
from .costs import LinkCosts, link_costs
from .equilibrium import all_or_nothing
from .generation import generate_paths, typical_rho
from .law import Choices, LinkNewton, Proposal
from .paths import Incidence, Paths
from .shortest import ShortestPaths


class Traffic(eqx.Module):
    """Day-to-day traffic: path flows relax to a proximal response to their costs.

        x' = κ(u − x)
        u = argmin over K(t) of ½‖u − x‖² + ρ Φ_t(Δu)

    (Friesz and others 1994 use the explicit step u = proj_K(x − ρΔᵀc(Δx)) instead.) x are the path
    flows and u their target; K(t) = {u ≥ 0, the paths of a pair add up to its demand d(t)}; v = Δu are
    the link flows, c(v) = t(v) + toll_weight·toll + distance_weight·length the link costs (BPR, see
    `Network`), and Φ_t(v) = Σ ∫₀ᵛ c. The problem has A = −κ, f = κu, P = I, and the law is
    u ∈ h − N_K(t)(u) with h = x − ρ Δᵀc(Δu). The stationary points x = u are Wardrop equilibria: every
    used path is a shortest path.

    **Units:** κ (`rate`) in 1/day, flows in trips, costs in the unit of the times, ρ in trips per
    unit of cost.

    **Arguments:**

    - `network`, `trips`: results of `read_network` and `read_trips`, or the names of TNTP files;
    - `toll_weight`, `distance_weight` ≥ 0: the costs of a unit of toll and of length;
    - `rate` > 0; `rho` > 0, by default 1000 mean flows over the mean cost of the empty network. They
      determine how the equilibrium is approached, not the equilibrium;
    - `demand`: the factor of all trips as a signal or callable of t, one number or one for each
      pair; `peak`: its maximum, if it is neither constant nor a table;
    - `incidents`: `Incident`s, which reduce capacities temporarily;
    - `gap` > 0: the relative gap of the equilibria for which paths are generated, by default 10⁻¹²;
    - `progress`: print a line on standard error every two seconds during path generation.

    Paths are generated until all shortest paths of the network at equilibrium are included, for the
    given trips and for their peak, with all capacities during incidents. `paths` holds them, and `gap`
    the relative gap attained.

    **Raises:** `dvax.InputError` with all problems: parameters, files (with their lines), pairs without
    a path; `dvax.SolveError` if roundoff does not allow `gap`.

    `constants` are proved. `fit` states how the model relates to the class of the theory.

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
    least_capacity: Any

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
        wrong = number_problems(
            toll_weight=toll_weight, distance_weight=distance_weight, rate=rate, rho=rho, gap=gap
        )
        values: dict[str, Any] = {}

        def attempt(name: str, make: Any) -> None:
            with wrong.collect():
                values[name] = make()

        attempt("files", lambda: load(network, trips))
        if "files" in values:
            roads, table = values["files"]
            wrong += consistency_problems(roads, table)
            attempt("demand", lambda: demand_factor(demand, peak, len(table)))
            attempt("capacity", lambda: capacities(roads, incidents))
            if not wrong:
                attempt("costs", lambda: link_costs(roads, toll_weight, distance_weight))
        wrong.raise_any()
        self.network, self.trips = values["files"]
        self.factor, self.peak = values["demand"]
        self.capacity, all_capacities = values["capacity"]
        self.rate, self.least_capacity = float(rate), all_capacities.min(axis=0)
        peak_flow = self.peak * self.trips.flow
        costs = values["costs"]
        equilibrium = generate_paths(
            costs, self.network, self.trips, all_capacities, peak_flow, float(gap),
            _report if progress else None,
        )  # fmt: skip
        self.paths, self.gap = equilibrium.paths, equilibrium.gap
        self.equilibrium = jnp.asarray(equilibrium.flows)
        self.incidence = Incidence(self.paths.lengths, self.paths.links, self.paths.count)
        self.link_costs = costs.up_to(largest_flows(self.paths, peak_flow))
        self.rho = typical_rho(costs, self.network, self.trips) if rho is None else float(rho)

    @property
    def problem(self) -> Problem:
        """The problem with A = −κI, f = κu, P = I, h = x − ρΔᵀc(Δu) and a simplex a pair as K(t)."""
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
        """The proved constants.

        γ = 1, L_F = 1 + ρ‖ΔᵀDΔ‖, α_h = 1, β_h = L_F − 1, α_f = 0, β_f = κ, M = 1, ω = −κ, and the
        one-sided rate is 0. γ = 1 for every ρ, since the cost of a link increases with its flow:
        ⟨F(y) − F(z), y − z⟩ = ‖y − z‖² + ρ⟨c(Δy) − c(Δz), Δy − Δz⟩ ≥ ‖y − z‖². D holds the largest
        slopes, at the largest flows for the peak demand and the least capacities; beyond these flows c
        is continued by its tangents. ΔᵀDΔ is nonnegative, so for any z > 0 its norm is at most
        max (ΔᵀDΔz)ᵢ/zᵢ (Collatz and Wielandt). The proximal map is firmly nonexpansive,
        ⟨u − u', x − x'⟩ ≤ ‖x − x'‖², hence the rate 0.
        """
        slope = self.rho * largest_slope(self.link_costs, self.paths, self.least_capacity)
        return Constants(
            gamma=1.0, L_F=1.0 + slope, alpha_h=1.0, beta_h=slope, alpha_f=0.0, beta_f=self.rate,
            M=1.0, omega=-self.rate, m_P=1.0, norm_P_inv=1.0, one_sided=0.0, status="proved",
        )  # fmt: skip

    @property
    def fit(self) -> str:
        """How the model relates to the class of the theory."""
        return (
            f"exact, on {len(self.paths.lengths)} generated paths: at the equilibrium all paths of "
            f"the network would save at most {self.gap:.0e} of the cost"
        )

    @property
    def vi_solver(self) -> LinkNewton:
        """The solver of the law, Newton's method in the link flows.

        Its tolerance is 10⁻¹⁰ of all trips, or the roundoff if that is larger."""
        least = float(1e-10 * np.sum(self.peak * self.trips.flow))
        v = np.asarray(self.link_flows(self.equilibrium))
        stiffness = self.rho * self.link_costs.slopes(v, self.least_capacity)
        choices = Choices(self.paths, stiffness, np.asarray(self.equilibrium))
        return LinkNewton(choices, jnp.asarray(v), least)

    def all_or_nothing(self) -> jax.Array:
        """Return the flows with all trips on the shortest paths of the empty network, for `demand`
        1."""
        c = self.link_costs.costs(np.zeros(len(self.network)), self.network.capacity)
        return jnp.asarray(all_or_nothing(self.paths, c, self.trips.flow))

    def demands(self, t: Any) -> jax.Array:
        """Return d(t), one number a pair."""
        trips = jnp.asarray(self.trips.flow)
        return trips if self.factor is None else self.factor(t) * trips

    def link_flows(self, x: Any) -> jax.Array:
        """Return v = Δx, in the order of the network's links."""
        return self.incidence.flows(jnp.asarray(x))

    def costs(self, t: Any, x: Any) -> jax.Array:
        """Return c(Δx) at time t, in the order of the network's links."""
        costs = jax.tree_util.tree_map(jnp.asarray, self.link_costs)
        return jnp.asarray(costs.costs(self.link_flows(x), self.capacity(t)))

    def objective(self, t: Any, x: Any) -> jax.Array:
        """Return Beckmann's Φ_t(Δx) = Σ ∫₀ᵛ c, which is minimal at the equilibrium."""
        costs = jax.tree_util.tree_map(jnp.asarray, self.link_costs)
        return jnp.sum(costs.integrals(self.link_flows(x), self.capacity(t)))

    def total_travel_time(self, t: Any, x: Any) -> jax.Array:
        """Return the total travel time Σ v t(v), without tolls and lengths."""
        costs, v = jax.tree_util.tree_map(jnp.asarray, self.link_costs), self.link_flows(x)
        return jnp.sum(v * costs.times(v, self.capacity(t)))

    def relative_gap(self, t: Any, x: Any) -> float:
        """Return the fraction of Σ xc that shortest paths of the whole network would save.

        The shortest paths are those at the costs of x, generated or not."""
        c, x = np.asarray(self.costs(t, x)), np.asarray(x)
        least, _ = ShortestPaths(self.network, self.trips).find(c)
        path_costs = self.paths.incidence() @ c
        return float(x @ (path_costs - np.repeat(least, self.paths.sizes)) / (x @ path_costs))

    def figures(self, solution: Solution) -> dict[str, float]:
        """Return the results of a solution.

        `objective` and `total_travel_time` at the last saved time; `max_conservation_error`: the
        largest |Σ flows/d(t) − 1| over pairs and saved times, of u, and for constant d of x as
        well."""
        t, x = float(solution.ts[-1]), solution.xs[-1]
        return {
            "objective": float(self.objective(t, x)),
            "total_travel_time": float(self.total_travel_time(t, x)),
            "max_conservation_error": float(self.conservation_errors(solution).max()),
        }

    def conservation_errors(self, solution: Solution) -> np.ndarray:
        """Return the largest |Σ flows/d(t) − 1| over pairs at each saved time, of u, and for constant
        d of x as well."""
        all_flows = [np.asarray(solution.us)]
        if self.factor is None:
            all_flows.append(np.asarray(solution.xs))
        worst = np.zeros(len(solution.ts))
        for k, time in enumerate(np.asarray(solution.ts)):
            d = np.asarray(self.demands(time))
            for flows in all_flows:
                sums = np.add.reduceat(flows[k], self.paths.starts)
                # If the demand of a pair is 0 at this time, the error is relative to its trips.
                scale = np.where(d > 0, d, self.trips.flow)
                worst[k] = max(worst[k], float(np.max(np.abs(sums - d) / scale)))
        return worst


def _report(message: str) -> None:
    sys.stderr.write(f"generating paths, {message}\n")
    sys.stderr.flush()


class _Rate(eqx.Module):
    """f = κu."""

    rate: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.rate * u
