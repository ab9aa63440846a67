"""What f, h and K read from around them may change between two calls: no program with the old values is
used."""

import dataclasses
import functools
import pickle
import types

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import dvax
from dvax._captured import current
from dvax._jax.compile_clock import listen

STAGES: list[str] = []
listen(lambda stage, seconds: STAGES.append(stage))

LOAD = 3.0


class Plant:
    def __init__(self):
        self.load = 3.0

    def rate(self, t, x, u, args):
        return self.load - 0.5 * x - u

    def __call__(self, t, x, u, args):
        return self.load - 0.5 * x - u


@dataclasses.dataclass
class Data:
    inner: dict = dataclasses.field(default_factory=lambda: {"load": [3.0]})


def doubled(x):
    return LOAD - 0.5 * x


def scaled(table, t, x, u, args):
    return table["load"] - 0.5 * x - u


def by_global():
    return lambda t, x, u, args: LOAD - 0.5 * x - u, lambda v: globals().update(LOAD=v)


def by_helper():
    return lambda t, x, u, args: doubled(x) - u, lambda v: globals().update(LOAD=v)


def by_closure():
    load = 3.0

    def change(v):
        nonlocal load
        load = v

    return lambda t, x, u, args: load - 0.5 * x - u, change


def by_container(make, put):
    table = make()
    return lambda t, x, u, args: float(table[0]) - 0.5 * x - u, functools.partial(put, table)


def by_namespace():
    space = types.SimpleNamespace(load=3.0)
    return lambda t, x, u, args: space.load - 0.5 * x - u, lambda v: setattr(space, "load", v)


def by_dataclass():
    data = Data()
    change = lambda v: data.inner["load"].__setitem__(0, v)  # noqa: E731
    return lambda t, x, u, args: data.inner["load"][0] - 0.5 * x - u, change


def by_method():
    plant = Plant()
    return plant.rate, lambda v: setattr(plant, "load", v)


def by_object():
    plant = Plant()
    return plant, lambda v: setattr(plant, "load", v)


def by_partial():
    table = {"load": 3.0}
    return functools.partial(scaled, table), lambda v: table.update(load=v)


def put(table, v):
    table[0] = v


WAYS = {
    "global": by_global,
    "global of a helper": by_helper,
    "closure": by_closure,
    "list": lambda: by_container(lambda: [3.0], put),
    "dict": lambda: by_container(lambda: {0: 3.0}, put),
    "array": lambda: by_container(lambda: np.array([3.0]), put),
    "namespace": by_namespace,
    "dataclass": by_dataclass,
    "method": by_method,
    "object": by_object,
    "partial": by_partial,
}


def problem(f):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=f, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_value_that_was_changed_is_read_again(way):
    f, change = WAYS[way]()
    change(3.0)
    one = problem(f)
    found = []
    for load in (3.0, 5.0, 3.0):
        change(load)
        found.append(float(dvax.solve(one, -1.0, 0.0, 2.0).xs[-1]))
    change(3.0)
    assert found[0] == pytest.approx(1.836091956, abs=1e-5)
    assert found[1] == pytest.approx(3.110066757, abs=1e-5)
    assert found[2] == found[0]


@pytest.mark.slow
def test_an_iterated_law_a_set_and_the_response_are_read_again():
    limit, slope = {"v": 1.0}, [1.0]
    one = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Simplex(limit["v"]),
        f=lambda t, x, u, args: u - x,
        h=lambda t, x, u, args: slope[0] * jnp.array([1.0, 0.8]) + 0.1 * jnp.tanh(u),
    )  # fmt: skip
    x0, sums = jnp.zeros(2), []
    for v, s in ((1.0, 1.0), (2.0, 1.0), (2.0, 3.0)):
        limit["v"], slope[0] = v, s
        u = one.response(0.0, x0)
        sums.append(float(jnp.sum(u)))
        # x follows the constant u.
        end = dvax.solve(one, x0, 0.0, 1.0).xs[-1]
        np.testing.assert_allclose(end, (1.0 - np.exp(-1.0)) * u, atol=1e-5)
    assert sums == pytest.approx([1.0, 2.0, 2.0])


