"""Cournot firms under a sticky price, against bounded least squares, quadrature and closed forms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import lsq_linear, minimize_scalar

import dvax
from dvax.formats import read_rts
from dvax.models.market import Market, MeritOrder, largest_gain

RTS_GMLC = Path(__file__).parents[3] / "shared" / "data" / "RTS-GMLC"
needs_data = pytest.mark.skipif(
    not RTS_GMLC.is_dir(), reason="the RTS-GMLC data are not here (github.com/GridMod/RTS-GMLC)"
)
JULY = 24 * 182

# Hour, made in all (MW), price ($/MWh); the last three to eight decimals.
NASH = [
    (12, 3399.192, 58.08952), (4000, 4710.589, 74.95951), (4800, 3780.326, 64.13551),
    (4811, 5146.931, 80.09561), (8000, 3097.049, 44.61659),
    (JULY + 12, None, 82.34147234), (JULY + 60, None, 83.72281836), (JULY + 100, None, 58.35772052),
]  # fmt: skip


@pytest.fixture(scope="module")
def rts():
    return read_rts(RTS_GMLC)


@pytest.fixture(scope="module")
def week(rts):
    market = Market.from_rts(rts, JULY, 168)
    return market, market.run(rtol=1e-6, atol=1e-6, constants=market.constants)


def numpy_data(market, t):
    parts = market.cost, market.slope, market.firms, market.capacity(t), market.intercept(t)
    return *map(np.asarray, parts), float(market.b)


def bounded_least_squares(market, t):
    """The static equilibrium min ½uᵀMu + (c − α)ᵀu, M = diag(a) + b(G + 11ᵀ), by SciPy's BVLS."""
    c, a, firms, cap, alpha, b = numpy_data(market, t)
    root = np.linalg.cholesky(np.diag(a) + b * (firms @ firms.T + 1.0)).T
    goal = np.linalg.solve(root.T, alpha - c)
    some = cap > 0
    u = np.zeros_like(c)
    # BVLS wants a matrix of full columns and intervals that are some.
    found = lsq_linear(root[:, some], goal, (0.0 * cap[some], cap[some]), method="bvls", tol=1e-14)
    u[some] = found.x
    return u, alpha - b * u.sum()


def made_at(market, t, p):
    """The production of all units at a price; marginal costs λ = p − bQ(λ) by bisection."""
    c, a, firms, cap, _, b = numpy_data(market, t)
    low, high = np.full(firms.shape[1], -1e4), np.full(firms.shape[1], 1e4)
    for _ in range(80):
        middle = 0.5 * (low + high)
        Q = firms.T @ np.clip((firms @ middle - c) / a, 0.0, cap)
        low = np.where(p - b * Q > middle, middle, low)
        high = np.where(p - b * Q > middle, high, middle)
    return np.clip((firms @ high - c) / a, 0.0, cap)


@pytest.mark.thorough
@needs_data
def test_market_hourly_equilibria_of_rts_gmlc(rts):
    assert len(rts.names) == 102 and rts.capacity.shape == (8784, 102)
    year = Market.from_rts(rts, 0, 8784)
    assert float(year.b) == pytest.approx(0.031102779, abs=5e-10)
    hours = np.array([hour for hour, _, _ in NASH], float)
    prices, made = jax.jit(jax.vmap(lambda t: year.equilibrium(t)))(hours)
    for (hour, Q, p), price, u in zip(NASH, np.asarray(prices), np.asarray(made), strict=True):
        if Q is None:
            assert price == pytest.approx(p, abs=6e-9), hour
        else:
            assert (round(float(u.sum()), 3), round(float(price), 5)) == (Q, p), hour
    for k in (1, 4, 6):
        u, price = bounded_least_squares(year, hours[k])
        assert float(prices[k]) == pytest.approx(price, abs=1e-9)
        np.testing.assert_allclose(np.asarray(made)[k], u, atol=1e-6)


@pytest.mark.thorough
@needs_data
def test_market_constants_of_rts_gmlc(week):
    market, _ = week
    c = market.constants
    assert float(c.gamma) == 1e-3 and float(c.L_F) == pytest.approx(4.2734, abs=5e-5)
    assert float(c.L_tilde) == pytest.approx(1.9e4, rel=2e-3)
    assert c.status_of("gamma", "L_F", "one_sided") == "proved"


