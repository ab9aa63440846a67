"""A market on a transmission network: direct-current power flow, and demand that adapts to prices.

The unknowns are the outputs g of the units, the demand D of the buses with load, and the flow of the
direct-current line, in MW. Flows on the lines are linear in the injections: H (B g − C D + B_dc y_dc).
"""

import csv
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax
from dvax.formats import read_rts
from dvax.formats.rts_gmlc import LEAST_SLOPE

PRICE = 40.0
"""$/MWh at which the demand is the load of the data."""
SHORT, LONG = 0.1, 0.3
"""Elasticities of the demand at that price: at once, and after the demand has adapted."""
SPEED = 1.0
"""Rate in 1/h at which the demand adapts."""
MINUTES = 5
"""The time between rows of the wind."""
_FILES = (
    "gen.csv", "bus.csv", "branch.csv", "dc_branch.csv", "REAL_TIME_wind.csv", "DAY_AHEAD_wind.csv",
    "DAY_AHEAD_regional_Load.csv", "DAY_AHEAD_pv.csv", "DAY_AHEAD_rtpv.csv", "DAY_AHEAD_hydro.csv",
)  # fmt: skip


class Network(NamedTuple):
    """A network with n units, b buses, m lines and l buses with load; powers in MW.

    - `unit_bus`, `load_bus`: indices of buses; `ends`: those of both ends of each line, and
      `susceptance` and `limit` of the line; `dc_ends` and `dc_limit` of the direct-current line;
    - `cost` c and `slope` a of the marginal costs c + a g, in $/MWh and $/MWh per MW;
    - `is_wind`: the units that `wind` has, a row every five minutes; `capacity` of all units and
      `load` of each bus in `load_bus`, a row an hour.
    """

    buses: np.ndarray
    unit_bus: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    is_wind: np.ndarray
    load_bus: np.ndarray
    ends: np.ndarray
    susceptance: np.ndarray
    limit: np.ndarray
    dc_ends: tuple[int, int]
    dc_limit: float
    capacity: np.ndarray
    wind: np.ndarray
    load: np.ndarray

    @property
    def units(self) -> int:
        return len(self.cost)

    @property
    def unknowns(self) -> int:
        return self.units + len(self.load_bus) + 1

    def injections(self) -> np.ndarray:
        """Return the matrix of the injections at all buses in the unknowns."""
        out = np.zeros((len(self.buses), self.unknowns))
        out[self.unit_bus, np.arange(self.units)] = 1.0
        out[self.load_bus, self.units + np.arange(len(self.load_bus))] = -1.0
        out[self.dc_ends[0], -1], out[self.dc_ends[1], -1] = -1.0, 1.0
        return out

    def incidence(self) -> np.ndarray:
        """Return the matrix with 1 at the first and −1 at the second end of each line."""
        out = np.zeros((len(self.ends), len(self.buses)))
        rows = np.arange(len(self.ends))
        out[rows, self.ends[:, 0]], out[rows, self.ends[:, 1]] = 1.0, -1.0
        return out

    def transfer_factors(self) -> np.ndarray:
        """Return H: the flow on every line for a unit of injection at every bus, for a sum of zero."""
        of_angles = self.susceptance[:, None] * self.incidence()
        laplacian = self.incidence().T @ of_angles
        return of_angles @ np.linalg.pinv(laplacian)

    def largest_capacity(self) -> np.ndarray:
        """Return the upper bounds of all unknowns; the demand is at most twice the peak load."""
        capacity = self.capacity.max(axis=0)
        capacity[self.is_wind] = self.wind.max(axis=0)
        return np.concatenate([capacity, 2.0 * self.load.max(axis=0), [self.dc_limit]])


class Lines(NamedTuple):
    """The lines that may bind: `row` of each in the network, |flows u| ≤ limit; `impossible`, the
    number of those that are proved never to bind; `parallel`, of those that others imply."""

    row: np.ndarray
    flows: np.ndarray
    limit: np.ndarray
    impossible: int
    parallel: int


