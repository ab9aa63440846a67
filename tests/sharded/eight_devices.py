"""Solves a problem on one device and on eight, and prints what differs and what is communicated.

A program of its own, since the number of devices is settled before JAX starts."""

import json
import os
import sys

os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
)

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import dvax

jax.config.update("jax_enable_x64", True)

N = 512
LINE, PLANE = PartitionSpec("points"), PartitionSpec("points", None)
s = (np.arange(N) + 0.5) / N
y, z = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(24) + 0.5) / 24, indexing="ij")
g, P, sets = dvax.generators, dvax.operators.Scaling(1.0), dvax.sets
ETD2RK = {"method": dvax.ETD2RK()}
FIXED, ADAPTIVE = {"dt": 0.05, **ETD2RK}, {"rtol": 1e-5, **ETD2RK}


def f(t, x, u, args):
    return jnp.exp(-t) * args - 0.2 * x - u


def h(t, x, u, args):
    return 1.0 - 1.5 * x - 0.5 * u


def parts(fn):
    return lambda t, x, u, args: tuple(fn(t, *each) for each in zip(x, u, args, strict=True))


def problem(A, K, f=f, h=h, P=P, **spaces):
    return dvax.Problem(A=A, P=P, K=K, f=f, h=h, **spaces)


def pair(place):
    """A state of two parts of different length."""
    space = dvax.spaces.Product(dvax.spaces.Euclidean(N), dvax.spaces.Euclidean(2 * N))
    A = g.Product(g.Scalar(-1.0), g.Diagonal(place(-1.0 - np.tile(s, 2), LINE)))
    K = sets.Product(sets.Box(0.0, 0.4), sets.Box(0.0, jnp.inf))
    P2 = dvax.operators.Product(P, P)
    return problem(A, K, parts(f), parts(h), P2, state_space=space, control_space=space)


def moving_box(t, args):
    return sets.Box(0.0, 0.3 + 0.1 * jnp.sin(9 * t))


def line(boundary, **more):
    return lambda place: problem(g.Elliptic(N, 1.0, boundary, 1e-3, **more), sets.Box(0.0, 0.4))


def per_point(place):
    K = sets.Box(place(0.1 * s, LINE), place(0.3 + 0.1 * s, LINE))
    return problem(g.Diagonal(place(-1.0 - s, LINE)), K)


def plane(*boundary):
    A = g.Elliptic((16, 24), 1.0, boundary, 1e-2)
    return lambda place: problem(A, sets.Box(0.0, jnp.inf))


BOTH = np.sin(3 * s), np.tile(s, 2)
CASES = {
    "diagonal, a box per point, fixed steps": (per_point, s, np.sin(3 * s), LINE, FIXED),
    "diagonal, a box per point, ETD2RK": (per_point, s, np.sin(3 * s), LINE, ADAPTIVE),
    "diagonal, a box per point, the default": (per_point, s, np.sin(3 * s), LINE, {"rtol": 1e-5}),
    "a number, the orthant, ETD4RK": (
        lambda place: problem(g.Scalar(-1.0), sets.Box(0.0, jnp.inf)),
        s, np.sin(3 * s), LINE, {"rtol": 1e-5, "method": dvax.ETD4RK(), "ts": [0.5, 1.0]},
    ),
    "zero, a box, ExpRosenbrock": (
        lambda place: problem(g.Zero(), sets.Box(0.0, 0.4)),
        s, np.sin(3 * s), LINE, {"rtol": 1e-5, "method": dvax.ExpRosenbrock()},
    ),
    "a number, a moving box, DormandPrince": (
        lambda place: problem(g.Scalar(-1.0), moving_box),
        s, np.sin(3 * s), LINE, {"rtol": 1e-5, "method": dvax.DormandPrince()},
    ),
    "a number, a ball, fixed steps": (
        lambda place: problem(g.Scalar(-1.0), sets.Ball(0.0, 2.0)), s, np.sin(3 * s), LINE, FIXED,
    ),
    "two parts, ETD2RK": (pair, BOTH, BOTH, LINE, ADAPTIVE),
    "a periodic line, fixed steps": (line("periodic"), s, np.sin(3 * s), LINE, FIXED),
    "a line between zeros, fixed steps": (line("dirichlet"), s, np.sin(3 * s), LINE, FIXED),
    "an insulated plane, fixed steps": (plane("neumann", "neumann"), y, z, PLANE, FIXED),
    "a plane of two kinds, ETD2RK": (plane("dirichlet", "periodic"), y, z, PLANE, ADAPTIVE),
}  # fmt: skip


