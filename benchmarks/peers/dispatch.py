"""Economic dispatch by general solvers, with angles of the buses as unknowns instead of flow factors.

The linear programme is solved by HiGHS: with warm starts if `highspy` is installed, or else by SciPy's.
The quadratic programme is solved by Clarabel, if installed.
"""

import importlib.util
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse as sp

from ..electric_network import PRICE, Network


def _balances(network: Network) -> tuple[sp.csc_array, sp.csc_array]:
    """Return (flows of the angles, injections minus flows out of every bus, of (y, angles))."""
    incidence = sp.csc_array(network.incidence())
    flows = sp.diags_array(network.susceptance) @ incidence
    out = sp.hstack([sp.csc_array(network.injections()), -(incidence.T @ flows)])
    return sp.csc_array(flows), sp.csc_array(out)


class LinearProgramme:
    """min c·g for a given demand, subject to the balance of each bus and the limits of all lines.

    With `blocks` the cost of a unit is c g + a g²/2 interpolated linearly at that many equal blocks of
    its capacity."""

    def __init__(self, network: Network, blocks: int = 0, slope: np.ndarray | None = None):
        self.network, self.blocks = network, max(blocks, 1)
        n, buses, m = network.units, len(network.buses), len(network.limit)
        flows, balance = _balances(network)
        unit = sp.csc_array(balance[:, :n])
        units = sp.csc_array(sp.hstack([unit] * self.blocks))
        rest = sp.csc_array(balance[:, network.unknowns - 1 :])
        lines = sp.hstack([sp.csc_array((m, n * self.blocks + 1)), flows])
        self.matrix = sp.csc_array(sp.vstack([sp.hstack([units, rest]), lines]))
        self.demand = -network.injections()[:, n:-1]
        self.slope = np.zeros(n) if slope is None else slope
        self.free = np.full(buses, np.inf)
        self.warm: Any = None
        self.is_warm = importlib.util.find_spec("highspy") is not None

    @property
    def name(self) -> str:
        return "HiGHS, warm starts" if self.is_warm else "HiGHS (SciPy)"

    def solve(self, capacity: np.ndarray, demand: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the least cost in $/h and the prices of all buses, its multipliers."""
        network, n = self.network, self.network.units
        width = capacity / self.blocks
        middle = (np.arange(self.blocks)[:, None] + 0.5) * width
        cost = (network.cost + self.slope * middle).ravel()
        cost = np.concatenate([cost, np.zeros(1 + len(self.free))])
        upper = np.concatenate([np.tile(width, self.blocks), [network.dc_limit], self.free])
        lower = np.concatenate([np.zeros(n * self.blocks), [-network.dc_limit], -self.free])
        net = self.demand @ demand
        low, high = np.append(net, -network.limit), np.append(net, network.limit)
        if self.is_warm:
            return self._warm(cost, lower, upper, low, high)
        buses = len(self.free)
        answer = scipy.optimize.linprog(
            cost, A_ub=sp.vstack([self.matrix[buses:], -self.matrix[buses:]]),
            b_ub=np.append(network.limit, network.limit), A_eq=self.matrix[:buses], b_eq=net,
            bounds=np.stack([lower, upper], axis=1), method="highs",
        )  # fmt: skip
        return float(answer.fun), np.asarray(answer.eqlin.marginals)

    def _warm(self, cost: Any, lower: Any, upper: Any, low: Any, high: Any) -> Any:
        import highspy

        columns, rows = len(cost), len(low)
        if self.warm is None:
            lp = highspy.HighsLp()
            lp.num_col_, lp.num_row_, lp.col_cost_ = columns, rows, cost
            lp.col_lower_, lp.col_upper_, lp.row_lower_, lp.row_upper_ = lower, upper, low, high
            lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
            lp.a_matrix_.start_, lp.a_matrix_.index_ = self.matrix.indptr, self.matrix.indices
            lp.a_matrix_.value_ = self.matrix.data
            self.warm = highspy.Highs()
            self.warm.setOptionValue("output_flag", False)
            self.warm.passModel(lp)
        else:
            every, each = np.arange(columns, dtype=np.int32), np.arange(rows, dtype=np.int32)
            if self.blocks > 1:
                self.warm.changeColsCost(columns, every, cost)
            self.warm.changeColsBounds(columns, every, lower, upper)
            self.warm.changeRowsBounds(rows, each, low, high)
        self.warm.run()
        duals = np.array(self.warm.getSolution().row_dual)[: len(self.free)]
        return float(self.warm.getObjectiveValue()), duals


class QuadraticProgramme:
    """The law itself: min cost minus the benefit of the demand, for a given state."""

    def __init__(self, network: Network, weights: np.ndarray):
        import clarabel

        self.network, self.beta = network, weights[network.units : -1]
        flows, balance = _balances(network)
        buses, m, n = len(network.buses), len(network.limit), network.unknowns
        eye = sp.hstack([sp.eye_array(n), sp.csc_array((n, buses))])
        lines = sp.hstack([sp.csc_array((m, n)), flows])
        A = sp.csc_array(sp.vstack([balance, eye, -eye, lines, -lines]))
        P = sp.csc_array(sp.diags_array(np.append(weights, np.zeros(buses))))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False
        cones = [clarabel.ZeroConeT(buses), clarabel.NonnegativeConeT(2 * (n + m))]
        start = self._data(network.largest_capacity()[: network.units], network.load[0])
        self.solver: Any = clarabel.DefaultSolver(
            sp.csc_matrix(P), start[0], sp.csc_matrix(A), start[1], cones, settings
        )

    def _data(self, capacity: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        network, buses = self.network, len(self.network.buses)
        most = network.largest_capacity()[network.units :]
        least = np.append(np.zeros(network.unknowns - 1), network.dc_limit)
        q = np.concatenate([network.cost, -PRICE - self.beta * target, np.zeros(1 + buses)])
        limits = np.tile(network.limit, 2)
        return q, np.concatenate([np.zeros(buses), capacity, most, least, limits])

    def solve(self, capacity: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return u, for the capacities of the units and the demand L + x at the reference price."""
        q, b = self._data(capacity, target)
        self.solver.update(q=q, b=b)
        return np.asarray(self.solver.solve().x)[: self.network.unknowns]