@pytest.mark.thorough
@needs_data
def test_market_week_in_july(week):
    market, sol = week
    figures = market.figures(sol)
    assert len(figures["price"]) == 168
    # It starts in the equilibrium of its first hour, and follows those of the others with a lag.
    assert figures["sticky_price"][0] == pytest.approx(
        bounded_least_squares(market, JULY)[1], abs=1e-8
    )
    rest = jax.jit(jax.vmap(lambda t: market.equilibrium(t)[0]))(sol.ts)
    np.testing.assert_allclose(figures["price"], rest, rtol=1e-12)
    lag = np.abs(np.asarray(rest) - figures["sticky_price"])
    assert 0.05 < lag.max() < 3.0 and lag[12] < 0.5
    assert 0.0 <= figures["max_deviation_profit"] <= 1e-9
    bound = dvax.bound_error(market.problem, sol, market.constants)
    assert float(bound.x.max()) < 1e-7
    made = np.asarray(sol.us)
    capacity = np.stack([np.asarray(market.capacity(t)) for t in sol.ts[::24]])
    assert made.min() >= 0.0 and np.all(made[::24] <= capacity)
    # The law is as stiff as the literature's explicit steps of a quarter of an hour cannot bear.
    gains = jax.jit(jax.vmap(market.gain))(sol.ts, sol.xs)
    assert 1.9 < float(gains.min()) < 2.47 < float(gains.max()) < 3.0
    assert abs(1.0 - 0.25 * float(market.speed) * (1.0 + 2.47)) > 4.0


@pytest.mark.thorough
@needs_data
def test_market_first_hours_agree_with_an_independent_integrator_and_law(week):
    market, sol = week

    def rate(t, p):
        _, _, _, _, alpha, b = numpy_data(market, t)
        return float(market.speed) * (alpha - b * made_at(market, t, p[0]).sum() - p)

    price = [float(sol.xs[0])]
    for hour in range(3):  # the data have a kink at every hour
        span = (JULY + hour, JULY + hour + 1)
        price.append(solve_ivp(rate, span, price[-1:], "LSODA", rtol=1e-9, atol=1e-9).y[0, -1])
    np.testing.assert_allclose(np.asarray(sol.xs)[:4], price, atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(sol.us)[3], made_at(market, JULY + 3.0, price[3]), atol=1e-4
    )


@needs_data
@pytest.mark.thorough  # the duopoly below converges to its equilibrium in every run
@pytest.mark.parametrize("hours", [(12,), (60, 100)])
def test_market_price_with_constant_data_converges_to_the_equilibrium(rts, week, hours):
    times = np.linspace(0.0, 6.0, 168)
    for k in hours:
        row = JULY + k
        held = lambda value: dvax.signals.Table(times, np.repeat(value[None], 168, axis=0))  # noqa: E731
        frozen = Market(
            cost=rts.cost, slope=rts.slope, firm=np.unique(rts.area, return_inverse=True)[1],
            b=week[0].b, speed=6.0, intercept=held(np.asarray(week[0].intercept(row * 1.0))),
            capacity=held(rts.capacity[row]),
        )  # fmt: skip
        sol = dvax.solve(
            frozen.problem, jnp.asarray(40.0), 0.0, 6.0, ts=times, rtol=1e-6, atol=1e-6,
            method=dvax.ExpRosenbrock(), vi_solver=frozen.law_solver,
        )  # fmt: skip
        reference = next(p for hour, _, p in NASH if hour == row)
        assert float(sol.xs[-1]) == pytest.approx(reference, abs=1e-8)


def small(**changed):
    given = dict(
        cost=[10.0, 30.0, 20.0, 0.0, 25.0], slope=[0.1, 0.05, 0.2, 0.01, 0.1],
        firm=[0, 0, 1, 1, 2], b=0.1, speed=2.0, intercept=100.0,
        capacity=[100.0, 500.0, 200.0, 0.0, 40.0],
    )  # fmt: skip
    return Market(**(given | changed))


