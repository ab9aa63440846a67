"""Statements that `verify` calls proved are true, and those it calls refuted are false."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from jax.experimental.sparse import BCOO
from tests.closed_forms import ALL, c7
from tests.selection import mostly_thorough, spread
from tests.theory.generated import generate

import dvax

MODULI = ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f")


def inspect(seed):
    made = generate(seed)
    return made, dvax.verify(made.problem, made.x0, 0.0, made.t1, **made.region)


def _check(seed):
    made, check = inspect(seed)
    needed = {row.label: row for row in check.assumptions if row.is_required}
    if made.broken is None:
        assert check.status == "proved", check.table()
        assert check.constants is not None
        for name, value in made.truth.items():
            found = float(getattr(check.constants, name))
            assert found == pytest.approx(value, rel=1e-9, abs=1e-12), name
        _hold(made, check.constants)
        return
    # An empty set is neither a set nor moves as one.
    alike = {"ass:operators (iii)": {"ass:time_regularity (i)"}}.get(made.broken, set())
    for label, row in needed.items():
        if label == made.broken:
            assert row.status in ("refuted", "estimated"), f"{seed}: {row}"
        elif label not in alike:
            assert row.status != "refuted", f"{seed}: {row}"
    assert check.status != "proved"


def _hold(made, c):
    """Check that the moduli bound those of random pairs."""
    rng = np.random.default_rng(5)
    problem = made.problem
    n, m = made.x0.size, problem.control_space.zeros().size
    P, space = problem.operator(), problem.control_space
    points = rng.uniform(-3.0, 3.0, (64, 2, n + m))
    ts = rng.uniform(0.0, made.t1, 64)

    def pair(t, two):
        (xa, xb), (ua, ub) = two[:, :n], two[:, n:]
        K = problem.set_at(t)
        ya, yb = K.project(ua, space), K.project(ub, space)
        ua, ub = P.inverse(ya), P.inverse(yb)
        F = problem.frozen(t, xa)
        norm = jnp.linalg.norm
        dx, du, dy = norm(xa - xb), norm(ua - ub), norm(ya - yb)
        f, h = problem.f, problem.h
        forward, backward = F(ya) @ (yb - ya), F(yb) @ (yb - ya)
        return {
            "alpha_f": c.alpha_f * dx - norm(f(t, xa, ua, None) - f(t, xb, ua, None)),
            "beta_f": c.beta_f * du - norm(f(t, xa, ua, None) - f(t, xa, ub, None)),
            "alpha_h": c.alpha_h * dx - norm(h(t, xa, ua, None) - h(t, xb, ua, None)),
            "beta_h": c.beta_h * du - norm(h(t, xa, ua, None) - h(t, xa, ub, None)),
            "L_F": c.L_F * dy - norm(F(ya) - F(yb)),
            "gamma": jnp.where(forward >= 0, backward - c.gamma * dy**2, 0.0),
        }

    for name, room in jax.jit(jax.vmap(pair))(ts, points).items():
        assert float(jnp.min(room)) >= -1e-9, name


# Every way to break an assumption, and the three kinds that break none.
OFTEN = [0, 2, 4, *range(1, 23, 2)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly_thorough(OFTEN, [0, 3]))
def test_verify_is_correct_on_a_generated_system(seed):
    _check(seed)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", spread([6, *range(8, 400, 2)], 47))
def test_verify_is_correct_on_many_generated_systems(seed):
    _check(seed)
    _check(seed + 1)


@pytest.mark.slow
def test_verify_refutes_the_additive_drive_with_a_counterexample():
    made, check = inspect(3)
    row = check["ass:strong_pseudomono"]
    assert row.status == "refuted" and check.constants is None
    pair = row.evidence
    F = made.problem.frozen(pair.t, pair.x)
    y, z = float(pair.y), float(pair.z)
    assert 0.0 <= min(y, z) and max(y, z) <= 1.5 * np.pi
    assert float(F(y)) * (z - y) >= 0 and float(F(z)) * (z - y) < 0
    assert "⟨F(z), z − y⟩" in row.why


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(ALL, ["C2", "C3", "C4"]))
def test_verify_proves_the_constants_of_the_closed_forms(name):
    case = ALL[name]()
    region = {"x": (0.0, 6.0)} if name == "C4" else {}
    check = dvax.verify(case.problem, jnp.asarray(case.x0), 0.0, case.t1, case.args, **region)
    assert check.status == "proved", check.table()
    c = check.constants
    for key in ("gamma", "alpha_h", "alpha_f", "beta_f", "M", "omega", "m_P", "norm_P_inv"):
        assert float(getattr(c, key)) == pytest.approx(float(getattr(case.constants, key))), key
    if name == "C2":
        assert float(c.gamma) == pytest.approx(0.6796227590, abs=1e-9)
        assert float(c.L_F) == pytest.approx(1.8918058124, abs=1e-9)
        assert float(c.L) == pytest.approx(0.3711482167, abs=1e-9)
    if name == "C4":
        y, x = np.meshgrid(np.linspace(0.0, 1.5 * np.pi, 400), np.linspace(0.0, 6.0, 400))
        steepest = np.abs(np.cos(y) * (y - x) + 2.0 + np.sin(y)).max()
        assert steepest <= float(c.L_F) <= 1.25 * steepest


@pytest.mark.thorough
@pytest.mark.parametrize("n", mostly_thorough([16, 20_000], [20_000]))
def test_verify_proves_a_field_with_a_pointwise_law_at_any_size(n):
    case = c7(n)
    check = dvax.verify(case.problem, jnp.asarray(case.x0), 0.0, 1.0)
    assert check.status == "proved"
    c = check.constants
    assert (float(c.gamma), float(c.L_F), float(c.alpha_h)) == (1.5, 1.5, 1.5)
    assert float(c.omega) == pytest.approx(-1.0, rel=1e-2)
    # −1 − 0.2 + 1.5/1.5, where the paper has −1 + 0.2 + 1.
    assert float(c.one_sided) == pytest.approx(float(c.omega) + 0.8, abs=1e-9)


def test_verify_gives_the_contact_law_the_constants_of_section_7():
    model = dvax.models.Contact(
        alpha=1.3, beta=0.7, b_x=2.0, b_u=3.0, d_x=0.5, d_u=1.1, kappa0=0.5,
        g=lambda t: jnp.sin(t), ell=3.0,
    )  # fmt: skip
    check = dvax.verify(model.problem, jnp.zeros(()), 0.0, 2.0)
    for name in (*MODULI, "M", "omega", "m_P", "norm_P_inv", "one_sided"):
        ours, theirs = float(getattr(check.constants, name)), float(getattr(model.constants, name))
        assert ours == pytest.approx(theirs, rel=1e-10), name
    # b_u ≥ 1: the projection route fails, the other does not.
    assert check["ass:lipschitz_smallness"].status == "refuted"
    assert check.status == "proved" and check.route == "variational inequality"


def cubic(**other):
    given = dict(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: -(x**3) - u,
        h=lambda t, x, u, args: 1.0 - x - jax.lax.cummax(u[None])[0],
    )  # fmt: skip
    return dvax.Problem(**{**given, **other})


@pytest.mark.thorough
def test_verify_in_a_region_proves_finite_moduli():
    assert dvax.verify(cubic())["ass:f_lipschitz"].status == "estimated"
    within = dvax.verify(cubic(), x=(-2.0, 1.0))
    assert within["ass:f_lipschitz"].status == "proved"
    assert float(within.constants.alpha_f) == pytest.approx(12.0)


@pytest.mark.slow
def test_verify_keeps_or_refutes_declared_moduli():
    # The code of h has an operation without a rule, so that nothing is proved of it.
    without = dvax.verify(cubic())
    assert without["ass:strong_pseudomono"].status == "estimated"
    assert "cummax" in without["ass:strong_pseudomono"].why
    truth = {"gamma": 2.0, "L_F": 2.0, "beta_h": 1.0}
    row = dvax.verify(cubic(), declared=truth)["ass:strong_pseudomono"]
    assert row.status == "declared" and "did not refute" in row.why
    wrong = dvax.verify(cubic(), declared={**truth, "beta_h": 0.25})
    assert wrong["ass:lipschitz_smallness"].status == "refuted"
    assert "declared as 0.25" in wrong["ass:lipschitz_smallness"].why


@pytest.mark.slow
def test_verify_rejects_wrong_arguments_by_name():
    problem = cubic()
    with pytest.raises(dvax.InputError, match=r"x0.*names no state space"):
        dvax.verify(cubic(A=dvax.generators.Diagonal(jnp.ones(3)), f=lambda t, x, u, args: -x - u))
    with pytest.raises(dvax.InputError, match=r"t0 < t1"):
        dvax.verify(problem, t0=1.0, t1=1.0)
    with pytest.raises(dvax.InputError, match=r"low ≤ high"):
        dvax.verify(problem, x=(1.0, 0.0))
    with pytest.raises(dvax.InputError, match=r"responses lie in P⁻¹K"):
        dvax.verify(problem, u=(3.0, 4.0))
    with pytest.raises(dvax.InputError, match=r"'alpha'.*Correct the name"):
        dvax.verify(problem, declared={"alpha": 1.0})
    with pytest.raises(KeyError):
        dvax.verify(problem)["ass:none"]


LARGE = [(kind, n) for n in (5, 3000) for kind in ("scatter", "sparse", "transform")]


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "n"), mostly_thorough(LARGE, {*LARGE[1:3], ("scatter", 3000)}))
def test_verify_bounds_large_affine_data_by_lanczos(kind, n):
    """For operations without a rule, or too large for a matrix: Lanczos' method on affine data."""
    rng = np.random.default_rng(7)
    if kind == "transform":
        factors = jnp.asarray(rng.uniform(-0.5, 0.3, n // 2 + 1))
        symbol = factors.astype(complex)
        push = lambda v: jnp.fft.irfft(symbol * jnp.fft.rfft(v), n)  # noqa: E731
        norm, least = np.abs(factors).max(), float(factors.min())
    else:
        M = scipy.sparse.random(n, n, density=min(1.0, 4 / n), random_state=3, format="coo")
        M = 0.2 * M
        if kind == "sparse":
            B = BCOO.from_scipy_sparse(M)
            push = lambda v: B @ v  # noqa: E731
        else:
            rows, cols, values = (jnp.asarray(v) for v in (M.row, M.col, M.data))
            push = lambda v: jnp.zeros(n).at[rows].add(values * v[cols])  # noqa: E731
        if n < 100:
            norm, least = np.linalg.norm(M.toarray(), 2), None
        else:
            norm, least = scipy.sparse.linalg.svds(M, k=1, return_singular_vectors=False)[0], None
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: push(u), h=lambda t, x, u, args: x - push(u),
    )  # fmt: skip
    check = dvax.verify(problem, jnp.zeros(n))
    assert check.status == "proved", check.table()
    c = check.constants
    assert norm * (1 - 1e-9) <= float(c.beta_f) <= 1.02 * norm + 1e-9
    assert norm * (1 - 1e-9) <= float(c.beta_h) <= 1.02 * norm + 1e-9
    if least is not None:
        assert 0.97 * (1 + least) <= float(c.gamma) <= (1 + least) * (1 + 1e-9)


def test_verify_does_not_prove_continuity_of_data_with_jumps():
    """Also if the jump has no effect at x = 0 or y = 1."""
    step = dvax.signals.Table([0.0, 0.5, 1.0], [2.0, 3.0, 3.0], kind="constant")
    times_x = cubic(f=lambda t, x, u, args: -u, h=lambda t, x, u, args: -step(t) * x - u)
    check = dvax.verify(times_x)
    assert check["ass:time_regularity (ii)"].status != "proved"
    far_away = cubic(
        K=lambda t, args: dvax.sets.Box(-1.0, step(t)), f=lambda t, x, u, args: -u,
        h=lambda t, x, u, args: -x - u,
    )  # fmt: skip
    check = dvax.verify(far_away)
    assert check["ass:time_regularity (i)"].status != "proved"
    assert check["ass:operators (iii)"].status == "proved"
    bent = dvax.signals.Table([0.0, 0.5, 1.0], [2.0, 3.0, 1.0])
    check = dvax.verify(cubic(h=lambda t, x, u, args: -bent(t) * x - u, f=far_away.f))
    assert check["ass:time_regularity (ii)"].status == "proved"


def test_verify_does_not_refute_a_sharp_declared_modulus():
    large = cubic(
        f=lambda t, x, u, args: 1e9 + jax.lax.cummax(x[None])[0] - u, h=lambda t, x, u, args: -u
    )
    row = dvax.verify(large, declared={"alpha_f": 1.0})["ass:f_lipschitz"]
    assert row.status == "declared", row.why


def autonomous(**data):
    parts = dict(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    return dvax.Problem(**(parts | data))


@pytest.mark.slow
def test_constants_of_an_autonomous_problem_hold_at_all_times():
    for data in ({}, {"K": lambda t, args: dvax.sets.Box(0.0, 0.5)}):
        problem = autonomous(**data)
        check = dvax.verify(problem, -1.0)  # on [0, 1]
        sol = dvax.solve(problem, -1.0, 5.0, 25.0, method=dvax.ETD2RK())
        assert dvax.bound_error(problem, sol, check.constants).status == "proved"


@pytest.mark.slow
@pytest.mark.parametrize(
    "data",
    [
        {"f": lambda t, x, u, args: jnp.sin(t) - 0.5 * x - u},
        # Zero at the state and the time that are tried.
        {"f": lambda t, x, u, args: 3.0 - 0.5 * x - u + t * (x + 1.0)},
        {"h": lambda t, x, u, args: 1.0 - 2.0 * x - u + jnp.maximum(t - 2.0, 0.0)},
        {"h": lambda t, x, u, args: jnp.where(t < 2.0, 1.0, 3.0) - 2.0 * x - u},
        {"K": lambda t, args: dvax.sets.Box(0.0, 0.5 + 0.1 * t)},
    ],
)
def test_constants_of_data_that_depend_on_time_hold_in_their_interval(data):
    problem = autonomous(**data)
    check = dvax.verify(problem, -1.0)
    assert check.constants.domain.t1 == 1.0
    later = dvax.solve(problem, -1.0, 0.0, 3.0, method=dvax.ETD2RK())
    assert dvax.bound_error(problem, later, check.constants).status != "proved"


def test_set_that_depends_on_args_alone_is_proved_as_a_fixed_one_is():
    triangle = jnp.array([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    polyhedron = lambda total: dvax.sets.Polyhedron(  # noqa: E731
        triangle, jnp.array([1.0, 0.0, 0.0]) * total
    )
    parts = dict(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        f=lambda t, x, u, total: u - 0.1 * x, h=lambda t, x, u, total: 1.0 - x,
    )  # fmt: skip
    x0 = jnp.zeros(2)
    fixed = dvax.verify(dvax.Problem(K=polyhedron(0.7), **parts), x0, args=0.7)
    called = dvax.verify(dvax.Problem(K=lambda t, total: polyhedron(total), **parts), x0, args=0.7)
    assert [a.status for a in called.assumptions] == [a.status for a in fixed.assumptions]
    moving = dvax.Problem(K=lambda t, total: polyhedron(total + 0.1 * t), **parts)
    assert dvax.verify(moving, x0, args=0.7).status != "proved"