def places():
    """On one device, and sharded over eight."""
    mesh = Mesh(np.array(jax.devices()), ("points",))
    yield lambda v, spec: jnp.asarray(v)
    yield lambda v, spec: jax.device_put(v, NamedSharding(mesh, spec))


def apart(a, b):
    """The largest difference, relative to the largest entry."""
    leaves = [map(np.asarray, jax.tree_util.tree_leaves(tree)) for tree in (a, b)]
    return max(
        float(np.max(np.abs(p - q)) / np.max(np.abs(q))) for p, q in zip(*leaves, strict=True)
    )


def solved(name, place):
    make, args, x0, spec, options = CASES[name]
    args, x0 = (jax.tree_util.tree_map(lambda v: place(v, spec), v) for v in (args, x0))
    return (make(place), x0, 0.0, 1.0, args), options


def compared(name):
    (one, _), (many, options) = (solved(name, place) for place in places())
    alone, shared = dvax.solve(*one, **options), dvax.solve(*many, **options)
    found = dvax.communication(*many, **options)
    starts, ends = map(jax.tree_util.tree_leaves, (many[1], shared.xs))
    keeps = [_has_sharding_of(x0, rows) for x0, rows in zip(starts, ends, strict=True)]
    return {
        "apart": max(apart(shared.xs, alone.xs), apart(shared.us, alone.us)),
        "steps": [int(alone.stats["steps"]), int(shared.stats["steps"])],
        "keeps its sharding": all(keeps),
        "collectives": [[*one] for one in found.step],
    }


def _has_sharding_of(x0, rows):
    """Whether rows of states are sharded as x0 is."""
    spec = PartitionSpec(None, *x0.sharding.spec)
    return rows.sharding.is_equivalent_to(NamedSharding(x0.sharding.mesh, spec), rows.ndim)


def gradient():
    name = "an insulated plane, fixed steps"

    def slope(place):
        (problem, x0, t0, t1, args), options = solved(name, place)
        end = lambda x0: jnp.sum(dvax.solve(problem, x0, t0, t1, args, **options).xs[-1] ** 2)  # noqa: E731
        return jax.grad(end)(x0)

    one, many = map(slope, places())
    return {"apart": apart(many, one), "spec": str(many.sharding.spec)}


def dense():
    name = "diagonal, a box per point, ETD2RK"
    ends = []
    for place in places():
        given, options = solved(name, place)
        sol = dvax.solve(*given, **options, dense=True)
        ends.append(sol.evaluate(0.37))
    return {"apart": apart(ends[1], ends[0]), "spec": str(ends[1][0].sharding.spec)}


def bounds():
    name = "diagonal, a box per point, ETD2RK"
    found = []
    for place in places():
        given, options = solved(name, place)
        constants = dvax.verify(given[0], given[1], 0.0, 1.0, given[4]).constants
        sol = dvax.solve(*given, **options, constants=constants, dense=True)
        found.append(dvax.bound_error(given[0], sol, constants).x)
    return {"apart": apart(found[1], found[0])}


def refused():
    mesh = jax.make_mesh((8,), ("points",), axis_types=(jax.sharding.AxisType.Explicit,))
    name = "a number, a ball, fixed steps"
    alone, shard = places()
    explicit = lambda v, spec: jax.device_put(v, NamedSharding(mesh, spec))  # noqa: E731
    (one, _), (many, options), (typed, _) = (solved(name, p) for p in (alone, shard, explicit))
    bad, texts = shard(np.where(s > 0.5, np.nan, s), LINE), []
    for call in (
        lambda: dvax.solve(*typed, **options),
        lambda: dvax.solve(many[0], bad, *many[2:], **options),
        lambda: dvax.communication(*one, **options),
    ):
        try:
            call()
        except dvax.InputError as error:
            texts.append(str(error))
    return texts


CHECKS = {"gradient": gradient, "dense": dense, "bounds": bounds, "refused": refused}

if __name__ == "__main__":
    names = json.loads(sys.argv[1])
    answers = {n: CHECKS[n]() if n in CHECKS else compared(n) for n in names}
    print(json.dumps(answers))