@pytest.mark.slow
def test_market_of_two_equal_firms_is_the_textbook_duopoly():
    # p = α − bQ, cost cu + au²/2: each firm makes (α − c)/(3b + a).
    market = small(
        cost=[10.0, 10.0], slope=[0.5, 0.5], firm=[0, 1], b=0.25, intercept=60.0,
        capacity=[1e3, 1e3],
    )  # fmt: skip
    p, u = market.equilibrium(0.0)
    each = 50.0 / (3 * 0.25 + 0.5)
    np.testing.assert_allclose(np.asarray(u), each, rtol=1e-14)
    assert float(p) == pytest.approx(60.0 - 0.5 * each, rel=1e-14)
    # Where no bound is met the price decays at s(1 + gain), gain = 2 · b/(a + b).
    rate = 2.0 * (1.0 + 2 * 0.25 / 0.75)
    assert float(market.gain(0.0, p)) == pytest.approx(2 * 0.25 / 0.75)
    sol = dvax.solve(market.problem, p + 8.0, 0.0, 1.0, vi_solver=market.law_solver)
    assert float(sol.xs[0]) == pytest.approx(float(p) + 8.0 * np.exp(-rate), abs=1e-6)


@pytest.mark.slow
def test_market_equilibrium_and_derivative_agree_with_bounded_least_squares():
    market = small()
    p, u = market.equilibrium(0.0)
    v, price = bounded_least_squares(market, 0.0)
    np.testing.assert_allclose(np.asarray(u), v, atol=1e-10)
    assert float(p) == pytest.approx(price, abs=1e-12)
    at = lambda alpha: small(intercept=alpha).equilibrium(0.0)[0]  # noqa: E731
    slope = float(jax.jacfwd(at)(100.0))
    other = (bounded_least_squares(small(intercept=100.1), 0.0)[1] - price) / 0.1
    assert slope == pytest.approx(other, rel=1e-9)  # linear between kinks


def test_merit_order_solves_random_laws_to_rounding_ties_and_all():
    rng = np.random.default_rng(7)
    n, k = 24, 3
    firms = np.eye(k)[rng.integers(0, k, n)]
    a, b = jnp.asarray(rng.choice([1e-3, 0.1, 2.0], n)), 0.05
    solver = MeritOrder(a, b, jnp.asarray(firms))

    def law(y, q):
        return a * y + b * (firms @ (firms.T @ y)) + q

    for _ in range(30):
        # Equal costs and empty capacities: knots that coincide, and units that cannot move.
        q = jnp.asarray(rng.choice([-40.0, -20.0, -5.0, 3.0], n))
        K = dvax.sets.Box(0.0, jnp.asarray(rng.choice([0.0, 10.0, 400.0], n)))
        mine = dvax.solve_vi(law, K, jnp.zeros(n), q, solver=solver, gamma=1e-3)
        # γ = 1e-3: roundoff alone may keep the bound above the tolerance.
        at_roundoff = float(mine.residual) <= float(mine.rounding)
        assert mine.result == dvax.vi.RESULTS.successful or at_roundoff
        assert float(mine.residual) < 1e-11
        cap = np.asarray(K.upper)
        u, some = np.zeros(n), cap > 0
        root = np.linalg.cholesky(np.diag(np.asarray(a)) + b * firms @ firms.T).T
        goal = -np.linalg.solve(root.T, np.asarray(q))
        u[some] = lsq_linear(
            root[:, some], goal, (0 * cap[some], cap[some]), "bvls", tol=1e-14
        ).x  # fmt: skip
        np.testing.assert_allclose(np.asarray(mine.y), u, atol=1e-7)


@pytest.mark.thorough
def test_merit_order_has_the_derivative_of_the_law():
    market = small()
    q = market.cost - 48.0
    F = market.problem.frozen(0.0, jnp.asarray(48.0))
    K = market.problem.set_at(0.0)

    def made(q, solver):
        law = lambda y, q: F(y) - market.cost + 48.0 + q  # noqa: E731
        return dvax.solve_vi(law, K, jnp.zeros(5), q, solver=solver).y

    mine = jax.jacfwd(lambda q: made(q, market.law_solver))(q)
    others = jax.jacfwd(lambda q: made(q, dvax.vi.ActiveSet()))(q)
    np.testing.assert_allclose(np.asarray(mine), np.asarray(others), atol=1e-12)
    assert np.count_nonzero(np.abs(np.asarray(mine)).sum(axis=1)) >= 2  # some units are free
    assert np.count_nonzero(np.abs(np.asarray(mine)).sum(axis=1)) < 5  # and some are not


