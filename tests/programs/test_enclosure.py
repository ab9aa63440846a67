"""Linear enclosures: a function of time stays within the bound on its distance from a line."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.hard_rates import RATES
from tests.selection import mostly_thorough

import dvax
from dvax.programs.enclosure import (
    LinearEnclosure,
    NoEnclosure,
    below_parabola,
    constant,
    enclose,
    straight,
)

TABLE = dvax.signals.Table([0.0, 1.0, 2.5, 4.0], [0.0, 3.0, -1.0, 2.0])
STAIRS = dvax.signals.Table([0.0, 1.0, 2.5, 4.0], [0.0, 3.0, -1.0, 2.0], kind="constant")
SPLINE = dvax.signals.Table([0.0, 1.0, 2.5, 4.0], [0.0, 3.0, -1.0, 2.0], kind="cubic")
PROFILE = jnp.array([0.5, -1.0, 2.0])
UNRULED = {
    "a choice among three", "a condition", "the larger of sorted", "rounded to a short type",
}  # fmt: skip

FUNCTIONS = {
    "affine": lambda t: 3.0 - 2.0 * t,
    "square": lambda t: (t - 1.3) ** 2,
    "cubic": lambda t: t**3 - 2.0 * t**2,
    "reciprocal": lambda t: 1.0 / (0.5 + t),
    "negative power": lambda t: (1.0 + t) ** -2,
    "exponential": lambda t: jnp.exp(-t) * jnp.sin(3.0 * t),
    "trigonometric": lambda t: jnp.cos(t * t),
    "root": lambda t: jnp.sqrt(1.0 + t * t),
    "logarithm": lambda t: jnp.log(1.0 + jnp.abs(jnp.sin(t))),
    "clip": lambda t: jnp.clip(5.0 * jnp.sin(2.0 * t), -1.0, 1.0),
    "maximum of two": lambda t: jnp.maximum(jnp.sin(t), 0.3 * t),
    "where on time": lambda t: jnp.where(t > 1.7, 2.0 * t, 1.0),
    "modulus": lambda t: jnp.abs(t - 2.0) * jnp.exp(0.3 * t),
    "tanh of a product": lambda t: jnp.tanh(t * jnp.cos(t)),
    "field": lambda t: PROFILE * jnp.exp(PROFILE * 0.3 * t) + jnp.minimum(t, PROFILE),
    "matrix": lambda t: jnp.array([[1.0, -2.0], [0.5, 3.0]]) @ jnp.stack([jnp.sin(t), t * t]),
    "sum": lambda t: jnp.sum(PROFILE * t * t),
    "period": lambda t: jnp.sin(t % 0.7) + jnp.fmod(2.0 - t, 0.9),
    "sawtooth of a field": lambda t: jnp.mod(PROFILE * t * t, 1.1),
    "sigmoid": lambda t: jax.nn.sigmoid(40.0 * (t - 1.0)) + jax.nn.softplus(3.0 * t - 4.0),
    "arcs": lambda t: jnp.arctan(9.0 * (t - 2.0)) + jnp.arcsin(0.24 * t) - jnp.arccos(0.24 * t),
    "hyperbolic": lambda t: jnp.sinh(t - 2.0) + jnp.cosh(1.0 - t) + jnp.arcsinh(5.0 * t - 9.0),
    "inverse hyperbolic": lambda t: jnp.arctanh(0.24 * t) + jnp.arccosh(1.001 + t),
    "error function": lambda t: jax.scipy.special.erf(4.0 * t - 6.0) * jax.scipy.special.erfc(t),
    "roots": lambda t: jnp.cbrt(1.0 + t) + jax.lax.rsqrt(0.2 + t) + jnp.log1p(t),
    "powers": lambda t: (0.1 + t) ** 1.7 + (0.3 + t) ** -0.4 + t**2.5 + 1.9**t + jnp.exp2(-t),
    "tangent": lambda t: jnp.tan(0.3 * t) - jnp.tan(0.3 * t - 1.2),
    "interpolation": lambda t: jnp.interp(t, jnp.arange(5.0), PROFILE[jnp.array([0, 1, 2, 1, 0])]),
    "steps of an array": lambda t: PROFILE[jnp.searchsorted(jnp.array([1.0, 2.2]), t)] * t,
    "cumulative": lambda t: jnp.cumsum(PROFILE * jnp.sin(t)),
    "written into": lambda t: jax.lax.dynamic_update_slice(PROFILE * t, jnp.sin(t)[None], (1,)),
    "taken apart": lambda t: jnp.split(jnp.sin(PROFILE * t), [1])[1],
    "unpacked": lambda t: (lambda a, b, *rest: a * b - rest[0])(*jnp.sin(PROFILE * t)),
}


def farthest(fn, t0, t1):
    """The largest distance of fn from the line between its ends on a fine grid, entry by entry."""
    return distance(fn, t0, t1, fn(t0), fn(t1))


def distance(fn, t0, t1, a, b):
    """The same from the line between a and b, inside of [t0, t1]: at an end that is a jump, rounding
    decides which of its values fn has there."""
    theta = jnp.linspace(0.0, 1.0, 801)[1:-1]
    values = jax.vmap(lambda s: jnp.asarray(fn(t0 + s * (t1 - t0))))(theta)
    weight = theta.reshape((-1,) + (1,) * (values.ndim - 1))
    a, b = jnp.asarray(a)[None], jnp.asarray(b)[None]
    return jnp.abs(values - ((1 - weight) * a + weight * b)).max(axis=0)


def enclosed(fn, t0, t1):
    return enclose(fn, straight(jnp.asarray(t0), jnp.asarray(t1)))


@functools.cache
def compiled(fn):
    """The enclosure of fn over [t0, t1], fn at both ends, and its `distance`.

    In two programs: within one, XLA may evaluate fn at an end twice and round differently."""
    at_ends = jax.jit(lambda t0, t1: (enclosed(fn, t0, t1), fn(t0), fn(t1)))
    inside = jax.jit(functools.partial(distance, fn))

    def both(t0, t1):
        line, start, end = at_ends(t0, t1)
        return line, start, end, inside(t0, t1, line.a, line.b)

    return both


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
@settings(max_examples=25)
@given(t0=st.floats(0.0, 3.5), length=st.floats(1e-4, 0.5))
def test_enclosure_bounds_every_function(name, t0, length):
    line, start, end, found = compiled(FUNCTIONS[name])(t0, t0 + length)
    np.testing.assert_allclose(line.a, start, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(line.b, end, rtol=1e-12, atol=1e-12)
    assert np.all(np.asarray(found) <= np.asarray(line.dev) + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(RATES, list(RATES)[::2]))
def test_enclosure_of_adversarial_functions_holds_or_is_refused(name):
    rate, breaks = RATES[name]
    rng = np.random.default_rng(0)
    spans = [(k / n, (k + 1) / n) for n in (1, 4, 7) for k in range(n)]
    spans += [tuple(np.sort(rng.uniform(0.0, 1.0, 2))) for _ in range(20)]
    spans += [(s, min(1.0, s + 0.1)) for s in breaks] + [(max(0.0, s - 0.1), s) for s in breaks]
    if name in UNRULED:
        with pytest.raises(NoEnclosure):
            enclosed(rate, 0.0, 1.0)
        return
    for t0, t1 in spans:
        line, _, _, found = compiled(rate)(t0, t1)
        assert np.all(np.asarray(found) <= np.asarray(line.dev) + 1e-9), (t0, t1)


def test_enclosure_keeps_single_precision():
    for name in ("where on time", "clip", "modulus", "square"):
        line = enclose(FUNCTIONS[name], straight(jnp.float32(0.9), jnp.float32(1.9)))
        assert {part.dtype for part in line} == {jnp.dtype("float32")}, name


def test_enclosure_of_a_crossing_with_overflowing_product_is_finite():
    steep = lambda t: jnp.maximum(0.0, 4e20 * (t - 0.5))  # noqa: E731
    line = enclose(steep, straight(jnp.float32(0.0), jnp.float32(1.0)))
    assert float(line.dev) == pytest.approx(1e20, rel=1e-6)


def test_enclosure_of_a_crossing_with_overflowing_sum_is_not_too_small():
    ends = jnp.asarray(-1.5e308), jnp.asarray(1.5e308)
    line = enclose(lambda t: jnp.maximum(0.0, t), straight(*ends))
    assert float(line.dev) >= 0.75e308


@pytest.mark.parametrize(("a", "b"), [(-1e308, 1.0), (1.0, -1e308), (-1e30, 1e-300), (-3.0, 1.0)])
def test_enclosure_of_a_crossing_with_ends_far_apart_is_exact(a, b):
    line = enclose(lambda t: jnp.maximum(0.0, t), straight(jnp.asarray(a), jnp.asarray(b)))
    np.testing.assert_allclose(float(line.dev), abs(a) * (abs(b) / (abs(a) + abs(b))) or max(b, a))


@pytest.mark.parametrize("dev", [0.0, 1.0, np.inf])
@pytest.mark.parametrize("c", [np.inf, 1e-310, 1e-300, 2.0, -3.0])
def test_enclosure_of_a_quotient_is_never_nan(c, dev):
    for number in (c, jnp.asarray(c)):
        line = enclose(
            lambda t, by=number: t / by, LinearEnclosure(*map(jnp.asarray, (1.0, 2.0, dev)))
        )
        assert not np.isnan(line.dev)
        if np.isfinite(dev / abs(c)) and abs(c) >= 1e-300:
            assert float(line.dev) == pytest.approx(dev / abs(c))
        if dev > 0.0 and abs(c) < np.inf:
            assert line.dev > 0.0


@pytest.mark.parametrize("factor", [0.0, 5e-324, 1e-310, 1e-300, 3.0])
def test_enclosure_of_a_product_with_an_unbounded_factor_is_not_nan(factor):
    line = enclose(lambda t: factor * t, LinearEnclosure(*map(jnp.asarray, (0.0, 1.0, jnp.inf))))
    assert not np.isnan(line.dev) and (factor < 1e-300 or np.isinf(line.dev))


@pytest.mark.parametrize("name", ["square", "exponential", "root", "tanh of a product"])
def test_enclosure_of_smooth_functions_is_of_second_order(name):
    bounds = [float(enclosed(FUNCTIONS[name], 0.9, 0.9 + h).dev) for h in (0.1, 0.05, 0.025)]
    assert bounds[0] / bounds[1] == pytest.approx(4.0, rel=0.25)
    assert bounds[1] / bounds[2] == pytest.approx(4.0, rel=0.15)
    assert bounds[2] <= 30 * float(farthest(FUNCTIONS[name], 0.9, 0.925))


def test_enclosure_of_a_saturated_clip_is_exact():
    line = enclosed(lambda t: jnp.clip(10.0 + jnp.sin(t), 0.0, 1.0), 0.0, 1.0)
    assert float(line.dev) == 0.0


def test_enclosure_of_a_line_with_one_kink_is_exact():
    line = enclosed(lambda t: jnp.maximum(t - 0.25, 0.0), 0.0, 1.0)
    assert float(line.dev) == pytest.approx(0.75 * 0.25)


@pytest.mark.parametrize("signal", [TABLE, STAIRS, SPLINE], ids=["linear", "constant", "cubic"])
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 1.0), (0.2, 0.7), (1.0, 2.5), (3.9, 4.0)])
def test_enclosure_of_a_table_between_two_knots(signal, t0, t1):
    last = np.nextafter(t1, 0.0)  # a step ends just inside
    line = enclosed(signal.value, t0, last)
    found = farthest(signal.value, t0, last)
    assert np.isfinite(line.dev) and found <= float(line.dev) + 1e-12
    if signal is not SPLINE:
        assert float(line.dev) <= 1e-12


def test_enclosure_across_a_knot_is_infinite():
    line = enclosed(STAIRS.value, 0.9, 1.1)
    assert not float(line.dev) < 3.0


@pytest.mark.parametrize("fn", [jnp.cbrt, jnp.tan, jnp.log, lambda t: t**0.5, lambda t: t**-1.5])
def test_enclosure_across_a_singularity_is_infinite(fn):
    middle = 0.5 * np.pi if fn is jnp.tan else 0.0
    with jax.debug_nans(False):
        assert not np.isfinite(enclosed(lambda t: fn(t + middle), -0.25, 0.75).dev)


def test_enclosure_names_operations_without_a_rule():
    with pytest.raises(NoEnclosure, match="digamma"):
        enclosed(jax.scipy.special.digamma, 1.0, 2.0)
    with pytest.raises(NoEnclosure, match="fft"):
        enclosed(lambda t: jnp.fft.irfft(jnp.fft.rfft(PROFILE * t), 3), 0.0, 1.0)


@pytest.mark.thorough
def test_trajectory_curvature_is_below_its_bound():
    space = dvax.spaces.Euclidean(2)
    generators = {
        "scalar": dvax.generators.Scalar(-3.0),
        "diagonal": dvax.generators.Diagonal(jnp.array([-40.0, 0.7])),
        "dense": dvax.generators.Dense(jnp.array([[-1.0, 6.0], [-6.0, -0.2]])),
    }
    rng = np.random.default_rng(1)
    for A in generators.values():
        for h in (0.3, 0.01):
            x0, c0, c1 = (jnp.asarray(rng.normal(size=2)) for _ in range(3))

            def at(theta, A=A, h=h, x0=x0, c0=c0, c1=c1):
                return A.propagator(theta * h, 2).step(x0, (c0, theta * c1))

            bound = A.chord_deviation(
                dvax.generators.FlowStep(h, x0, at(1.0), (c0, c1)), space, A.growth(space)
            )
            assert np.all(farthest(at, 0.0, 1.0) <= np.asarray(bound) * (1 + 1e-12))


def test_enclosure_of_constants_has_no_deviation():
    line = enclose(
        lambda a, t: a * a + t,
        constant(jnp.asarray(3.0)),
        LinearEnclosure(*map(jnp.asarray, (0.0, 1.0, 0.5))),
    )
    assert (float(line.a), float(line.b), float(line.dev)) == (9.0, 10.0, 0.5)


@pytest.mark.parametrize("power", [1.1, 1.5, 1.9])
@pytest.mark.parametrize(("a", "b"), [(-0.3, 0.7), (0.0, 0.5), (-1e-6, 1e-3), (1e-9, 2.0)])
def test_function_of_infinite_curvature_is_enclosed_by_its_slope(power, a, b):
    """|s|^p with 1 < p < 2 next to its zero, which has a slope and no second derivative."""
    fn = lambda s: jnp.abs(s) ** power  # noqa: E731
    theta = np.linspace(0.0, 1.0, 401)
    for context in (contextlib.nullcontext(), below_parabola()):
        with context:
            q = enclose(fn, straight(jnp.asarray(a), jnp.asarray(b)))
        values = np.abs((1 - theta) * a + theta * b) ** power
        away = np.abs(values - ((1 - theta) * float(q.a) + theta * float(q.b)))
        assert (away <= float(q.dev) + 1e-15).all()
        # Half of it for |s|, and half of it for the power.
        assert float(q.dev) <= 2.0 * power * max(abs(a), abs(b)) ** (power - 1) * (b - a)
    assert (away <= 4.0 * theta * (1 - theta) * float(q.dev) + 1e-15).all()
