"""Day-to-day traffic: closed forms, a linear programme as oracle, and invariants."""

import dataclasses
import doctest
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.models import traffic_networks as networks
from tests.models.proximal_step import ProximalStep
from tests.selection import mostly_thorough

import dvax
from dvax import formats
from dvax.models import traffic
from dvax.models.traffic.costs import link_costs


def run(model, x0, days, ts, **settings):
    settings = dict(dt=0.5, vi_solver=model.vi_solver, constants=model.constants) | settings
    return dvax.solve(model.problem, x0, 0.0, days, ts=np.asarray(ts, float), **settings)


def per_pair(model, flows):
    return np.add.reduceat(np.asarray(flows), model.paths.starts, axis=-1)


# Braess: every path costs 92 with two units of flow on each.


@pytest.fixture(scope="module")
def braess(tmp_path_factory):
    return traffic.Traffic(*networks.braess(tmp_path_factory.mktemp("braess")))


@pytest.mark.slow
def test_traffic_braess_network_reaches_its_equilibrium(braess):
    sol = run(braess, braess.all_or_nothing(), 40.0, [0.0, 40.0])
    assert sorted(np.asarray(sol.xs[0])) == [0.0, 0.0, 6.0]  # the cost of this path is 60 + 16 + 60
    figures = braess.figures(sol)
    for x in (braess.equilibrium, sol.xs[-1]):
        np.testing.assert_allclose(x, 2.0, atol=1e-7)
        along = braess.incidence.along(braess.costs(0.0, x))
        np.testing.assert_allclose(along, 92.0, atol=1e-5)
    assert figures["objective"] == pytest.approx(386.0, rel=1e-9)  # 2·80 + 2·102 + 22
    assert figures["total_travel_time"] == pytest.approx(552.0, rel=1e-8)
    assert figures["max_conservation_error"] <= 1e-12
    assert braess.fit.startswith("exact") and braess.relative_gap(0.0, sol.xs[-1]) <= 1e-8


@pytest.mark.slow
def test_traffic_law_agrees_with_the_enumeration_of_faces(braess):
    incidence = braess.paths.incidence().toarray()
    slope = incidence @ np.diag([10.0, 1.0, 1.0, 1.0, 10.0]) @ incidence.T
    start = incidence @ np.array([0.0, 50.0, 50.0, 10.0, 0.0])
    rho, rng = braess.rho, np.random.default_rng(0)
    for x in rng.uniform(-9.0, 9.0, (5, 3)):
        # (I + ρM)y + ρc₀ − x = λ on the paths that are used: the one face with y ≥ 0 and λ right.
        answers = []
        for used in itertools.product([False, True], repeat=3):
            k = np.flatnonzero(used)
            if k.size:
                matrix = np.block(
                    [[np.eye(k.size) + rho * slope[np.ix_(k, k)], -np.ones((k.size, 1))],
                     [np.ones((1, k.size)), np.zeros((1, 1))]]
                )  # fmt: skip
                found = np.linalg.solve(matrix, [*(x - rho * start)[k], 6.0])
                y = np.zeros(3)
                y[k] = found[:-1]
                force = y + rho * (slope @ y + start) - x - found[-1]
                if y.min() >= 0 and force.min() >= -1e-7:
                    answers.append(y)
        u = braess.problem.response(0.0, jnp.asarray(x), solver=braess.vi_solver)
        np.testing.assert_allclose(u, answers[0], atol=1e-8)


# Two roads: tolls, lengths, an incident and a rush, with one line of algebra.


def two_roads_share(factor=1.0, remaining=1.0, toll=0.0, distance=0.0):
    """v₁ with 10 + 0.1v₁ + 4·toll + 8·distance = 11 + 0.2v₂/remaining + 3·distance."""
    d, a = 90.0 * factor, 0.2 / remaining
    return (1.0 + a * d - 4.0 * toll - 5.0 * distance) / (0.1 + a)