def test_merit_order_rejects_a_law_of_another_form():
    solver = MeritOrder(jnp.ones(2), 1.0, jnp.ones((2, 1)))
    M = jnp.array([[3.0, 0.0], [0.0, 2.0]])
    vi = dvax.solve_vi(
        lambda y, _: M @ y - 1.0, dvax.sets.Box(0.0, 5.0), jnp.zeros(2), solver=solver
    )
    assert vi.result == dvax.vi.RESULTS.stalled
    with pytest.raises(dvax.InputError, match="not a box"):
        dvax.solve_vi(
            lambda y, _: M @ y, dvax.sets.Ball(0.0, 1.0), jnp.zeros(2), solver=solver
        )  # fmt: skip
    with pytest.raises(dvax.InputError, match="another shape"):
        dvax.solve_vi(lambda y, _: y, dvax.sets.Box(0.0, 5.0), jnp.zeros(3), solver=solver)


def test_market_deviation_profit_agrees_with_a_search():
    market = small(capacity=[100.0, 500.0, 200.0, 0.0, 400.0])
    p, u = map(np.asarray, market.equilibrium(0.0))
    c, a, firms, cap, _, b = numpy_data(market, 0.0)
    assert largest_gain(p[None], u[None], cap[None], c, a, firms, b) <= 1e-20
    # Firm 2 has one unit: its profit is a function of one number.
    u = u.copy()
    u[4] = 7.0
    p = np.asarray(100.0 - b * u.sum())
    profit = lambda v: (p - b * (v - 7.0)) * v - c[4] * v - a[4] * v * v / 2  # noqa: E731
    best = minimize_scalar(lambda v: -profit(v), bounds=(0.0, 400.0), method="bounded").fun
    alone = firms[:, [2]]
    found = largest_gain(p[None], u[None], cap[None], c, a, alone, b)
    assert found == pytest.approx(-best - profit(7.0), rel=1e-9) and found > 1.0
    assert largest_gain(p[None], u[None], cap[None], c, a, firms, b) >= found


def test_market_constants_are_proved_by_verify():
    market = small()
    mine = market.constants
    found = dvax.verify(market.problem, jnp.asarray(40.0), 0.0, 1.0).constants
    for name in ("L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "omega", "M"):
        assert float(getattr(mine, name)) == pytest.approx(float(getattr(found, name))), name
    # min a is below the least eigenvalue, and the sign of the response is seen by both.
    assert float(mine.gamma) <= float(found.gamma) + 1e-12
    assert float(found.one_sided) <= -2.0 + 1e-9 and float(mine.one_sided) == -2.0


@pytest.mark.thorough
def test_market_prices_approach_with_the_one_sided_rate():
    market = small()
    ends = [
        float(dvax.solve(market.problem, p, 0.0, 1.5, vi_solver=market.law_solver).xs[0])
        for p in (20.0, 95.0)
    ]
    assert 0.0 < ends[1] - ends[0] <= 75.0 * np.exp(-2.0 * 1.5)


BAD = [
    ("cost", [1.0, 2.0]), ("cost", [[1.0] * 5]), ("cost", float("nan")), ("slope", [0.1] * 4 + [0.0]),
    ("slope", "steep"), ("firm", [0, 0, 1, 1, 3]), ("firm", [0.0, 0.0, 1.0, 1.0, 2.0]), ("b", 0.0),
    ("b", -1.0), ("speed", float("inf")), ("intercept", "high"), ("capacity", [1.0] * 4),
    ("capacity", [1.0, 1.0, 1.0, 1.0, -1.0]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_market_rejects_bad_parameters_by_name(name, value):
    with pytest.raises(dvax.InputError) as caught:
        small(**{name: value})
    assert name in caught.value.problems[0].place and len(caught.value.problems) == 1


def test_market_reports_all_bad_parameters_at_once():
    with pytest.raises(dvax.InputError) as caught:
        small(cost=float("nan"), slope="steep", firm=[1], b=0.0, speed=0.0, intercept="high")
    assert len(caught.value.problems) == 6
    with pytest.raises(dvax.InputError, match="Give t0 and t1"):
        small().run()
