"""Circuits: equations against an independent analysis, trajectories against exact ones."""

import itertools
import json
import subprocess
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from tests.models.piecewise_linear import Regime, follow
from tests.models.tableau import random_netlist, tableau
from tests.oracles import affine_box_vi
from tests.selection import mostly_thorough

import dvax
from dvax.models.circuit import Circuit

REFERENCE = Path(__file__).parents[3] / "shared" / "data" / "circuits" / "CircuitRLCD.ref"
PYTHON = "/usr/bin/python3"

L, C, R = 1e-2, 1e-6, 1e3
TANK = "C1 1 0 1u IC=10\nL1 1 0 10m\nD1 1 0 R=1k"
BRIDGE = """
C1 a 0 1uF IC=10V
L1 a 0 10mH
D1 a p
D2 0 p
D3 n a
D4 n 0
R1 p n 1kohm
"""
TIMES = np.linspace(0.0, 4.99e-3, 500)


@pytest.fixture(scope="module")
def exact():
    """The tank: a damped oscillation while the diode conducts, an undamped one while it blocks."""
    v = np.array([1.0, 0, 0, 0, 0])
    row = lambda damping: np.array([[-damping, -1 / C, 0, 0, 0], [1 / L, 0, 0, 0, 0]])  # noqa: E731
    regimes = {
        "conducts": Regime(row(1 / (R * C)), [(v, "blocks")]),
        "blocks": Regime(row(0.0), [(-v, "conducts")]),
    }
    return follow(regimes, "conducts", np.array([10.0, 0.0]), TIMES, 0 * TIMES, 5e-6)


@pytest.fixture(scope="module")
def tank():
    circuit = Circuit(TANK)
    return circuit, circuit.solve(TIMES[-1], ts=TIMES, dense=True, max_steps=2000)


def theta_scheme(theta, h, count):
    """x₁ = x₀ + hA((1−θ)x₀ + θx₁) + hBλ, 0 ≤ λ ⟂ Rλ − v₁ ≥ 0."""
    A, B = np.array([[0.0, -1 / C], [1 / L, 0.0]]), np.array([-1 / C, 0.0])
    inverse = np.linalg.inv(np.eye(2) - h * theta * A)
    out = [np.array([10.0, 0.0])]
    for _ in range(count):
        free, push = inverse @ (out[-1] + h * (1 - theta) * A @ out[-1]), inverse @ (h * B)
        out.append(free + push * max(free[0] / (R - push[0]), 0.0))
    return np.array(out)


def test_circuit_matrices_of_the_tank_agree_with_the_hand_derivation():
    circuit = Circuit(TANK)
    assert circuit.fit == "exact" and circuit.states == ("C1", "L1") and circuit.diodes == ("D1",)
    for name, matrix in (
        ("A", [[0, -1 / C], [1 / L, 0]]), ("B", [[-1 / C], [0]]), ("C", [[-1, 0]]), ("D", [[R]]),
        ("x0", [10, 0]), ("storage", [C, L]),
    ):  # fmt: skip
        np.testing.assert_allclose(np.asarray(getattr(circuit, name)), matrix, rtol=1e-15)


def test_circuit_tank_and_its_switchings_are_solved_to_rounding(tank, exact):
    _, solution = tank
    assert len(exact.switchings) == 16
    errors = np.abs(np.asarray(solution.xs) - exact.states)
    assert errors[:, 0].max() < 1e-10 and errors[:, 1].max() < 1e-12  # of 10 V and 0.1 A
    found = solution.regimes().times[1:-1]
    np.testing.assert_allclose(found, exact.switchings, atol=1e-9)


def test_circuit_error_bound_holds_and_is_small(tank, exact):
    circuit, solution = tank
    bound = dvax.bound_error(circuit.problem, solution, circuit.constants)
    errors = np.sqrt((np.asarray(solution.xs) - exact.states) ** 2 @ np.array([C, L]))
    energy = np.sqrt(C * 10.0**2)
    assert np.all(errors <= np.asarray(bound.x) + 1e-12 * energy)
    assert np.asarray(bound.x).max() < 1e-6 * energy
    assert np.all(np.asarray(solution.law_residual) < 1e-12 * 10.0)  # of ten volts