def lines_that_may_bind(network: Network) -> Lines:
    """Return all lines but those that cannot bind, and parallel circuits that another one implies.

    The largest flow over 0 ≤ y ≤ c, s·y = 0 is at most Σ cᵢ (hᵢ − λsᵢ)₊ for every λ (weak duality); the
    least such number over λ = sᵢhᵢ is the largest flow itself. The direct-current line is in both
    signs."""
    flows = network.transfer_factors() @ network.injections()
    balance = np.concatenate([np.ones(network.units), -np.ones(len(network.load_bus)), [0.0]])
    c = network.largest_capacity()
    inner = slice(0, network.unknowns - 1)

    def largest(h: np.ndarray) -> float:
        prices = np.append(h[inner] * balance[inner], 0.0)
        surplus = np.maximum(h[inner] - prices[:, None] * balance[inner], 0.0)
        return float((surplus @ c[inner]).min() + abs(h[-1]) * c[-1])

    can_bind = np.array([max(largest(h), largest(-h)) for h in flows]) > network.limit
    # Of circuits with the same ends, the one of the largest flow relative to its limit binds first.
    first: dict[tuple[int, int], int] = {}
    load = network.susceptance / network.limit
    for k in np.flatnonzero(can_bind):
        ends = tuple(sorted(network.ends[k].tolist()))
        if ends not in first or load[k] > load[first[ends]]:
            first[ends] = int(k)
    row = np.array(sorted(first.values()), dtype=int)
    parallel = int(can_bind.sum()) - len(row)
    return Lines(row, flows[row], network.limit[row], int((~can_bind).sum()), parallel)


class Market(NamedTuple):
    """The coupled problem of a network over hours `first` to `last` of its data.

        x' = −s x + s(1 − ε_s/ε_l)(D − L(t)),    u = (g, D, y_dc),
        0 ∈ (c + a g, −p − β(L(t) + x − D), 0) + N_{K(t)}(u),    β = p/(ε_s · mean load).

    The state x is the part of the demand that has adapted to past prices. In a steady state D has the
    elasticity ε_l, and at once ε_s. K(t) has the capacities, the balance and the limits of the lines.
    In the space with the weights w = (a, β, a_dc) the law is a projection: γ = L_F = 1.
    """

    network: Network
    lines: Lines
    problem: dvax.Problem
    constants: dvax.Constants
    weights: np.ndarray
    beta: np.ndarray
    first: float
    last: float

    def prices(self, multipliers: np.ndarray) -> np.ndarray:
        """Return the price at every bus from the multipliers of the balance and of the lines."""
        H = self.network.transfer_factors()[self.lines.row]
        return -(multipliers[..., :1] + multipliers[..., 1:] @ H)


def market(network: Network, first: int, last: int, scale: float = 1.0) -> Market:
    """Return the market of the hours `first` to `last`; all slopes a are multiplied by `scale`."""
    lines = lines_that_may_bind(network)
    beta = PRICE / (SHORT * network.load.mean(axis=0))
    weights = np.concatenate([scale * network.slope, beta, [LEAST_SLOPE]])
    units, loads = network.units, len(network.load_bus)
    hours = np.arange(first, last + 1, dtype=float)
    rows = slice(first, last + 1)
    per_hour = 60 // MINUTES
    fine = first + np.arange((last - first) * per_hour + 1) / per_hour
    wind = dvax.signals.Table(fine, network.wind[first * per_hour :][: len(fine)])
    load = dvax.signals.Table(hours, network.load[rows])
    other = dvax.signals.Table(hours, network.capacity[rows][:, ~network.is_wind])
    position = np.argsort(np.argsort(np.where(network.is_wind, 1, 0), kind="stable"))
    balance = np.concatenate([np.ones(units), -np.ones(loads), [0.0]])
    R = jnp.asarray(np.vstack([balance, lines.flows]))
    limits = jnp.asarray(np.concatenate([[0.0], lines.limit]))
    lower = jnp.asarray(np.concatenate([np.zeros(units + loads), [-network.dc_limit]]))
    fixed = jnp.asarray(network.largest_capacity()[units:])
    drive = jnp.asarray(-network.cost / weights[:units])
    at_price = jnp.asarray(PRICE / beta)
    share = 1.0 - SHORT / LONG

    def K(t: Any, args: Any) -> dvax.sets.ConstrainedBox:
        capacity = jnp.concatenate([other(t), wind(t)])[position]
        return dvax.sets.ConstrainedBox(
            lower, jnp.concatenate([capacity, fixed]), R, -limits, limits
        )

    def h(t: Any, x: Any, u: Any, args: Any) -> Any:
        return jnp.concatenate([drive, at_price + load(t) + x, jnp.zeros(1)])

    def f(t: Any, x: Any, u: Any, args: Any) -> Any:
        return SPEED * share * (u[units : units + loads] - load(t))

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-SPEED), P=dvax.operators.Scaling(1.0), K=K, f=f, h=h,
        state_space=dvax.spaces.L2(beta), control_space=dvax.spaces.L2(weights),
    )  # fmt: skip
    # ‖u₁ − u₂‖ ≤ ‖h₁ − h₂‖ = ‖x₁ − x₂‖, and f takes the entries D of u, each with the weight of x.
    constants = dvax.Constants(
        gamma=1.0, L_F=1.0, alpha_h=1.0, beta_h=0.0, alpha_f=0.0, beta_f=SPEED * share, M=1.0,
        omega=-SPEED, m_P=1.0, norm_P_inv=1.0, status="proved",
    )  # fmt: skip
    return Market(network, lines, problem, constants, weights, beta, float(first), float(last))


