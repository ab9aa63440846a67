"""The applications against the usual tools."""

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.linalg
import scipy.optimize
import scipy.sparse

import dvax
from dvax.models.circuit import Circuit
from dvax.models.fem_contact import ElasticBody, FemContact
from dvax.models.frame import Accelerogram, Frame, response_spectrum
from dvax.models.market import Market
from dvax.models.mpc import LinearMPC

from ..clock import in_turn, timed
from ..peers.siconos_client import SiconosCircuit, python
from ..section import Section, compare


def run(full: bool) -> Section:
    section = Section(
        title="applications: wall times against the usual tools",
        fair=(
            "dvax is called directly, and timed after compilation except for the spectrum. The "
            "others are used as a user writes them. Errors are those of the quantity that the row "
            "names, against a run of dvax at a tighter tolerance. Circuit: Siconos, EulerMoreauOSI "
            "with θ = ½ and one LCP per step; only its stepping is timed. Oscillators: dvax "
            "compiles in every call, solves every elastic frame first, and uses all cores. scipy's "
            "LSODA is plain Python on one core, with the law as a clip and a given yield limit; it "
            "does not restart at kinks, and its peaks come from 8 points per sample. It runs four "
            "frames, its time is multiplied, and errors are of these four. Market: the hours of a "
            "week in one jitted program, and as bounded least squares (scipy, BVLS) with one factor "
            "for all. There is no third solution: both errors are the largest difference of their "
            "prices. Price of a day: scipy's LSODA from the same first price with rtol = 10⁻⁷ and "
            "atol = 10⁻⁶, while dvax has 10⁻⁵ for both. The response of each firm is found by 60 "
            "bisections in NumPy, and LSODA does not get the hours at which data have kinks. MPC: "
            "dvax in fixed steps of 0.05; OSQP in a Python loop at 10⁻⁴, set up before the clock "
            "starts, with warm starts and the plant exact between samples. Its error is that of "
            "holding the input. Finite elements: dvax with the method of the model at atol 10⁻⁵; "
            "implicit Euler with Newton on the penalty, and the matrix factorised before the clock "
            "starts (Woodbury). It is timed once if it takes more than 20 s."
        ),
    )
    rounds = 7 if full else 3
    for race in (_circuit, _stiff, _oscillators, _market, _predictive, _bodies):
        race(section, rounds, full)
    return section


def _race(
    section: Section, case: str, versus: str, ours: Callable[[], Any], other: Any, rounds: int,
    error: float, error_other: float,
) -> None:  # fmt: skip
    taken = in_turn({"dvax": timed(ours), "other": other}, rounds)
    section.comparisons.append(
        compare(
            case, versus, taken["dvax"], taken["other"], direction="other/dvax",
            error=error, error_other=error_other,
        )
    )  # fmt: skip


def _circuit(section: Section, rounds: int, full: bool) -> None:
    tank = Circuit("C1 1 0 1u IC=10\nL1 1 0 10m\nD1 0 1 R=1k")
    end, steps = 5e-3, 50_000 if full else 5_000
    exact = np.asarray(tank.solve(end, rtol=1e-12, atol=1e-15).xs[-1])
    interpreter = python()
    if interpreter is None:
        section.notes.append("circuit: no Python here imports siconos.kernel (python3-siconos)")
        return
    run = lambda: jax.block_until_ready(tank.solve(end, rtol=1e-6, atol=1e-10).xs)  # noqa: E731
    names = ("A", "B", "C", "D", "x0")
    with SiconosCircuit(interpreter) as siconos:
        siconos.build(
            {name: np.asarray(getattr(tank, name)).tolist() for name in names}, end / steps, steps
        )
        reached = siconos.run()[1]
        _race(
            section, "RLC–diode circuit, 5 ms; error of the voltage", f"Siconos, {steps} steps", run,
            lambda: siconos.run()[0], rounds,
            abs(float(run()[-1][0]) - exact[0]), abs(reached[0] - exact[0]),
        )  # fmt: skip


def _stiff(section: Section, rounds: int, full: bool) -> None:
    """What stiffness costs: the same run with a diode of 1 µΩ and 1 Ω, with η/k = 1e-8 s and 1e-2 s."""

    def rectifier(r: float, strays: str = "") -> Callable[[], Any]:
        anode = "d" if strays else "b"
        text = f"V1 a 0 SIN(0 10 1k)\nD1 a {anode} R={r} G=1u\nL1 b c 10u\nR1 c 0 10\nC1 c 0 1u\n"
        text += strays
        circuit = Circuit(text)
        return lambda: circuit.solve(3e-3).xs

    def frame(tau: float) -> Callable[[], Any]:
        made = Frame(record=_record(), period=0.5, damping=0.05, yield_displacement=0.4,
                     viscosity_ratio=tau)  # fmt: skip
        return lambda: made.solve().xs

    strays = "L9 d b 1n\nC9 b 0 1p"
    for case, versus, stiff, mild in (
        ("rectifier, diode of 1 µΩ", "1 Ω", rectifier(1e-6), rectifier(1.0)),
        (
            "rectifier of 1 µΩ with undamped strays of 1 pF, 1 nH",
            "without",
            rectifier(1e-6, strays),
            rectifier(1e-6),
        ),
        ("frame, η/k = 1e-8 s", "1e-2 s", frame(1e-8), frame(1e-2)),
    ):
        _ = stiff(), mild()
        taken = in_turn({"stiff": timed(stiff), "mild": timed(mild)}, rounds)
        section.comparisons.append(
            compare(case, versus, taken["stiff"], taken["mild"], direction="dvax/other")
        )


