"""Special cases of solvers: zero slopes, equal or missing bounds, and failures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough
from tests.vi.problems import fathi
from tests.vi.results import successful

import dvax
from dvax.sets import Ball, Box
from dvax.vi import (
    RESULTS,
    ActiveSet,
    Auto,
    Bracketing,
    ClosedForm,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

INF = jnp.inf


def solve(F, K, y0, **settings):
    return dvax.solve_vi(lambda y, args: F(y), K, jnp.asarray(y0, float), **settings)


# (F, lower, upper, solution), one entry a row
EDGES = [
    (lambda y: y**3, -INF, INF, 0.0),  # slope 0 at the solution
    (lambda y: (y - 2.0) ** 3, -INF, INF, 2.0),
    (lambda y: jnp.sign(y - 0.3) * jnp.abs(y - 0.3) ** 0.2, -1.0, 1.0, 0.3),  # slope ∞
    (lambda y: jnp.exp(50 * y) - 1.0, -INF, 5.0, 0.0),  # steep and flat
    (lambda y: jnp.arctan(1e8 * (y - 0.125)), 0.0, 1.0, 0.125),  # nearly a jump
    (lambda y: y + jnp.tanh(y) - 9.0, -3.0, 3.0, 3.0),  # held above
    (lambda y: y + jnp.tanh(y) + 9.0, -3.0, 3.0, -3.0),  # held below
    (lambda y: y + jnp.tanh(y) - 9.0, 0.7, 0.7, 0.7),  # a single point
    (lambda y: jnp.sinh(y - 1e4), -INF, INF, 1e4),  # far from the guess
    (lambda y: jnp.expm1(y + 300.0), -INF, INF, -300.0),
    (lambda y: y**3 - 8.0, -INF, 1.0, 1.0),
    (lambda y: (y - 1.0) * (2 + jnp.sin(5 * y)), -50.0, 50.0, 1.0),
    (lambda y: jnp.where(y < 1.0, y - 1.0, 3 * (y - 1.0)), 0.0, 2.0, 1.0),  # a kink at the root
]


@pytest.mark.slow
@pytest.mark.parametrize("case", range(len(EDGES)))
@pytest.mark.parametrize("guess", mostly_thorough([0.0, -7.3, 1e3], [-7.3]))
def test_bracketing_needs_no_slope_no_guess_and_no_finite_interval(case, guess):
    F, lower, upper, solution = EDGES[case]
    vi = solve(F, Box(lower, upper), guess, solver=Bracketing())
    assert vi.result == RESULTS.successful
    # A root of multiplicity m is only known to eps^(1/m) · scale, as F itself vanishes there.
    flat = case in (0, 1)
    assert float(vi.y) == pytest.approx(solution, rel=1e-14, abs=1e-6 if flat else 1e-14)


def test_bracketing_solves_all_points_of_a_field_at_once():
    c = np.linspace(-3, 6, 1001)
    F = lambda y: (2 + jnp.sin(y)) * (y - jnp.asarray(c))  # noqa: E731
    upper = np.where(np.arange(1001) % 2, 2.0, np.inf)
    vi = solve(F, Box(0.0, upper), np.zeros(1001), solver=Bracketing())
    np.testing.assert_allclose(np.asarray(vi.y), np.clip(c, 0, upper), rtol=1e-14, atol=1e-14)
    assert int(vi.iterations) < 60


@pytest.mark.slow
@pytest.mark.parametrize(
    ("F", "K", "solver", "result"),
    [
        (lambda y: y * jnp.nan + y * y, Box(0.0, 1.0), Bracketing(), RESULTS.nonfinite),
        (lambda y: jnp.sqrt(y - 5.0), Box(0.0, 1.0), Auto(), RESULTS.nonfinite),
        (lambda y: jnp.sqrt(y - 5.0), Box(0.0, 1.0), Extragradient(), RESULTS.nonfinite),
        (lambda y: y * jnp.nan, Ball(0.0, 1.0), Extragradient(), RESULTS.nonfinite),
        (lambda y: y * jnp.nan, Box(0.0, 1.0), Auto(), RESULTS.nonfinite),
        (lambda y: 0.0 * y, Box(0.0, 1.0), Auto(), RESULTS.nonfinite),
        (lambda y: jnp.exp(y) - 2, Box(0.0, 1.0), Bracketing(max_steps=2), RESULTS.max_steps),
        (lambda y: jnp.exp(y) - 2, Box(0.0, 1.0), Extragradient(max_steps=2), RESULTS.max_steps),
        # Never zero: no solution on a half line, and none is invented.
        (lambda y: -1.0 / (1.0 + y), Box(0.0, INF), Bracketing(), RESULTS.no_bracket),
        (lambda y: -jnp.arctan(y), Box(-INF, INF), Bracketing(), RESULTS.no_bracket),
        # −y + 2 on [0, 1] is solved by 0, not by proj(2) = 1: the closed form must not be trusted.
        (lambda y: 2.0 - y, Box(0.0, 1.0), Auto(), RESULTS.wrong_slope),
        (lambda y: jnp.array([1.0, -1.0]) * y, Box(0.0, 1.0), Auto(), RESULTS.wrong_slope),
        # A jump: every step that sees it is shortened, until the step is gone.
        (
            lambda y: jnp.where(y > 0.5, 1.0, -1.0), Box(0.0, 1.0), Extragradient(),
            RESULTS.not_lipschitz,
        ),
        (lambda y: y * jnp.nan, Ball(0.0, 1.0), SemismoothNewton(), RESULTS.nonfinite),
        (lambda y: y * jnp.nan, Ball(0.0, 1.0), GoldenRatio(), RESULTS.nonfinite),
        (lambda y: jnp.exp(y) - 2, Ball(0.0, 9.0), SemismoothNewton(max_steps=1), RESULTS.max_steps),
        # −y is solved nowhere near: the iterates leave, or turn on the spot.
        (lambda y: -y - 1.0, Box(0.0, INF), GoldenRatio(), RESULTS.diverging),
        (lambda y: -y - 1.0, Box(0.0, INF), ForwardBackwardForward(), RESULTS.diverging),
        (lambda y: -y - 1.0, Box(0.0, INF), SemismoothNewton(), RESULTS.diverging),
    ],
)  # fmt: skip
def test_solver_failures_are_not_reported_as_success(F, K, solver, result):
    assert solve(F, K, np.full(2, 0.3), solver=solver).result == result


def test_newton_solves_a_law_steeper_than_rounding_to_two_spacings():
    # |F| ≥ 3.4·10⁻⁷ on all floating-point numbers (128 y is exact, the rounding of the rest is 4·10⁻⁸):
    # the iterates stop moving beside the root. Whether w is 0 there depends on the compiler.
    vi = solve(
        lambda y: 1e8 * (jnp.exp(128.0 * y) / 2.3e17 - 1.0), Box(0.0, 1.0), np.full(2, 0.3),
        solver=SemismoothNewton(),
    )  # fmt: skip
    root = np.log(2.3e17) / 128.0
    assert np.all(np.abs(np.asarray(vi.y) - root) <= 2 * np.spacing(root))
    assert vi.result in (RESULTS.stalled, RESULTS.successful)


STEPPING = [Extragradient(), ForwardBackwardForward(), GoldenRatio(), SemismoothNewton()]


@pytest.mark.slow
@pytest.mark.parametrize("solver", STEPPING, ids=lambda solver: type(solver).__name__)
def test_step_below_rounding_gives_no_certificate(solver):
    # A jump from −10 to 1 at the start itself: no step is short enough, until y − λF(y) is y, where
    # (y − z)/λ + F(z) − F(y) is 0.
    F = lambda y: jnp.where(y < 0.5, -10.0, 1.0) + 0.0 * y  # noqa: E731
    vi = solve(F, Ball(0.0, 1.0), np.full(1, 0.5), solver=solver)
    assert vi.result != RESULTS.successful
    assert float(vi.residual) > 0.5


def test_projection_on_a_rotation_returns_cycling():
    # A rotation on a disk with a step that turns by a third: the projection method comes back.
    F = lambda y: jnp.array([[0.0, -1.0], [1.0, 0.0]]) @ y  # noqa: E731
    vi = solve(F, Ball(0.0, 1.0), [1.0, 0.0], solver=Projection(), gamma=3**-0.5, L_F=3**-0.25)
    # λ = γ/L_F² = 1: y − F(y) has length √2 and direction −45°; eight projections close the circle.
    assert vi.result == RESULTS.cycling


@pytest.mark.slow
def test_error_bound_holds_after_too_few_iterations():
    for solver in (
        Extragradient(max_steps=3), Bracketing(max_steps=3), Projection(max_steps=3),
        ForwardBackwardForward(max_steps=3), GoldenRatio(max_steps=3),
    ):  # fmt: skip
        vi = solve(lambda y: jnp.exp(y) - 2.0, Box(0.0, 3.0), 3.0, solver=solver, gamma=1.0)
        assert vi.result == RESULTS.max_steps
        assert float(vi.error_bound) >= abs(float(vi.y) - np.log(2)) > 1e-8


def test_bracketing_rejects_coupled_laws_and_names_alternatives():
    for F, K, word in (
        (lambda y: y[::-1] ** 3, Box(0.0, 1.0), "couples points"),
        (lambda y: y**3, Ball(0.0, 1.0), "not a pointwise interval"),
    ):
        with pytest.raises(dvax.InputError, match=word) as caught:
            solve(F, K, np.zeros(2), solver=Bracketing())
        assert "Extragradient" in str(caught.value)


def test_auto_chooses_the_solver_by_the_proved_structure():
    choose = lambda F, K: type(Auto().choose(F, K, jnp.zeros(2)))  # noqa: E731
    assert choose(lambda y: y**3, Box(0.0, 1.0)) is Bracketing
    assert choose(lambda y: y**3 + y[::-1], Box(0.0, 1.0)) is ActiveSet
    assert choose(lambda y: y**3, Ball(0.0, 1.0)) is SemismoothNewton
    assert choose(lambda y: 3.0 * y - 1.0, Ball(0.0, 1.0)) is ClosedForm
    large = jnp.zeros(5000)
    assert isinstance(Auto().choose(lambda y: y**3 + y[::-1], Box(0.0, 1.0), large), ActiveSet)
    assert isinstance(Auto().choose(lambda y: y**3, Ball(0.0, 1.0), large), SemismoothNewton)


def test_closed_form_rejects_laws_without_one():
    with pytest.raises(dvax.InputError, match="one number a"):
        solve(lambda y: y**3, Ball(0.0, 1.0), [0.0, 0.0], solver=ClosedForm())


def test_closed_form_of_an_isotropic_law_is_a_projection():
    z = np.array([3.0, -4.0])
    space = dvax.spaces.L2(np.array([1.0, 0.25]))
    vi = solve(lambda y: 2.0 * (y - jnp.asarray(z)), Ball(0.0, 1.0), np.zeros(2), space=space)
    length = np.sqrt(z[0] ** 2 + 0.25 * z[1] ** 2)
    np.testing.assert_allclose(np.asarray(vi.y), z / length, rtol=1e-14)
    assert int(vi.iterations) == 1


def test_solve_vi_solves_coupled_parts_of_a_tuple():
    # Coupled parts on different sets equal the stacked problem on one box.
    M = np.array([[2.0, 0.3, 0.0], [-0.3, 1.0, 0.5], [0.1, -0.5, 3.0]])
    q = np.array([-1.0, -4.0, 0.2])

    def F(y):
        out = jnp.asarray(M) @ jnp.concatenate([y[0][None], y[1]]) + jnp.asarray(q)
        return out[0], out[1:]

    K = dvax.sets.Product(Box(0.0, 1.0), Box(-1.0, 2.0))
    pair = dvax.solve_vi(lambda y, _: F(y), K, (jnp.zeros(()), jnp.zeros(2)), tol=1e-12)
    stacked = solve(
        lambda y: jnp.asarray(M) @ y + jnp.asarray(q),
        Box(np.array([0.0, -1.0, -1.0]), np.array([1.0, 2.0, 2.0])), np.zeros(3), tol=1e-12,
    )  # fmt: skip
    found = np.concatenate([np.asarray(pair.y[0])[None], np.asarray(pair.y[1])])
    np.testing.assert_allclose(found, np.asarray(stacked.y), atol=1e-11)


ALL = [
    Auto(), SemismoothNewton(), Bracketing(), Extragradient(), ForwardBackwardForward(),
    GoldenRatio(),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", mostly_thorough(ALL, ALL[:1]), ids=lambda solver: type(solver).__name__
)
def test_solve_vi_under_vmap_equals_a_loop(solver):
    cs = jnp.array([-1.0, 0.3, 2.0, 4.9])
    K = Box(0.0, 4.0)

    def one(c):
        F = lambda y, c: (2 + jnp.sin(y)) * (y - c)  # noqa: E731
        return dvax.solve_vi(F, K, jnp.ones(()), c, solver, tol=1e-11).y

    together = np.asarray(jax.vmap(one)(cs))
    np.testing.assert_allclose(together, [float(one(c)) for c in cs], rtol=0, atol=1e-12)


def test_solvers_keep_single_precision():
    y0 = jnp.zeros(2, jnp.float32)
    target = jnp.array([0.3, 2.0], jnp.float32)
    for solver in (Bracketing(), Extragradient()):
        vi = dvax.solve_vi(
            lambda y, c: (y - c) ** 3 + (y - c), Box(0.0, 1.0), y0, target, solver, tol=1e-5
        )
        assert vi.y.dtype == jnp.float32
        np.testing.assert_allclose(np.asarray(vi.y), [0.3, 1.0], atol=1e-5)


def test_active_set_starts_from_the_active_set_of_a_gradient_step():
    # From that at y₀ itself, where no unknown is at a bound, 5.7 evaluations in the mean.
    rng = np.random.default_rng(1)
    half = rng.normal(size=(20, 20))
    matrix = jnp.asarray(half @ half.T / 20 + 0.1 * np.eye(20))
    box = Box(-1.0, 1.0)

    def evaluations(q):
        law = lambda y, q: matrix @ y - q  # noqa: E731
        return dvax.solve_vi(law, box, jnp.zeros(20), args=q, solver=ActiveSet()).evaluations

    counts = jax.jit(jax.vmap(evaluations))(jnp.asarray(3.0 * rng.normal(size=(60, 20))))
    assert float(jnp.mean(counts)) < 4.2


def test_newton_solves_ill_conditioned_complementarity_problems():
    # A wrong active set gives a ‖w‖ of thousands, which the next steps correct: rejecting such points
    # left a third of these problems unsolved after 2,000 iterations.
    rng, count, size = np.random.default_rng(0), 100, 20
    Q = np.linalg.qr(rng.standard_normal((count, size, size)))[0]
    skew = rng.standard_normal((count, size, size))
    skew = rng.choice([0, 1e-3, 0.1], (count, 1, 1)) * (skew - skew.mT) / np.sqrt(size)
    M = (Q * np.logspace(-5, 0, size)) @ Q.mT + skew
    q = rng.choice([0.1, 1.0, 10.0], (count, 1)) * rng.standard_normal((count, size))
    law = lambda y, args: args[0] @ y + args[1]  # noqa: E731
    orthant = Box(0.0, jnp.inf)

    def one(M, q):
        return dvax.solve_vi(law, orthant, jnp.zeros(size), (M, q), SemismoothNewton(), tol=1e-9)

    vi = jax.jit(jax.vmap(one))(jnp.asarray(M), jnp.asarray(q))
    assert successful(vi).all() and float(jnp.mean(vi.evaluations)) < 20
    y = np.asarray(vi.y)
    w = np.einsum("kij,kj->ki", M, y) + q
    # y ≥ 0, w ≥ 0 and yᵢwᵢ = 0, but for the residual.
    assert y.min() >= 0 and w.min() >= -1e-9 and np.abs(np.where(y > 0, w, 0)).max() <= 1e-9


def test_newton_from_zero_solves_the_problem_of_fathi_in_two_steps_an_unknown():
    # The problem on which pivoting methods need 2ⁿ pivots; its solution is the first unit vector.
    size = 10
    y = dvax.solve_vi(
        lambda y, args: args[0] @ y + args[1], Box(0.0, jnp.inf), jnp.zeros(size),
        (jnp.asarray(fathi(size)), -jnp.ones(size)), SemismoothNewton(), tol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(np.asarray(y.y), np.eye(size)[0], atol=1e-11)
    assert int(y.evaluations) <= 2 * size


def test_projection_that_returns_to_a_corner_with_a_smaller_step_is_no_cycle():
    rng = np.random.default_rng(13)
    M = rng.normal(size=(24, 5, 5))
    M = 0.3 * M @ M.swapaxes(1, 2) + 0.3 * np.eye(5) + (M - M.swapaxes(1, 2))
    q = 3.0 * rng.normal(size=(24, 5))
    low, width = rng.normal(size=(24, 5)), rng.uniform(0.2, 2.0, size=24)
    M, q, low, high = M[5], q[5], low[5], low[5] + width[5]

    def F(y, args):
        return M @ y + q + 0.5 * jnp.tanh(y) + 0.5 * y**3

    found = dvax.solve_vi(
        F, dvax.sets.Box(low, high), jnp.zeros(5), solver=dvax.vi.Projection(), tol=1e-7
    )
    assert successful(found)
    y = np.asarray(found.y)
    natural = y - np.clip(y - (M @ y + q + 0.5 * np.tanh(y) + 0.5 * y**3), low, high)
    assert np.abs(natural).max() < 1e-6