def test_traffic_tolls_and_lengths_enter_with_their_weights():
    for toll, distance in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.25), (0.5, 0.25)):
        model = traffic.Traffic(
            *networks.two_roads(), toll_weight=toll, distance_weight=distance, rho=10.0
        )
        first = two_roads_share(toll=toll, distance=distance)
        v = np.asarray(model.link_flows(model.equilibrium))
        np.testing.assert_allclose(v, [first, 90 - first, 90 - first], rtol=1e-11)
        c, length, tolls = model.costs(0.0, model.equilibrium), [8.0, 0.0, 3.0], [4.0, 0.0, 0.0]
        times = np.asarray(c) - distance * np.array(length) - toll * np.array(tolls)
        time = float(model.total_travel_time(0.0, model.equilibrium))
        assert time == pytest.approx(np.dot(times, v), rel=1e-13)  # tolls are not time


@pytest.mark.thorough
def test_traffic_follows_changing_demand_and_an_incident():
    rush = dvax.signals.Table([0.0, 10.0, 12.0, 60.0], [1.0, 1.0, 1.5, 1.5])
    hole = traffic.Incident((1, 3), 0.4, 30.0, 45.0)
    model = traffic.Traffic(*networks.two_roads(), rho=50.0, demand=rush, incidents=[hole])
    ts = np.array([0.0, 9.5, 11.0, 12.0, 29.5, 30.0, 44.5, 45.0, 60.0])
    sol = run(model, model.equilibrium, 60.0, ts)
    found = np.asarray(jax.vmap(model.link_flows)(sol.xs))[:, 0]
    for k, factor, remaining in ((1, 1.0, 1.0), (4, 1.5, 1.0), (6, 1.5, 0.4), (8, 1.5, 1.0)):
        assert found[k] == pytest.approx(two_roads_share(factor, remaining), rel=1e-6), ts[k]
    # u adds up to d(t); x follows it, s' = d − s, along the ramp d = 90 + 22.5(t − 10).
    np.testing.assert_allclose(per_pair(model, sol.us)[:, 0], 90 * rush_at(ts), rtol=1e-13)
    late = np.where(ts < 12.0, ts - 10.0, 2.0)
    ramp = 90 + 22.5 * np.where(ts > 10.0, late - 1 + np.exp(-late), 0.0)
    behind = np.where(ts > 12.0, 135 - (135 - ramp) * np.exp(-(ts - 12.0)), ramp)
    np.testing.assert_allclose(per_pair(model, sol.xs)[:, 0], behind, rtol=1e-12)
    assert model.figures(sol)["max_conservation_error"] <= 1e-12
    # What a time sees at the ends of an incident: it has begun at its start, and is over at its end.
    each = [float(model.capacity(t)[1]) for t in (29.9, 30.0, 44.9, 45.0)]
    assert each == pytest.approx([50.0, 20.0, 20.0, 50.0], rel=1e-15)
    assert model.problem.knots(0.0, 60.0, sol.xs[0]).tolist() == [10.0, 12.0, 30.0, 45.0]
    # L_F is that of the worst of it: 135 trips, and 0.4 of the capacity.
    plain = traffic.Traffic(*networks.two_roads(), rho=50.0)
    assert float(plain.constants.L_F) == pytest.approx(1 + 50.0 * 0.2, rel=1e-6)
    assert float(model.constants.L_F) == pytest.approx(1 + 50.0 * 0.5, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    mostly_thorough(
        ["one path", "no congestion", "constant costs"], ["one path", "constant costs"]
    ),
)
def test_traffic_network_without_choice_or_congestion_is_solved(case):
    # Two roads of equal cost for the last case; no link is stiff, or no pair has two paths.
    congested = case == "one path"
    columns = dict(
        init_node=[1, 3, 1, 4], term_node=[3, 2, 4, 2], length=[1.0] * 4, power=[4.0] * 4,
        capacity=[10.0 if congested else 1e6] * 4, b=[0.0 if case == "constant costs" else 0.15] * 4,
        free_flow_time=[5.0, 1.0, 500.0 if congested else 5.0, 1.0],
    )  # fmt: skip
    network = traffic.Network(zones=2, nodes=4, first_thru_node=3, **columns)
    model = traffic.Traffic(network, traffic.Trips(2, [1], [2], [10.0]))
    sol = run(model, model.equilibrium, 3.0, [3.0])
    np.testing.assert_allclose(sol.xs[-1].sum(), 10.0, rtol=1e-12)
    np.testing.assert_allclose(sol.xs[-1], model.equilibrium, rtol=1e-9)