def _record() -> Accelerogram:
    rng = np.random.default_rng(4)
    t = 0.02 * np.arange(601)
    waves = sum(
        np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) / (1 + (f / 3) ** 2) ** 0.5
        for f in np.geomspace(0.3, 8.0, 40)
    )
    shaped = 0.35 * waves / np.abs(waves).max() * (t / 2) * np.exp(1 - t / 2)
    return Accelerogram(0.02, shaped)


def _oscillators(section: Section, rounds: int, full: bool) -> None:
    record, count, few = _record(), 10_000 if full else 512, 4
    rng = np.random.default_rng(0)
    periods, dampings = rng.uniform(0.2, 2.0, count), rng.uniform(0.02, 0.1, count)
    ratios, tau = rng.uniform(0.2, 0.8, count), 0.01
    ours = lambda: response_spectrum(record, periods, dampings, ratios, tau)  # noqa: E731
    found = ours()
    ground, ends = np.asarray(record.samples), np.asarray(record.knots())

    def peak(k: int, rtol: float) -> float:
        w, z, limit = 2 * np.pi / periods[k], dampings[k], float(found.yield_displacement[k])

        def rate(t: float, x: np.ndarray) -> list[float]:
            d, v, p = x
            spring = d - p
            flow = (spring - min(max(spring, -limit), limit)) / tau
            return [v, -2 * z * w * v - w * w * spring - np.interp(t, ends, ground), flow]

        times = np.linspace(0.0, ends[-1], 8 * (len(ends) - 1) + 1)
        run = scipy.integrate.solve_ivp(
            rate, (0.0, ends[-1]), np.zeros(3), "LSODA", times, rtol=rtol, atol=1e-3 * rtol,
            max_step=0.02,
        )  # fmt: skip
        return float(np.abs(run.y[0]).max())

    def exact(k: int) -> float:
        frame = Frame(
            record=record, period=periods[k], damping=dampings[k],
            yield_displacement=float(found.yield_displacement[k]), viscosity_ratio=tau,
        )  # fmt: skip
        return frame.figures(rtol=1e-10)["largest_displacement"]

    truth = np.array([exact(k) for k in range(few)])

    def other() -> float:
        start = time.perf_counter()
        for k in range(few):
            peak(k, 1e-5)
        return (time.perf_counter() - start) * count / few

    errors = [abs(peak(k, 1e-5) / truth[k] - 1) for k in range(few)]
    _race(
        section, f"inelastic spectrum of {count} oscillators, 12 s; relative error of peaks",
        f"scipy LSODA ({few} run, times {count // few})", ours, other, 3,
        float(np.abs(found.peak[:few] / truth - 1).max()), float(max(errors)),
    )  # fmt: skip


def _market(section: Section, rounds: int, full: bool) -> None:
    n, hours = 102, 168
    rng = np.random.default_rng(1)
    cost, slope = rng.uniform(0.0, 80.0, n), rng.uniform(1e-3, 0.1, n)
    firm = np.arange(n) % 3
    times = np.arange(hours, dtype=float)
    load = 4500 + 1500 * np.sin(2 * np.pi * (times - 9) / 24) + rng.normal(0, 100, hours)
    wind = 0.5 + 0.5 * np.sin(times / 7)[:, None]
    capacity = rng.uniform(50, 200, n) * np.where(np.arange(n) < 20, wind, 1.0)
    b, speed = 0.031, 6.0
    alpha = 40.0 + b * load
    market = Market(
        cost=cost, slope=slope, firm=firm, b=b, speed=speed,
        intercept=dvax.signals.Table(times, alpha), capacity=dvax.signals.Table(times, capacity),
    )  # fmt: skip
    every = jax.jit(jax.vmap(lambda t: market.equilibrium(t)[0]))
    groups = np.eye(3)[firm]
    root = np.linalg.cholesky(np.diag(slope) + b * (groups @ groups.T) + b).T

    def hourly() -> np.ndarray:
        prices = []
        for a, cap in zip(alpha, capacity, strict=True):
            goal = -np.linalg.solve(root.T, cost - a)
            ends = np.zeros(n), np.maximum(cap, 1e-9)
            made = scipy.optimize.lsq_linear(root, goal, ends, "bvls", tol=1e-14).x
            prices.append(a - b * made.sum())
        return np.array(prices)

    apart = float(np.abs(hourly() - np.asarray(every(times))).max())
    _race(
        section, f"Cournot–Nash prices of {hours} hours, 102 units; difference of the two",
        "scipy BVLS, an hour at a time", lambda: jax.block_until_ready(every(times)),
        timed(hourly), rounds, apart, apart,
    )  # fmt: skip
    day = 24.0
    exact = np.asarray(market.run(0.0, day, rtol=1e-9, atol=1e-9).xs)
    dynamics = lambda: market.run(0.0, day, rtol=1e-5, atol=1e-5).xs  # noqa: E731

    def rate(t: float, x: np.ndarray) -> list[float]:
        hour = min(int(t), hours - 2)
        cap = capacity[hour] + (t - hour) * (capacity[hour + 1] - capacity[hour])
        low, high = np.full(3, -1e4), np.full(3, 1e4)
        for _ in range(60):
            middle = 0.5 * (low + high)
            total = groups.T @ np.clip((groups @ middle - cost) / slope, 0.0, cap)
            above = x[0] - b * total > middle
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        made = np.clip((groups @ low - cost) / slope, 0.0, cap).sum()
        return [speed * (np.interp(t, times, alpha) - b * made - x[0])]

    def by_hand() -> np.ndarray:
        return scipy.integrate.solve_ivp(
            rate, (0.0, day), exact[:1], "LSODA", np.arange(25.0), rtol=1e-7, atol=1e-6
        ).y[0]

    _race(
        section, "sticky price over a day; error in $/MWh", "scipy LSODA, the law by halving",
        lambda: jax.block_until_ready(dynamics()), timed(by_hand), rounds,
        float(np.abs(np.asarray(dynamics()) - exact).max()), float(np.abs(by_hand() - exact).max()),
    )  # fmt: skip


