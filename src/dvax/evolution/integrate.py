"""The time loop: one compiled function from a problem to its solution."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..vi import AbstractSolver, Auto, analyse, certify, independent
from .adjoint import adjoint_for, forward_only
from .chords import NoEnclosure, constant
from .control import Adaptive, Fixed, root_mean_squares, step_count
from .flow import Flow, slope
from .method import AbstractMethod
from .solution import RESULTS, Solution
from .stepper import Carry, MildTerm, Record, Stepper


@eqx.filter_jit
def integrate(
    problem: Problem,
    x0: Tree,
    args: Any,
    ts: Any,
    setting: dict[str, Any],
    method: AbstractMethod,
    vi_solver: AbstractSolver,
    moduli: dict[str, Any],
    *,
    fixed: bool,
    measure: bool,
    careful: bool,
    dense: bool,
    max_steps: int,
    adjoint: str,
    progress: bool,
) -> Solution:
    dtype = jnp.result_type(*jtu.tree_leaves(x0))
    s = {name: jnp.asarray(value, dtype) for name, value in setting.items()}
    t0, t1 = s["t0"], s["t1"]
    # Shapes and knots are looked at here, while tracing: a call that is compiled pays nothing.
    problem.check(t0, x0, args)
    knots = jnp.asarray(problem.knots(t0, t1, x0, args), dtype)
    if fixed:
        max_steps += knots.shape[0]
    state, control = problem.spaces(x0)
    generator = problem.generator(args)
    flow = _flow(problem, x0, args, t0, generator, vi_solver, moduli, s, dtype, method)

    uniform = None
    if fixed:
        stops = jnp.concatenate([t0[None], knots, t1[None]])
        controller = Fixed(s["dt"], stops)
        first = None
        if knots.shape[0] == 0:
            length = (t1 - t0) / step_count(t1 - t0, s["dt"])
            uniform = generator.propagator(length, method.degree + 1)
    else:
        sizes = root_mean_squares(state)
        controller = Adaptive(s["rtol"], s["atol"], sizes, s["horizon"], knots, t1)
        first = s["dt0"]
    stepper = Stepper(method, flow, measure, careful, (t0, t1), uniform)

    zero = jnp.zeros((), dtype)
    record = _blank_record(x0, method, dtype) if dense else None
    saved = diffrax.SubSaveAt(
        ts=ts if ts is None else jnp.asarray(ts, dtype),
        t1=ts is None,
        fn=lambda t, y, args: (y.x, y.defect, y.law_defect),
    )
    last = diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: (y.x, y.defect, y.law_defect))
    steps = diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: y.record) if dense else None
    out = diffrax.diffeqsolve(
        MildTerm(),
        stepper,
        t0,
        t1,
        first,
        Carry(x0, zero, zero, record),
        saveat=diffrax.SaveAt(subs=(saved, last, steps), controller_state=True),
        stepsize_controller=controller,
        adjoint=adjoint_for(adjoint, max_steps, x0),
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    assert out.ts is not None and out.ys is not None and out.controller_state is not None
    times = out.ts[0]
    xs, defect, law_defect = out.ys[0]
    us, ys, residual, law_error = _responses(flow, times, xs, control, moduli)
    if adjoint == "forward":
        xs, us, ys = forward_only((xs, us, ys))
    records = out.ys[2] if dense else None
    result = _translate(out.result)
    stats = {
        "steps": out.stats["num_accepted_steps"],
        "rejected": out.stats["num_rejected_steps"],
        "t": out.ts[1][0],
        "x": jtu.tree_map(lambda leaf: leaf[0], out.ys[1][0]),
        "defect": out.ys[1][1][0],
        "next_dt": s["dt"] if fixed else out.controller_state.length,
        "setting": setting,
        "enclosed": flow.enclosed,
        "x0": x0,
        "method": method,
    }
    return Solution(
        ts=times,
        xs=xs,
        us=us,
        ys=ys,
        law_residual=residual,
        law_error=law_error,
        defect=defect if measure else None,
        law_defect=law_defect if measure else None,
        stats=stats,
        result=RESULTS.where(
            (result == RESULTS.successful) & ~_tree.all_finite(out.ys[1][0]),
            RESULTS.nonfinite,
            result,
        ),
        flow=flow,
        records=records,
    )


def _flow(problem, x0, args, t0, generator, vi_solver, moduli, s, dtype, method) -> Flow:
    like = problem.zero_control(x0)
    K = problem.set_at(t0, args)
    frozen = problem.frozen(t0, x0, args)
    structure = analyse(frozen, like)
    intervals = structure.pointwise and structure.affine and K.intervals(like) is not None
    closed = intervals or (structure.isotropic and not isinstance(like, tuple))
    solver = vi_solver
    if isinstance(vi_solver, Auto):
        solver = vi_solver.choose(frozen, K, like)
    direct = closed and isinstance(vi_solver, Auto)
    # A thousandth of what the defect may be, and no less than rounding allows.
    floor = 100 * jnp.finfo(dtype).eps
    tol = jnp.maximum(1e-3 * (s["atol"] + s["rtol"]) / jnp.maximum(1.0, s["horizon"]), floor)
    tol = jnp.where(jnp.isnan(s["dt"]), tol, jnp.maximum(1e-12, floor))
    operator = problem.operator(args)
    reciprocal = None
    if direct and independent(lambda t, x: slope(problem, operator, t, x, args), t0, x0):
        reciprocal = jtu.tree_map(jnp.reciprocal, slope(problem, operator, t0, x0, args))
        if structure.isotropic:
            # One number a part: read from memory once, not once an entry.
            reciprocal = jtu.tree_map(lambda leaf: leaf.ravel()[0], reciprocal)
    flow = Flow(
        problem, args, generator, operator, solver, direct, reciprocal, False, tol,
        moduli.get("gamma"), moduli.get("L_F"),
    )  # fmt: skip
    if direct and intervals and method.degree <= 1 and _can_enclose(flow, t0, x0):
        return dataclasses.replace(flow, enclosed=True)
    return flow


def _can_enclose(flow: Flow, t0, x0) -> bool:
    try:
        jax.eval_shape(lambda t, x: flow.enclosure(constant(t), constant(x)), t0, x0)
    except NoEnclosure:
        return False
    return True


def _responses(flow: Flow, times, xs, control, moduli):
    """u, y and the certificate C0 of the law at the saved states."""
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]

    def one(t, x):
        rate = flow.rate(t, x, None)
        K = flow.problem.set_at(t, flow.args)
        frozen = flow.problem.frozen(t, x, flow.args)
        checked = certify(frozen, K, control, rate.y, tau)
        step = control.norm(_tree.sub(checked.y, rate.y))
        u = flow.operator.inverse(rate.y)
        error = None
        if gamma is not None and norm_P_inv is not None:
            error = norm_P_inv * (checked.bound(gamma) + step)
        return u, rate.y, checked.norm, error

    return jax.vmap(one)(times, xs)


def _blank_record(x0: Tree, method: AbstractMethod, dtype: Any) -> Record:
    zero = jnp.zeros((), dtype)
    return Record(zero, zero, x0, (_tree.zeros_like(x0),) * (method.degree + 1))


def _translate(result: Any) -> RESULTS:
    known = (
        (diffrax.RESULTS.max_steps_reached, RESULTS.max_steps),
        (diffrax.RESULTS.dt_min_reached, RESULTS.step_too_small),
        (diffrax.RESULTS.nonfinite, RESULTS.nonfinite),
        (diffrax.RESULTS.nonlinear_max_steps_reached, RESULTS.law_unsolved),
    )
    out = RESULTS.successful
    for theirs, ours in known:
        out = RESULTS.where(result == theirs, ours, out)
    return out