def test_traffic_incidents_on_one_link_multiply():
    holes = [traffic.Incident((1, 3), 0.5, 1.0, 4.0), traffic.Incident((1, 3), 0.4, 3.0, 5.0)]
    model = traffic.Traffic(*networks.two_roads(), rho=50.0, incidents=holes)
    each = [float(model.capacity(t)[1]) for t in (0.0, 1.0, 3.0, 4.0, 5.0)]
    assert each == pytest.approx([50.0, 25.0, 10.0, 20.0, 50.0], rel=1e-15)
    assert float(model.constants.L_F) == pytest.approx(1 + 50.0 * 0.2 * 5.0, rel=1e-6)


def rush_at(t):
    return np.interp(t, [0.0, 10.0, 12.0, 60.0], [1.0, 1.0, 1.5, 1.5])


def test_traffic_demand_above_its_peak_is_nan_and_ends_the_run():
    rush = lambda t: 1.0 + 0.1 * t  # noqa: E731
    model = traffic.Traffic(*networks.two_roads(), rho=50.0, demand=rush, peak=1.4)
    totals = [float(model.problem.set_at(t).total[0]) for t in (0.0, 4.0, 4.1, -10.5)]
    np.testing.assert_allclose(totals, [90.0, 126.0, np.nan, np.nan], rtol=1e-15)


# A street grid with zones that are not passed through, constant links, tolls and powers from 1 to 6.


WEIGHTS = dict(toll_weight=0.3, distance_weight=0.4)


@pytest.fixture(scope="module")
def city():
    return traffic.Traffic(*networks.grid(6, 7, 12, 60, 6e4, seed=1), **WEIGHTS, rho=2000.0)


@pytest.fixture(scope="module")
def days(city):
    """Two trajectories over the same days."""
    ts = [0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 24.0]
    shares = np.random.default_rng(2).exponential(size=len(city.equilibrium))
    other = shares * np.repeat(city.trips.flow / per_pair(city, shares), city.paths.sizes)
    starts = city.all_or_nothing(), jnp.asarray(other)
    return [run(city, x0, 24.0, ts) for x0 in starts]


@pytest.mark.slow
def test_traffic_equilibrium_has_the_least_cost_over_all_flows(city):
    # c(v)·w ≥ c(v)·v for all flows w makes v the least of Φ, which is convex; w by linear programming
    # on links, with neither paths nor split nodes.
    network, trips = city.network, city.trips
    v = np.asarray(city.link_flows(city.equilibrium))
    c = networks.bpr(network, v, **WEIGHTS)
    np.testing.assert_allclose(city.costs(0.0, city.equilibrium), c, rtol=1e-13)
    assert abs(c @ v - networks.cheapest(network, trips, c)) <= 1e-11 * (c @ v)
    networks.walks(network, trips, city.paths)
    np.testing.assert_allclose(per_pair(city, city.equilibrium), trips.flow, rtol=1e-12)
    assert city.gap <= 1e-12 and city.relative_gap(0.0, city.equilibrium) <= 2e-12
    # Where anybody may drive through zones the answer is another one: the rule is at work.
    open_ = traffic.Traffic(dataclasses.replace(network, first_thru_node=1), trips, **WEIGHTS)
    least = float(open_.objective(0.0, open_.equilibrium))
    assert least < 0.8 * float(city.objective(0.0, city.equilibrium))


