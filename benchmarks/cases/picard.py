"""All times of a window at once against sequential steps, on the device that JAX uses."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..section import Section, Table, compare

_END = 2.0
_STEPS = 4096


def run(full: bool) -> Section:
    device = jax.devices()[0]
    section = Section(
        title=f"Picard: {_STEPS} steps in windows of all times at once, on {device.device_kind}",
        fair=(
            "dvax.Picard beside dvax.ETD2RK, both of order 2 with steps of the same length under "
            "jax.jit, on the same device and with the same law. A sweep evaluates the law at all "
            "times of a window as one batch, and a window takes some ten of them: on a device with "
            "cores for all of them that is fewer turns, on two cores it is more work. Errors against "
            "ETD4RK at rtol 1e-10."
        ),
    )
    sweeps = Table("sweeps", ("case", "windows", "sweeps of all", "contraction"), [])
    for name, problem, x0 in (_point(), _network(40)):
        exact = np.asarray(
            dvax.solve(problem, x0, 0.0, _END, method=dvax.ETD4RK(), rtol=1e-10, atol=1e-10).xs[-1]
        )
        for nodes in (64, 1024) if full else (64,):
            methods = {"ours": dvax.Picard(nodes=nodes), "step by step": dvax.ETD2RK()}
            runs = {key: _run(problem, method) for key, method in methods.items()}
            found = {key: run(x0) for key, run in runs.items()}
            taken = in_turn(
                {
                    key: timed(lambda run=run, x0=x0: jax.block_until_ready(run(x0)[0]))
                    for key, run in runs.items()
                },
                7 if full else 3,
            )
            error, other = (
                float(np.abs(np.asarray(found[key][0]) - exact).max()) for key in methods
            )
            case = f"{name}, {nodes} steps a window"
            section.comparisons.append(
                compare(
                    case, "ETD2RK, step by step", taken["ours"], taken["step by step"],
                    direction="other/dvax", error=error, error_other=other,
                    target=None if device.platform == "cpu" else ("≥", 1.0),
                )
            )  # fmt: skip
            stats = found["ours"][1]
            sweeps.rows.append(
                (case, str(int(stats["windows"])), str(int(stats["sweeps"])),
                 f"{float(stats['contraction']):.2f}")
            )  # fmt: skip
    section.tables.append(sweeps)
    return section


def _run(problem: dvax.Problem, method: Any) -> Any:
    @jax.jit
    def run(x0: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
        found = dvax.solve(problem, x0, 0.0, _END, dt=_END / _STEPS, method=method)
        return found.xs[-1], {k: v for k, v in found.stats.items() if k not in ("x", "t")}

    return run


def _point() -> tuple[str, dvax.Problem, jax.Array]:
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    return "one point, law in closed form", problem, jnp.asarray(-1.0)


def _network(n: int) -> tuple[str, dvax.Problem, jax.Array]:
    """x' = −x − u + load(t), u ∈ x − Bu − N_[0, 1](u) with a nonsymmetric B: iterated at every time."""
    rng = np.random.default_rng(4)
    B = jnp.asarray(rng.normal(size=(n, n)) / np.sqrt(n) + 1.5 * np.eye(n))
    load = jnp.asarray(rng.uniform(1.0, 2.0, n))
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: load * (1.0 + jnp.sin(3.0 * t)) - u,
        h=lambda t, x, u, args: x - B @ u,
    )  # fmt: skip
    return f"{n} unknowns, law by iteration", problem, jnp.zeros(n)