@pytest.mark.slow
def test_a_bound_of_a_solution_with_other_values_is_refused():
    f, change = by_namespace()
    one = problem(f)
    sol = dvax.solve(one, -1.0, 0.0, 2.0, method=dvax.ETD2RK())
    constants = dvax.verify(one, -1.0, 0.0, 2.0).constants
    assert dvax.bound_error(one, sol, constants).status == "proved"
    change(5.0)
    with pytest.raises(dvax.InputError, match="other values of what f, h or K reads"):
        dvax.bound_error(one, sol, constants)


@pytest.mark.slow
def test_constants_of_other_values_are_declared():
    f, change = by_list_of_slopes()
    one = problem(f)
    constants = dvax.verify(one, -1.0, 0.0, 2.0).constants
    for slope, status in ((0.5, "proved"), (0.7, "declared")):
        change(slope)
        sol = dvax.solve(one, -1.0, 0.0, 2.0, method=dvax.ETD2RK())
        assert dvax.bound_error(one, sol, constants).status == status
    again = dvax.verify(one, -1.0, 0.0, 2.0).constants
    assert dvax.bound_error(one, sol, again).status == "proved"
    assert float(again.alpha_f) == 0.7


def by_list_of_slopes():
    slopes = [0.5]
    return lambda t, x, u, args: 3.0 - slopes[0] * x - u, lambda v: slopes.__setitem__(0, v)


@pytest.mark.slow
def test_what_is_computed_later_is_refused_after_a_change():
    f, change = by_closure()
    one = problem(f)
    sol = dvax.solve(one, -1.0, 0.0, 2.0)
    assert sol.us.shape == (1,)
    sol = dvax.solve(one, -0.9, 0.0, 2.0, dense=True)
    change(5.0)
    with pytest.raises(dvax.InputError, match="reads other values now than in the run"):
        sol.evaluate(1.0)
    change(3.0)
    assert np.isfinite(sol.evaluate(1.0)[0])


@pytest.mark.slow
def test_a_table_of_pandas_is_read_again():
    table = pd.DataFrame({"load": [3.0]})
    one = problem(lambda t, x, u, args: float(table["load"].iloc[0]) - 0.5 * x - u)
    found = []
    for load in (3.0, 5.0):
        table.loc[0, "load"] = load
        found.append(float(dvax.solve(one, -1.0, 0.0, 2.0).xs[-1]))
    assert found == pytest.approx([1.836091956, 3.110066757], abs=1e-5)


@pytest.mark.slow
def test_a_record_of_its_calls_that_a_function_keeps_is_no_input():
    calls, load = [], {"v": 3.0}

    def f(t, x, u, args):
        calls.append(1)
        return load["v"] - 0.5 * x - u

    one = problem(f)
    first = dvax.solve(one, -1.0, 0.0, 2.0).xs[-1]
    count = len(calls)
    assert dvax.solve(one, -1.0, 0.0, 2.0).xs[-1] == first and len(calls) == count
    load["v"] = 5.0
    assert float(dvax.solve(one, -1.0, 0.0, 2.0).xs[-1]) == pytest.approx(3.110066757, abs=1e-5)
    assert len(calls) > count


def test_what_no_function_reads_makes_no_other_program():
    plant = Plant()
    plant.runs = 0
    one = problem(plant.rate)
    first = current(one)
    plant.runs, plant.history = 1, [1.0]
    globals().update(history=plant.history)
    assert current(one) is first
    plant.load = 4.0
    assert current(one) is not first


def test_attributes_that_methods_read_are_read_again():
    class Outer(Plant):
        scale = 1.0

        @property
        def gain(self):
            return self.scale * self.load

        def driven(self, x):
            return self.gain - 0.5 * x

    plant = Outer()
    one = problem(lambda t, x, u, args: plant.driven(x) - u)
    first = current(one)
    plant.load = 5.0
    second = current(one)
    plant.scale = 2.0
    assert len({id(first), id(second), id(current(one))}) == 3


def test_nothing_new_is_the_same_problem_and_solutions_can_be_pickled():
    one = problem(Plant())
    assert current(one) is current(one) and current(current(one)) is current(one)
    plain = problem(lambda t, x, u, args: -u)
    assert current(plain) is current(plain)
    own = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=functools.partial(scaled, {"load": 3.0}), h=unloaded,
    )  # fmt: skip
    sol = dvax.solve(own, -1.0, 0.0, 2.0)
    again = pickle.loads(pickle.dumps(sol))  # noqa: S301
    np.testing.assert_array_equal(again.xs, sol.xs)