@pytest.mark.thorough
def test_traffic_converges_to_the_equilibrium_and_conserves_trips(city, days):
    least = float(city.objective(0.0, city.equilibrium))
    for sol in days:
        objective = np.array([float(city.objective(0.0, x)) for x in sol.xs])
        assert np.all(np.diff(objective) < 1e-13 * least)  # Φ' ≤ −(κ/ρ)‖u − x‖²
        assert objective[0] > 1.5 * least and abs(objective[-1] / least - 1) <= 1e-9
        figures = city.figures(sol)
        assert figures["objective"] == objective[-1]
        assert figures["max_conservation_error"] <= 1e-12
        assert float(jnp.min(sol.xs)) >= 0.0


@pytest.mark.thorough
def test_traffic_trajectories_do_not_separate(city, days):
    apart = np.linalg.norm(np.asarray(days[0].xs) - np.asarray(days[1].xs), axis=1)
    tolerance = 40 * city.vi_solver.least
    assert apart[0] > 1e3 and np.all(np.diff(apart) <= tolerance)
    c = city.constants
    assert float(c.growth_rate) == 0.0 == float(c.sharp_decay_rate) and float(c.L) == 1.0


@pytest.mark.thorough
def test_traffic_responses_are_within_their_certificate(city, days):
    # By a Newton method with dense matrices, which shares no code with the solver but link costs.
    costs = jax.tree_util.tree_map(np.asarray, city.link_costs)
    step = ProximalStep(costs, city.network.capacity, city.paths, city.trips.flow)
    for sol in days:
        for x, u, bound in zip(sol.xs, sol.us, sol.law_error, strict=True):
            exact, tries = step.solve(np.asarray(x), city.rho, 1e-14, most=500)
            error = np.linalg.norm(np.asarray(u) - exact)
            rounding = 2e-16 * float(city.constants.L_F) * np.linalg.norm(exact)
            assert tries < 500 and error <= float(bound) + rounding and float(bound) <= 1e-2


@pytest.mark.slow
def test_traffic_objective_gradient_is_the_path_costs(city):
    for x in (city.all_or_nothing(), city.equilibrium):
        slope = jax.grad(lambda x: city.objective(0.0, x))(x)
        along = city.incidence.along(city.costs(0.0, x))
        np.testing.assert_allclose(slope, along, rtol=1e-12)


# The constants.


def test_traffic_moduli_hold_and_are_nearly_sharp(city):
    c, problem = city.constants, city.problem
    assert c.status_of("gamma", "L_F", "alpha_h", "beta_h", "beta_f", "one_sided") == "proved"
    F = jax.jit(lambda y: problem.frozen(0.0, jnp.zeros_like(y))(y))
    rng, n = np.random.default_rng(3), len(city.equilibrium)
    worst = np.repeat(
        city.trips.flow, city.paths.sizes
    )  # the whole demand on every path: no flow is larger
    points = [worst, -worst, 3 * worst, np.zeros(n), np.asarray(city.equilibrium)]
    points += [worst * rng.uniform(-1, 2, n) for _ in range(10)]
    for y, z in itertools.combinations(points, 2):
        move, turn = y - z, np.asarray(F(jnp.asarray(y)) - F(jnp.asarray(z)))
        assert turn @ move >= (1 - 1e-9) * move @ move
        assert np.linalg.norm(turn) <= float(c.L_F) * np.linalg.norm(move) * (1 + 1e-12)
    # The Jacobian where all is steepest, by its eigenvalues.
    most = np.asarray(city.link_costs.most)
    slope = (
        city.network.b * city.network.power * city.network.free_flow_time / city.network.capacity
    )
    slope = slope * (most / city.network.capacity) ** np.maximum(city.network.power - 1, 0)
    incidence = city.paths.incidence().toarray()
    exact = 1 + city.rho * np.linalg.eigvalsh(incidence @ np.diag(slope) @ incidence.T)[-1]
    assert exact <= float(c.L_F) <= 1.01 * exact