def read_network(folder: str | Path) -> Network:
    """Read the network of RTS-GMLC: its files beside each other, or a checkout of the repository.

    Units are those of `read_rts`, all hydro units and all rooftop panels, which can be curtailed. The
    concentrating plant, the battery and the condensers are left out, and so are least outputs. The
    load of an area is split by the `MW Load` of its buses.

    **Raises:** `FileNotFoundError` if a file is missing; `dvax.InputError` as `read_rts` does."""
    found = {name: next(iter(sorted(Path(folder).rglob(name))), None) for name in _FILES}
    missing = [name for name, path in found.items() if path is None]
    if missing:
        raise FileNotFoundError(f"{folder} has no {', '.join(missing)}")
    paths = {name: path for name, path in found.items() if path is not None}
    rts = read_rts(folder)
    bus = _rows(paths["bus.csv"])
    branch = _rows(paths["branch.csv"])
    (dc,) = _rows(paths["dc_branch.csv"])
    number = {row["Bus ID"]: k for k, row in enumerate(bus)}
    hydro, of_hydro = _series(paths["DAY_AHEAD_hydro.csv"])
    roof, of_roof = _series(paths["DAY_AHEAD_rtpv.csv"])
    wind, of_wind = _series(paths["REAL_TIME_wind.csv"])
    areas, of_areas = _series(paths["DAY_AHEAD_regional_Load.csv"])
    names = [*rts.names, *hydro, *roof]
    is_wind = np.array(["_WIND_" in name for name in names])
    order = [wind.index(name) for name, w in zip(names, is_wind, strict=True) if w]
    more = len(names) - len(rts.cost)
    load_mw = np.array([float(row["MW Load"]) for row in bus])
    load_bus = np.flatnonzero(load_mw > 0)
    area = np.array([areas.index(row["Area"]) for row in bus])
    totals = np.array([load_mw[area == k].sum() for k in range(len(areas))])
    taps = np.array([float(row["Tr Ratio"]) or 1.0 for row in branch])
    return Network(
        buses=np.array([int(row["Bus ID"]) for row in bus]),
        unit_bus=np.array([number[name.split("_")[0]] for name in names]),
        cost=np.concatenate([rts.cost, np.zeros(more)]),
        slope=np.concatenate([rts.slope, np.full(more, LEAST_SLOPE)]),
        is_wind=is_wind,
        load_bus=load_bus,
        ends=np.array([[number[row["From Bus"]], number[row["To Bus"]]] for row in branch]),
        susceptance=1.0 / (np.array([float(row["X"]) for row in branch]) * taps),
        limit=np.array([float(row["Cont Rating"]) for row in branch]),
        dc_ends=(number[dc["From Bus"]], number[dc["To Bus"]]),
        dc_limit=float(dc["MW Load"]),
        capacity=np.concatenate([rts.capacity, of_hydro, of_roof], axis=1),
        wind=of_wind[:, order],
        load=of_areas[:, area[load_bus]] * (load_mw / totals[area])[load_bus],
    )


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))


def _series(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(encoding="utf-8-sig") as file:
        names = file.readline().strip().split(",")[4:]
        return names, np.loadtxt(file, delimiter=",", ndmin=2)[:, 4:]