def _predictive(section: Section, rounds: int, full: bool) -> None:
    if importlib.util.find_spec("osqp") is None:
        section.notes.append("MPC: OSQP is not installed here (pip install osqp)")
        return
    import osqp

    end, spring = 20.0, 2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)
    mpc = LinearMPC(
        A=np.block([[np.zeros((3, 3)), np.eye(3)], [-spring, -0.5 * np.eye(3)]]),
        B=np.eye(6)[:, [3]], Q=np.eye(6), R=[[0.5]], horizon=12, step=0.25, lower=-0.5, upper=0.5,
    )  # fmt: skip
    x0 = np.array([1.5, 1.5, 1.5, 0.0, 0.0, 0.0])
    problem, start = mpc.problem, jnp.asarray(x0)

    def ours(**settings: Any) -> np.ndarray:
        return np.asarray(
            dvax.solve(problem, start, 0.0, end, method=dvax.ETD4RK(), **settings).xs[-1]
        )

    exact = ours(rtol=1e-10, atol=1e-11)
    A, B, H, G = (np.asarray(v) for v in (mpc.A, mpc.B, mpc.H, mpc.G))
    size, dt = len(H), 0.01
    held = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 7))]]))
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.csc_matrix(np.triu(H)), np.zeros(size), scipy.sparse.csc_matrix(np.eye(size)),
        np.full(size, -0.5), np.full(size, 0.5), verbose=False, eps_abs=1e-4, eps_rel=1e-4,
        warm_starting=True,
    )  # fmt: skip

    def loop() -> np.ndarray:
        x = x0
        for _ in range(round(end / dt)):
            solver.update(q=G @ x)
            x = held[:6, :6] @ x + held[:6, 6] * solver.solve().x[0]
        return x

    fixed = lambda: ours(dt=0.05)  # noqa: E731
    _race(
        section, "three masses under MPC, horizon 12, 20 s; error of x at the end",
        "OSQP in a Python loop, dt = 0.01", fixed, timed(loop), rounds,
        float(np.linalg.norm(fixed() - exact)), float(np.linalg.norm(loop() - exact)),
    )  # fmt: skip


def _bodies(section: Section, rounds: int, full: bool) -> None:
    from ..peers.penalty_loop import PenaltyLoop

    body = ElasticBody({"fine": 10, "coarse": 4, "layers": 17})
    model = FemContact(body, indentation=0.01, stiffness=100.0, pressure_cap=0.01)
    ts = np.linspace(0.0, 12.0, 25)[1:]

    def ours(atol: float = 1e-5, method: Any = None) -> np.ndarray:
        sol = dvax.solve(
            model.problem, model.untouched, 0.0, 12.0, ts=ts, method=method or model.method,
            rtol=0.0, atol=atol,
        )  # fmt: skip
        return np.asarray(sol.ys) @ body.weights

    exact = ours(1e-10, dvax.ExpRosenbrock())
    steps = 80 if full else 20
    loop = PenaltyLoop(body.mesh, beta=100.0, cap=0.01)
    forces = lambda: loop.run(0.5 / steps, 12.0).forces[steps - 1 :: steps]  # noqa: E731
    start = time.perf_counter()
    theirs = forces()
    seconds = time.perf_counter() - start
    _race(
        section, "punch on a block, 3 876 displacements, 12 τ; relative error of the force",
        f"penalty loop, {24 * steps} steps", ours,
        (lambda: seconds) if seconds > 20 else timed(forces), rounds,
        float(np.abs(ours() - exact).max() / exact.max()),
        float(np.abs(theirs - exact).max() / exact.max()),
    )  # fmt: skip