def test_traffic_costs_are_the_derivative_of_their_integral():
    """Beyond the largest flow the costs are extended linearly."""
    network, _ = networks.grid(5, 5, 8, 20, 1e4, seed=4)
    costs = link_costs(network, 0.3, 0.4).up_to(2.0 * network.capacity)
    rng, capacity = np.random.default_rng(5), network.capacity
    for _ in range(5):
        v, h = capacity * rng.uniform(0.1, 1.9, len(network)), 1e-4 * capacity
        chord = (costs.integrals(v + h, capacity) - costs.integrals(v - h, capacity)) / (2 * h)
        np.testing.assert_allclose(costs.costs(v, capacity), chord, rtol=2e-6)
        rise = (costs.costs(v + h, capacity) - costs.costs(v - h, capacity)) / (2 * h)
        np.testing.assert_allclose(costs.slopes(v, capacity), rise, rtol=2e-6, atol=1e-12)
    constant = (network.b == 0) | (network.power == 0)
    free = network.free_flow_time * np.where(network.power == 0, 1 + network.b, 1.0)
    assert 20 <= constant.sum() < len(network)
    full = costs.times(2 * capacity, capacity)
    np.testing.assert_allclose(full[constant], free[constant], rtol=1e-15)
    # Beyond what is feasible: one slope above, one below (that at 0, which is 0 but for power 1).
    above = [costs.times(k * capacity, capacity) for k in (2.0, 3.0, 7.0)]
    np.testing.assert_allclose((above[2] - above[0]) / 5, above[1] - above[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(above[1] - above[0], costs.slopes(2 * capacity, capacity) * capacity)
    below = costs.times(-capacity, capacity) - costs.times(0 * capacity, capacity)
    first = np.where(network.power == 1, network.free_flow_time * network.b, 0.0)
    np.testing.assert_allclose(below, -first, atol=1e-12)


# What is refused.


TABLE = dvax.signals.Table
BAD = {
    "rate": (dict(rate=-1.0), "> 0"),
    "rho": (dict(rho=float("nan")), "> 0"),
    "gap": (dict(gap="small"), "> 0"),
    "toll_weight": (dict(toll_weight=-0.1), "≥ 0"),
    "distance_weight": (dict(distance_weight=True), "≥ 0"),
    "demand": (dict(demand=1.5), "signal or a callable"),
    "(demand)": (dict(demand=TABLE([0.0, 1.0], [1.0, -1.0])), "must be ≥ 0"),
    "peak": (dict(demand=lambda t: 1.0 + t), "maximum of a Function is unknown"),
    "(peak)": (dict(demand=lambda t: 1.0 + t, peak=0.0), "positive"),
    "(demand) ": (dict(demand=TABLE([0.0, 1.0], [[1.0, 1.0], [2.0, 2.0]])), "each of the 1 pairs"),
    "incidents[0].link": (dict(incidents=[traffic.Incident((3, 1), 0.5, 0.0, 1.0)]), "3 go to 2"),
    "incidents[0].remaining": (dict(incidents=[traffic.Incident((3, 2), 0.0, 0.0, 1.0)]), "(0, 1]"),
    "incidents[0].start": (
        dict(incidents=[traffic.Incident((3, 2), 0.5, 2.0, 1.0)]), "start < end",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_traffic_rejects_bad_arguments_by_name(case):
    arguments, said = BAD[case]
    with pytest.raises(dvax.InputError) as caught:
        traffic.Traffic(*networks.two_roads(), **({"rho": 10.0} | arguments))
    (problem,) = caught.value.problems
    assert case.strip() in problem.place and said in f"{problem.rule} {problem.fix}"


def test_traffic_rejects_networks_outside_the_class():
    def refused(columns, **arguments):
        with pytest.raises(dvax.InputError) as caught:
            traffic.Traffic(*networks.two_roads(**columns), **arguments)
        return str(caught.value)

    said = refused({"power": [0.5, 1.0, 4.0]}, rho=1.0)
    assert "network, link 1" in said and "infinitely steep" in said
    assert "no column toll" in refused({"toll": None}, toll_weight=1.0, rho=1.0)
    assert "Give rho" in refused({"free_flow_time": [0.0, 0.0, 0.0]})
    with pytest.raises(dvax.InputError, match="network.*TNTP file"):
        traffic.Traffic(5, networks.two_roads()[1])
    with pytest.raises(dvax.SolveError, match="larger gap"):
        traffic.Traffic(*networks.grid(4, 4, 5, 10, 2e4, seed=7), rho=1.0, gap=1e-25)


# Real sizes.


@pytest.fixture(scope="module")
def sioux_falls():
    folder = networks.SIOUX_FALLS
    if not folder.is_dir():
        pytest.skip(f"the Sioux Falls files are not at {folder}")
    files = folder / "SiouxFalls_net.tntp", folder / "SiouxFalls_trips.tntp"
    model = traffic.Traffic(*files, rho=2000.0)
    return model, formats.read_flows(folder / "SiouxFalls_flow.tntp", model.network)


@pytest.mark.slow
def test_traffic_sioux_falls_agrees_with_published_flows(sioux_falls):
    model, known = sioux_falls
    spent = float(model.total_travel_time(0.0, model.equilibrium))
    assert spent == pytest.approx(7_480_225.344921, rel=1e-9)
    assert float(model.objective(0.0, model.equilibrium)) == pytest.approx(
        4_231_335.287107440, rel=1e-12
    )
    np.testing.assert_allclose(model.link_flows(model.equilibrium), known.volume, atol=1e-3)
    np.testing.assert_allclose(model.costs(0.0, model.equilibrium), known.cost, atol=1e-6)


@pytest.mark.thorough
def test_traffic_days_of_sioux_falls_converge_to_published_flows(sioux_falls):
    model, known = sioux_falls
    ts = np.array([0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 40.0])
    sol = run(model, model.all_or_nothing(), 40.0, ts, method=dvax.ETD1())
    figures = model.figures(sol)
    assert figures["objective"] == pytest.approx(4_231_335.287107, rel=1e-9)
    # Of first order in the distance to the equilibrium, which falls by e^(−t/2) (`above` is of second
    # order and falls by e^(−t)): e⁻²⁰ = 2·10⁻⁹ after 40 days, as found, so 10⁻⁹ would be too much.
    assert figures["total_travel_time"] == pytest.approx(7_480_225.344921, rel=1e-8)
    assert figures["max_conservation_error"] <= 1e-12
    np.testing.assert_allclose(model.link_flows(sol.xs[-1]), known.volume, atol=1e-3)
    np.testing.assert_allclose(model.costs(0.0, sol.xs[-1]), known.cost, atol=1e-6)
    above = [float(model.objective(0.0, x)) / 4_231_335.287107440 - 1 for x in sol.xs]
    assert above[1:6] == pytest.approx([3.0e-3, 4.8e-5, 8.8e-7, 1.6e-8, 3.0e-10], rel=0.1)


@pytest.mark.thorough
def test_traffic_network_of_the_size_of_anaheim():
    network, trips = networks.grid(20, 18, 38, 1400, 4e4, seed=2, one_way=True)
    assert network.nodes == 398 and len(network) == 910 and len(trips) == 1400
    model = traffic.Traffic(network, trips, **WEIGHTS)
    v = np.asarray(model.link_flows(model.equilibrium))
    c = networks.bpr(network, v, **WEIGHTS)
    assert abs(c @ v - networks.cheapest(network, trips, c)) <= 1e-10 * (c @ v)
    sol = run(model, model.all_or_nothing(), 40.0, [40.0], method=dvax.ETD1(), dt=0.25)
    figures = model.figures(sol)
    least = float(model.objective(0.0, model.equilibrium))
    assert figures["objective"] == pytest.approx(least, rel=1e-9)
    assert figures["max_conservation_error"] <= 1e-12


def test_traffic_docstring_examples_print_the_documented_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [vars(traffic)[name] for name in ("Network", "Trips", "Incident")]
    names += [formats.read_network, formats.read_trips]
    found = [doctest.DocTestFinder(recurse=False).find(n, module=False, globs={}) for n in names]
    assert all(any(t.examples for t in tests) for tests in found)
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for one in itertools.chain(*found):
        runner.run(one, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)
