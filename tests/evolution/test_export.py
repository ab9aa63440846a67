"""Exported programs: equal to the solve, in another process too, and refusals in plain words."""

import json
import subprocess
import sys
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax

TS = [0.5, 1.0, 2.0]


@once
def pair():
    """A state of two parts, of which the first is bounded by a law that is solved by iteration."""
    return dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Scalar(-1.0), dvax.generators.Zero()),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Simplex(1.0),
        f=lambda t, x, u, args: (args["load"] - u, jnp.sum(u) * x[1] * args["n"]),
        h=lambda t, x, u, args: jnp.array([1.0, 0.5]) - x[0] - u**3,
        control_space=dvax.spaces.Euclidean(2),
    )  # fmt: skip


START = (jnp.array([0.2, -0.4]), jnp.array(1.0))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The file of an exported program with derivatives of order one."""
    path = tmp_path_factory.mktemp("program") / "pair.dvax"
    run = dvax.export(pair(), START, 0.0, 2.0, {"load": 1.0, "n": -1}, TS, derivatives=1, rtol=1e-7)
    run.save(path)
    return path


def solve(x0, load):
    return dvax.solve(pair(), x0, 0.0, 2.0, {"load": load, "n": -1}, TS, rtol=1e-7)


@pytest.mark.slow
def test_exported_program_equals_the_solve_for_the_example_and_other_inputs(program):
    run = dvax.load_exported(program)
    other = (START[0] + 0.1, START[1])
    for x0, load, found in (
        (START, 1.0, run()),
        (other, 2.0, run(other, args={"load": 2.0, "n": -1})),
    ):
        sol = solve(x0, load)
        assert found.result == dvax.RESULTS.successful and found.raise_if_failed() is found
        for name in ("ts", "xs", "us", "ys", "law_residual", "defect"):
            a, b = (jax.tree_util.tree_leaves(getattr(s, name)) for s in (found, sol))
            assert len(a) == len(b)
            for p, q in zip(a, b, strict=True):
                np.testing.assert_allclose(p, q, rtol=1e-12, atol=1e-14)
        assert int(found.stats["steps"]) == int(sol.stats["steps"])


@pytest.mark.thorough
def test_exported_program_runs_in_a_process_without_the_problem(program):
    """And traces none of its functions, since it has none."""
    code = f"""
import jax
jax.config.update("jax_enable_x64", True)
import dvax, json
run = dvax.load_exported({str(program)!r})
found = jax.jit(lambda load: run(t1=1.75, args={{"load": load, "n": -1}}, ts=[0.5, 1.0, 1.5]))(2.0)
print(json.dumps([found.xs[0].tolist(), found.xs[1].tolist(), found.us.tolist()]))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    xs, ys, us = map(np.array, json.loads(ran.stdout))
    args = {"load": 2.0, "n": -1}
    sol = dvax.solve(pair(), START, 0.0, 1.75, args, [0.5, 1.0, 1.5], rtol=1e-7)
    np.testing.assert_allclose(xs, sol.xs[0], atol=1e-12)
    np.testing.assert_allclose(ys, sol.xs[1], atol=1e-12)
    np.testing.assert_allclose(us, sol.us, atol=1e-12)


@pytest.mark.thorough
def test_gradient_of_an_exported_program_equals_that_of_the_solve(program):
    run = dvax.load_exported(program)

    def of_program(load):
        found = run(args={"load": load, "n": -1})
        return found.xs[1][1] + jnp.sum(found.us[0] ** 2)

    def of_solve(load):
        sol = solve(START, load)
        return sol.xs[1][1] + jnp.sum(sol.us[0] ** 2)

    assert float(jax.grad(of_program)(1.0)) == pytest.approx(
        float(jax.grad(of_solve)(1.0)), rel=1e-9
    )


@pytest.mark.thorough
def test_failed_run_of_an_exported_program_is_nan_with_its_result(program):
    run = dvax.load_exported(program)
    found = run(t0=1.0, t1=0.0)
    assert found.result == dvax.RESULTS.invalid_number
    assert np.isinf(found.ts).all() and np.isnan(found.xs[0]).all()
    with pytest.raises(dvax.SolveError, match="breaks a rule"):
        found.raise_if_failed()
    args = lambda load: {"load": load, "n": -1}  # noqa: E731
    slope = jax.grad(lambda load: run(t0=1.0, t1=0.0, args=args(load)).xs[1][1])(1.0)
    assert np.isnan(slope)