@pytest.mark.thorough
def test_circuit_trajectories_do_not_separate(tank):
    circuit, solution = tank
    other = dvax.solve(
        circuit.problem, jnp.array([-3.0, 0.05]), 0.0, TIMES[-1], ts=TIMES,
        method=dvax.ExpRosenbrock(), rtol=1e-8, atol=1e-12, dense=True, max_steps=2000,
    )  # fmt: skip
    apart = np.asarray(solution.xs - other.xs) ** 2 @ np.array([C, L])
    assert np.all(np.diff(apart) <= 1e-12 * apart[0]) and apart[-1] < 0.7 * apart[0]
    assert float(circuit.constants.one_sided) == 0.0


def test_circuit_siconos_reference_file_is_the_output_of_its_scheme(tank, exact):
    if not REFERENCE.exists():
        pytest.skip(
            "needs the CircuitRLCD.ref of Siconos's tutorials under ../shared/data/circuits"
        )
    reference = np.loadtxt(REFERENCE, skiprows=1)[:, :3]
    np.testing.assert_allclose(reference[:, 0], TIMES, atol=1e-15)
    scheme = theta_scheme(0.5, 1e-5, 499)
    np.testing.assert_allclose(scheme, reference[:, 1:], atol=1e-11)
    off = np.abs(reference[:, 1] - exact.states[:, 0]).max()
    assert off == pytest.approx(0.311, abs=5e-4)
    # dvax is on the side of the truth.
    assert np.abs(reference[:, 1] - np.asarray(tank[1].xs)[:, 0]).max() == pytest.approx(off)


SICONOS = """
import json, sys
import numpy as np
import siconos.kernel as sk
order = json.load(sys.stdin)
A, B, C, D, x0 = (np.array(order[name], float) for name in ("A", "B", "C", "D", "x0"))
h, steps = order["h"], order["steps"]
model = sk.NonSmoothDynamicalSystem(0.0, h * (steps + 1))
ds = sk.FirstOrderLinearDS(x0, A)
relation = sk.FirstOrderLinearTIR(C, B)
relation.setDPtr(D)
law = sk.ComplementarityConditionNSL(len(D))
inter = sk.Interaction(law, relation)
model.insertDynamicalSystem(ds)
model.link(inter, ds)
scheme, grid, lcp = sk.EulerMoreauOSI(0.5), sk.TimeDiscretisation(0.0, h), sk.LCP()
loop = sk.TimeStepping(model, grid, scheme, lcp)
for _ in range(steps):
    loop.computeOneStep()
    loop.nextStep()
print("answer", json.dumps([float(v) for v in ds.x()]))
"""