def unloaded(t, x, u, args):
    return 1.0 - 2.0 * x - u


GAIN = 1.0


def made(scale=1.0, wave=jnp.sin, table=None, inner=2.0, loss=lambda x: x):
    """A problem whose functions are other objects at each call."""

    def leak(x):
        return inner * GAIN * loss(x)

    def rate(t, x, u, args, offset=0.5 * scale):
        return args * wave(t) + offset - leak(x) - u * (1.0 if table is None else table["k"])

    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 3.0),
        f=rate, h=lambda t, x, u, args: 1.0 - x,
    )  # fmt: skip


def parts(problem):
    problem = current(problem)
    return problem.f, problem.h


OTHERS = {
    "number": dict(scale=2.0),
    "function of a library": dict(wave=jnp.cos),
    "number of an inner function": dict(inner=3.0),
    "array": dict(table={"k": np.array(2.0)}),
    "other code": dict(loss=lambda x: x**2),
}


@pytest.mark.parametrize("own", OTHERS.values(), ids=OTHERS)
def test_functions_that_are_made_again_are_equal_if_what_they_read_is(own):
    first, again, other = made(**own), made(**own), made()
    assert parts(first) == parts(again) and hash(parts(first)) == hash(parts(again))
    assert parts(first)[0] != parts(other)[0] and parts(first)[1] == parts(other)[1]


def test_functions_made_again_differ_after_a_global_of_an_inner_function_has_changed(monkeypatch):
    before = parts(made())
    monkeypatch.setitem(globals(), "GAIN", 5.0)
    assert parts(made()) != before
    monkeypatch.undo()
    assert parts(made()) == before


def test_objects_in_the_closures_of_functions_made_again_are_compared_by_identity():
    plant, table = Plant(), dvax.signals.Table([0.0, 1.0], [1.0, 2.0])
    for one, other in ((plant, Plant()), (table, dvax.signals.Table([0.0, 1.0], [1.0, 2.0]))):
        assert parts(made(table=one)) == parts(made(table=one))
        assert parts(made(table=one)) != parts(made(table=other))


def test_a_problem_made_again_compiles_nothing_and_one_with_another_value_is_solved_anew():
    solve = lambda problem, load: float(dvax.solve(problem, 0.5, 0.0, 2.0, load).xs[-1])  # noqa: E731
    first = solve(made(), 1.0)
    STAGES.clear()
    assert solve(made(), 1.0) == first and solve(made(), 2.0) != first
    assert "compile" not in STAGES
    assert solve(made(inner=1.0), 1.0) != first and "compile" in STAGES
    assert solve(made(), 1.0) == first


def nested(depth, value, wrap):
    """A function whose innermost helper reads a value, `depth` closures or containers away."""
    inner = lambda x: value * x  # noqa: E731
    for _ in range(depth):
        inner = wrap(inner)
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 3.0),
        f=lambda t, x, u, args: inner(x) - u, h=lambda t, x, u, args: 1.0 - x,
    )  # fmt: skip


def within_list(inner):
    held = [inner]
    return lambda x: held[0](x)


def within_dict(inner):
    held = {"f": (inner,)}
    return lambda x: held["f"][0](x)


@pytest.mark.parametrize("wrap", [lambda inner: lambda x: inner(x), within_list, within_dict])
@pytest.mark.parametrize("depth", range(7))
def test_a_value_is_told_apart_at_any_depth_of_functions_made_again(depth, wrap):
    one, other = parts(nested(depth, 2.0, wrap)), parts(nested(depth, 3.0, wrap))
    assert one[0] != other[0]
    if depth == 0:
        assert one == parts(nested(depth, 2.0, wrap))


def test_a_number_deep_in_containers_that_a_helper_reads_is_noticed():
    settings = {"spring": {"stiffness": [0.5, {"bent": (2.0,)}]}}

    def stiffness(k):
        return settings["spring"]["stiffness"][k]

    system = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: stiffness(0) * x - u, h=lambda t, x, u, args: 1.0 - x,
    )  # fmt: skip
    before, h = parts(system)
    settings["spring"]["stiffness"][0] = 5.0
    assert parts(system)[0] != before and parts(system)[1] == h