WRONG = {
    "x0 of another shape": (dict(x0=(jnp.zeros(3), 1.0)), r"\(x0\[0\]\): got float64 of shape"),
    "x0 of another type": (dict(x0=(jnp.zeros(2, jnp.float32), 1.0)), "got float32 of shape"),
    "x0 of another structure": (dict(x0=jnp.zeros(2)), "a tuple of"),
    "x0 that is a text": (dict(x0=(jnp.zeros(2), "one")), "got str"),
    "t1 that is a vector": (dict(t1=[1.0, 2.0]), r"\(t1\): got"),
    "another number of times": (dict(ts=[1.0]), r"\(ts\): got"),
    "another flag": (dict(args={"load": 1.0, "n": 2}), r"args\['n'\] = 2"),
    "other names": (dict(args={"loads": 1.0, "n": -1}), r"args\['loads'\]"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_of_an_exported_program_is_refused(program, name):
    given, text = WRONG[name]
    with pytest.raises(dvax.InputError, match=text):
        dvax.load_exported(program)(**given)


@pytest.mark.thorough
def test_transformations_that_jax_does_not_export_are_refused(program):
    run = dvax.load_exported(program)
    with pytest.raises(dvax.InputError, match="jax.lax.map"):
        jax.vmap(lambda t1: run(t1=t1).xs[1])(jnp.array([2.0, 3.0]))
    batch = jax.lax.map(lambda t1: run(t1=t1).xs[1], jnp.array([2.0, 3.0]))
    np.testing.assert_allclose(batch[0], run().xs[1], rtol=1e-14)


def damaged(program, **changes):
    """The bytes of a program whose header was changed."""
    with zipfile.ZipFile(program) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    header = json.loads(parts["header.json"]) | changes
    copy = program.with_suffix(".copy")
    with zipfile.ZipFile(copy, "w") as file:
        for name, content in (parts | {"header.json": json.dumps(header)}).items():
            file.writestr(name, content)
    return copy.read_bytes()


@pytest.mark.slow
def test_files_that_are_no_readable_programs_are_refused(program):
    whole = program.read_bytes()
    for source, text in (
        (program.with_name("missing"), "No such file"),
        (b"a text", "damaged"),
        (whole[: len(whole) // 2], "damaged"),
        (damaged(program, format=2, dvax="9.0"), "Install dvax 9.0 or newer"),
        (
            damaged(program, calling_convention=10_000, jax="9.9"),
            "a program of dvax .* and JAX 9.9",
        ),
    ):
        with pytest.raises(dvax.InputError, match=text):
            dvax.load_exported(source)
    elsewhere = dvax.load_exported(damaged(program, platforms=["tpu"]))
    with pytest.raises(dvax.InputError, match=r'platforms=\["cpu"\]'):
        elsewhere()


@pytest.mark.thorough
def test_options_and_code_that_a_program_cannot_have_are_refused():
    def told(t, x, u, args):
        if args:
            jax.debug.print("{}", x)
        return -u

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=told, h=lambda t, x, u, args: x,
    )  # fmt: skip
    for options, text in (
        (dict(dense=True), r"dvax.export\(dense\)"),
        (dict(progress=True), r"dvax.export\(progress\)"),
        (dict(derivatives=-1), "whole number"),
        (dict(dt=0.5), "callbacks to Python"),
        (dict(method=dvax.Implicit()), "Implicit; it calls Python"),
        (dict(method=dvax.PiecewiseLinear()), "PiecewiseLinear; it calls Python"),
    ):
        with pytest.raises(dvax.InputError, match=text):
            dvax.export(problem, 1.0, 0.0, 1.0, "dt" in options, **options)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(dict(dt=0.01), id="fixed steps"),
        pytest.param(
            dict(method=dvax.Picard(), rtol=1e-4), id="Picard", marks=pytest.mark.thorough
        ),
    ],
)
def test_program_of_another_method_equals_its_solve(options):
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    run = dvax.load_exported(dvax.export(problem, -1.0, 0.0, 2.0, **options).to_bytes())
    want = dvax.solve(problem, 0.5, 0.0, 1.5, **options).xs[0]
    assert float(run(0.5, t1=1.5).xs[0]) == pytest.approx(float(want), rel=1e-6)


@pytest.mark.thorough
def test_events_of_an_exported_program_are_those_of_the_solve():
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
        f=lambda t, x, u, args: 1.0 + 0.0 * x, h=lambda t, x, u, args: x,
    )  # fmt: skip
    events = [dvax.Event(lambda t, x, u, args: x - 0.5, name="half", terminal=True)]
    run = dvax.load_exported(
        dvax.export(problem, 0.0, 0.0, 2.0, events=events, max_events=4).to_bytes()
    )
    found = run(-0.25)
    assert found.result == dvax.RESULTS.terminal_event and found.events is not None
    assert float(found.events.ts[0]) == pytest.approx(0.75) and found.events.names == ("half",)
    assert float(found.ts[0]) == pytest.approx(0.75)