def siconos(circuit, h, steps):
    order = {
        name: np.asarray(getattr(circuit, name)).tolist() for name in ("A", "B", "C", "D", "x0")
    }
    answer = subprocess.run(
        [PYTHON, "-c", SICONOS], input=json.dumps({**order, "h": h, "steps": steps}),
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    line = next(line for line in answer.stdout.splitlines() if line.startswith("answer "))
    return np.array(json.loads(line.removeprefix("answer ")))


def test_circuit_siconos_converges_to_the_same_state(tank, exact):
    if (
        not Path(PYTHON).exists()
        or subprocess.run(
            [PYTHON, "-c", "import siconos.kernel"], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("needs Siconos in the system's Python (Debian: python3-siconos)")
    circuit, _ = tank
    at = 100
    coarse = siconos(circuit, 1e-5, at)
    np.testing.assert_allclose(coarse, theta_scheme(0.5, 1e-5, at)[-1], atol=1e-9)
    fine = siconos(circuit, 5e-7, 20 * at)
    errors = [abs(x[0] - exact.states[at, 0]) for x in (coarse, fine)]
    assert errors[1] < 0.1 * errors[0] < 0.05


def test_circuit_bridge_without_resistance_is_rejected_with_its_lines():
    for options, said in (
        ({}, "only D1, D2, D3, D4 connects the part with node p to the rest"),
        ({"r_on": 1.0}, "only D1, D2, D3, D4 connects the part with node p to the rest"),
        ({"g_leak": 1e-6}, "no resistance, so γ = λ_min(D) = 0"),
    ):
        with pytest.raises(dvax.InputError) as caught:
            Circuit(BRIDGE, **options)
        (problem,) = caught.value.problems
        assert said in problem.rule and "r_on = 0.1 and g_leak = 1e-9" in problem.fix
        first = 4 if "g_leak" not in options else 5
        lines = ", ".join(map(str, range(first, 7)))
        assert problem.place == f"netlist, lines {lines} and 7"


@pytest.mark.thorough
def test_circuit_regularised_bridge_converges_to_the_ideal_one():
    # Between ideal diodes the resistor always sees |v|, and current of the sign of v: it is linear.
    damped = np.array([[-1 / (R * C), -1 / C], [1 / L, 0.0]])
    ts = TIMES[1::10]
    ideal = np.array([scipy.linalg.expm(damped * t) @ [10.0, 0.0] for t in ts])

    def error(r_on, g_leak):
        circuit = Circuit(BRIDGE, r_on=r_on, g_leak=g_leak)
        assert circuit.fit.startswith(f"regularised by r_on = {r_on} Ω and g_leak = {g_leak} S")
        found = np.asarray(circuit.solve(ts[-1], ts=ts).xs)
        return np.abs(found - ideal)[:, 0].max()

    by_resistance = [error(r, 1e-12) for r in (1.0, 0.1, 0.01)]
    by_leak = [error(1e-4, g) for g in (1e-5, 1e-6, 1e-7)]
    for errors in (by_resistance, by_leak):
        assert 1e-3 < errors[0] < 0.1
        np.testing.assert_allclose(np.log10(np.array(errors[:-1]) / errors[1:]), 1.0, atol=0.05)
    # Where v is small the load sees |v| too.
    circuit = Circuit(BRIDGE, r_on=1e-3, g_leak=1e-9)
    x = jnp.array([-2.0, 0.01])
    u = circuit.problem.response(0.0, x)
    at = dict(zip(circuit.nodes, np.asarray(circuit.voltages(0.0, x, u)), strict=True))
    assert at["p"] - at["n"] == pytest.approx(2.0, rel=1e-5) and at["a"] == pytest.approx(-2.0)
    currents = np.asarray(circuit.currents(0.0, x, u))
    np.testing.assert_allclose(currents, [0.0, 2e-3, 2e-3, 0.0], atol=1e-7)


@pytest.mark.parametrize("seed", mostly_thorough(range(12), range(4)))
def test_circuit_equations_agree_with_an_independent_analysis(seed):
    rng = np.random.default_rng(seed)
    text = random_netlist(rng, island=seed % 2 == 0)
    circuit, other = Circuit(text), tableau(text)
    assert any(circuit.blocking) == (seed % 2 == 0)
    m, s = len(circuit.diodes), len(circuit.sources)
    p, D = np.asarray(circuit.P), np.asarray(circuit.D)
    assert np.linalg.eigvalsh(D + D.T)[0] > 0
    for _ in range(5):
        x, source = rng.normal(size=len(circuit.states)), rng.normal(size=s)
        values = []
        for found, weights in ((circuit, p), (other, np.ones(m))):
            A, B, b, C_, D_, e = (
                np.asarray(getattr(found, n)) for n in ("A", "B", "b", "C", "D", "e")
            )
            q = (C_ @ x + e @ source) / weights
            y = affine_box_vi(D_ / weights[:, None] / weights, q, np.zeros(m), np.full(m, np.inf))
            u = y / weights
            w = D_ @ u + C_ @ x + e @ source
            is_ = np.array(found.blocking)
            values.append((A @ x + B @ u + b @ source, np.where(is_, w, u), np.where(is_, u, w)))
        for mine, theirs in zip(*values, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-8, atol=1e-8)
        assert np.all(values[0][1] >= -1e-10) and np.all(values[0][2] >= -1e-8)


def test_circuit_constants_are_proved_and_the_one_sided_rate_is_not_positive():
    for text, options in (
        (BRIDGE, {"r_on": 1.0, "g_leak": 1e-6}),
        (random_netlist(np.random.default_rng(3), island=True), {}),
    ):
        circuit = Circuit(text, **options)
        mine = circuit.constants
        check = dvax.verify(circuit.problem, circuit.x0, 0.0, 1e-3)
        assert check.status == "proved"
        for name in (
            "gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "m_P", "norm_P_inv",
        ):  # fmt: skip
            a, b = float(getattr(mine, name)), float(getattr(check.constants, name))
            assert a == pytest.approx(b, rel=1e-6, abs=1e-9), name
        assert mine.status_of("gamma", "one_sided") == "proved"
        # Its own search over τ can only be sharper than τ = 1, up to rounding.
        sharp = float(check.constants.one_sided)
        assert float(mine.one_sided) <= 0.0 and sharp <= float(mine.one_sided) + 1e-6 * float(
            mine.L_F
        )


@pytest.mark.thorough
def test_circuit_mains_rectifier_agrees_with_scipy():
    text = """
    V1 in 0 SIN(1 12 50 3m 20 30)    ; offset amplitude frequency delay damping phase
    D1 in out R=2
    C1 out 0 470u IC=0.5
    R1 out 0 100
    I1 0 out PWL(0 0, 20m 0.1, 50m -0.05)
    """
    circuit = Circuit(text)

    def rate(t, x):
        s = max(t - 3e-3, 0.0)
        v = 1.0 + 12.0 * np.exp(-20.0 * s) * np.sin(2 * np.pi * 50.0 * s + np.pi / 6)
        i = np.interp(t, [0, 0.02, 0.05], [0, 0.1, -0.05])
        return (max(v - x, 0.0) / 2.0 - x / 100.0 + i) / 470e-6

    x, stops = [0.5], [0.0, 3e-3, 20e-3, 50e-3]
    for a, b in itertools.pairwise(stops):
        leg = scipy.integrate.solve_ivp(
            rate, (a, b), [x[-1]], "DOP853", rtol=1e-11, atol=1e-12, max_step=2e-4
        )
        x.append(leg.y[0, -1])
    found = circuit.solve(0.05, ts=np.array(stops), rtol=1e-7)
    np.testing.assert_allclose(np.asarray(found.xs)[:, 0], x, rtol=1e-6)
    np.testing.assert_array_equal(circuit.problem.knots(0.0, 0.05, circuit.x0), [3e-3, 20e-3])
    figures = circuit.figures(0.05, ts=np.array(stops), rtol=1e-7)
    assert list(figures.values()) == [float(found.xs[-1, 0])]


@pytest.mark.slow
@pytest.mark.parametrize("series", mostly_thorough([1.0, 100.0], [1.0]))
def test_circuit_stiff_diode_with_a_sine_source_does_not_stall_at_small_voltages(series):
    circuit = Circuit(f"V1 a 0 SIN(0 10 1k)\nR1 a b 1k\nC1 b 0 1u\nD1 b 0 R={series}\n")
    ts = np.linspace(0.0, 5e-3, 6)[1:]
    sol = circuit.solve(5e-3, ts, rtol=1e-6, max_steps=50_000)

    def rate(t, v):
        drive = (10.0 * np.sin(2e3 * np.pi * t) - v) / 1e3
        return (drive - np.maximum(v, 0.0) / series) / 1e-6

    found = scipy.integrate.solve_ivp(
        rate, (0.0, 5e-3), [0.0], "Radau", ts, rtol=1e-9, atol=1e-11, max_step=1e-5
    )
    np.testing.assert_allclose(sol.xs[:, 0], found.y[0], atol=2e-6)
