"""The time loop: a function from a setup to its solution, to be compiled as a whole."""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..vi import certify
from .adjoint import adjoint_for, forward_only
from .control import Adaptive, Fixed, root_mean_squares, step_count
from .flow import Flow
from .method import AbstractMethod
from .setup import Setup
from .solution import RESULTS, Solution
from .stepper import Carry, MildTerm, Record, Stepper


class Loop(NamedTuple):
    """What a time loop is compiled for, apart from shapes; see `dvax.solve`."""

    fixed: bool
    measure: bool
    careful: bool
    dense: bool
    max_steps: int
    adjoint: str
    progress: bool


def integrate(setup: Setup, ts: Any, loop: Loop) -> Solution:
    fixed, measure, dense, max_steps = loop.fixed, loop.measure, loop.dense, loop.max_steps
    problem, x0, args, method = setup.problem, setup.x0, setup.args, setup.method
    dtype, t0, t1 = setup.dtype, setup.number("t0"), setup.number("t1")
    # Shapes and knots are looked at here, while tracing: a call that is compiled pays nothing.
    problem.check(t0, x0, args)
    knots = jnp.asarray(problem.knots(t0, t1, x0, args), dtype)
    if fixed:
        max_steps += knots.shape[0]
    state, control = problem.spaces(x0)
    flow = setup.flow()

    uniform = None
    if fixed:
        stops = jnp.concatenate([t0[None], knots, t1[None]])
        controller = Fixed(setup.number("dt"), stops)
        first = None
        if knots.shape[0] == 0:
            length = (t1 - t0) / step_count(t1 - t0, setup.number("dt"))
            uniform = flow.generator.propagator(length, method.degree + 1)
    else:
        sizes = root_mean_squares(state)
        controller = Adaptive(
            setup.number("rtol"), setup.number("atol"), sizes, setup.number("horizon"), knots, t1
        )
        first = setup.number("dt0")
    stepper = Stepper(method, flow, measure, loop.careful, (t0, t1), uniform)

    zero = jnp.zeros((), dtype)
    record = _blank_record(x0, method, dtype) if dense else None
    saved = diffrax.SubSaveAt(
        ts=ts if ts is None else jnp.asarray(ts, dtype),
        t1=ts is None,
        fn=lambda t, y, args: (y.x, y.defect, y.law_defect, y.before),
    )
    # Where the run ended, unless that is what is saved anyway.
    last = None if ts is None else diffrax.SubSaveAt(t1=True, fn=saved.fn)
    steps = diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: y.record) if dense else None
    out = diffrax.diffeqsolve(
        MildTerm(),
        stepper,
        t0,
        t1,
        first,
        Carry(x0, zero, zero, record, (zero, zero)),
        saveat=diffrax.SaveAt(subs=(saved, last, steps), controller_state=True),
        stepsize_controller=controller,
        adjoint=adjoint_for(loop.adjoint, max_steps, x0),
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TextProgressMeter() if loop.progress else diffrax.NoProgressMeter(),
    )
    assert out.ts is not None and out.ys is not None and out.controller_state is not None
    times = out.ts[0]
    xs, defect, law_defect, before = out.ys[0]
    us, ys, residual, law_step, law_error = _responses(flow, times, xs, control, setup.moduli)
    if loop.adjoint == "forward":
        xs, us, ys = forward_only((xs, us, ys))
    records = out.ys[2] if dense else None
    result = _translate(out.result)
    end = 0 if ts is None else 1
    last_x = jtu.tree_map(lambda leaf: leaf[0], out.ys[end][0])
    stats = {
        "steps": out.stats["num_accepted_steps"],
        "rejected": out.stats["num_rejected_steps"],
        "t": out.ts[end][0],
        "x": last_x,
        "next_dt": setup.number("dt") if fixed else out.controller_state.length,
    }
    return Solution(
        ts=times,
        xs=xs,
        us=us,
        ys=ys,
        law_residual=residual,
        law_step=law_step,
        law_error=law_error,
        defect=defect if measure else None,
        law_defect=law_defect if measure else None,
        settled=before if measure else None,
        stats=stats,
        result=RESULTS.where(
            (result == RESULTS.successful) & ~_tree.all_finite(last_x),
            RESULTS.nonfinite,
            result,
        ),
        records=records,
        enclosed=flow.enclosed,
        setup=setup,
    )


def _responses(flow: Flow, times, xs, control, moduli):
    """u, y and the certificate C0 of the law at the saved states."""
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]

    def one(t, x):
        rate = flow.rate(t, x, None)
        K = flow.problem.set_at(t, flow.args)
        frozen = flow.problem.frozen(t, x, flow.args)
        checked = certify(frozen, K, control, rate.y, tau)
        return flow.operator.inverse(rate.y), rate.y, checked.w, _tree.sub(checked.y, rate.y)

    def every():
        return jax.vmap(one)(times, xs)

    def nothing():
        return jtu.tree_map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), jax.eval_shape(every))

    # Whether anything was saved is never in doubt, but the compiler does not know that: it would
    # draw all of the above into the sums of the norms, at twenty times the cost for a large state.
    us, ys, w, apart = lax.cond(times[0] < jnp.inf, every, nothing)
    residual, step = jax.vmap(control.norm)(w), jax.vmap(control.norm)(apart)
    error = None
    if gamma is not None and norm_P_inv is not None:
        error = norm_P_inv * (residual / gamma + step)
    return us, ys, residual, step, error


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
