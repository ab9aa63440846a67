"""The finite-element contact: reference forces, Hertz, and the whole body without condensation."""

from pathlib import Path

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
import skfem
from skfem.models.elasticity import linear_elasticity

import dvax
from dvax.models.fem_contact import ElasticBody, FemContact

MESHES = [(10, 4, 17), (20, 9, 21), (40, 19, 25)]
DOFS, POINTS = [3876, 9828, 23700], [140, 290, 590]
UNCAPPED = [4.84434666e-3, 4.84208992e-3, 4.84181025e-3]
CAPPED = [4.67498819e-3, 4.67188144e-3, 4.67160640e-3]


@pytest.fixture(scope="module")
def bodies():
    return [ElasticBody({"fine": f, "coarse": c, "layers": n}) for f, c, n in MESHES]


def build(body, **changed):
    given = {"indentation": 0.01, "stiffness": 100.0, "pressure_cap": 0.01, **changed}
    return FemContact(body, **given)


def force(model, pressure):
    return model.figures(pressure)["force"]


@pytest.mark.thorough
def test_fem_contact_forces_converge_on_three_meshes(bodies):
    found = []
    for body, dofs, points, free, capped in zip(bodies, DOFS, POINTS, UNCAPPED, CAPPED):
        assert (body.unknowns, len(body.points)) == (dofs, points)
        found.append([])
        for cap, reference in ((np.inf, free), (0.01, capped)):
            model = build(body, pressure_cap=cap)
            rest = model.equilibrium()
            assert rest.vi.result == dvax.vi.RESULTS.successful
            assert float(rest.vi.error_bound) <= 1e-10
            found[-1].append(force(model, rest.pressure))
            assert found[-1][-1] == pytest.approx(reference, rel=2e-9)
        # The last of the mesh is the last capped one.
        figures = model.figures(rest.pressure)
        gamma, L_F = model.steady_constants
        assert float(gamma) == pytest.approx(0.01) and figures["peak_pressure"] == 0.01
    assert float(L_F) == pytest.approx(3.571, abs=5e-4)
    assert figures["saturated_length"] == pytest.approx(0.409, abs=5e-4)
    steps = np.abs(np.diff(found, axis=0))
    assert np.all(steps[1] < 0.2 * steps[0])


@pytest.mark.thorough
def test_fem_contact_of_a_stiff_surface_agrees_with_hertz(bodies):
    body = bodies[2]
    model = build(body, stiffness=1e4, pressure_cap=np.inf)
    rest = model.equilibrium()
    figures = model.figures(rest.pressure)
    E_star = 1.0 / (1.0 - 0.3**2)
    half_width = np.sqrt(4 * 10.0 * figures["force"] / (np.pi * E_star))
    peak = 2 * figures["force"] / (np.pi * half_width)
    assert figures["force"] == pytest.approx(4.888188e-3, rel=1e-7)
    assert figures["peak_pressure"] / peak == pytest.approx(1.0013, abs=5e-5)
    assert figures["contact_half_width"] / half_width == pytest.approx(0.9955, abs=5e-5)
    # All along the contact, not at its ends alone: within 1 % in the mean.
    hertz = peak * np.sqrt(np.maximum(1 - (body.points[:, 0] / half_width) ** 2, 0.0))
    off = np.sum(body.weights * np.abs(np.asarray(rest.pressure) - hertz))
    assert off < 0.01 * figures["force"]


@pytest.fixture(scope="module")
def run(bodies):
    """The transient of the reference on the middle mesh."""
    model = build(bodies[1])
    return model, dvax.solve(
        model.problem, model.untouched, 0.0, 12.0, ts=np.linspace(0.0, 12.0, 25),
        rtol=0.0, atol=1e-9, method=model.method,
    )  # fmt: skip


@pytest.mark.slow
def test_fem_contact_transient_reaches_the_steady_variational_inequality(run):
    model, sol = run
    rest = model.equilibrium()
    away = np.max(np.abs(np.asarray(sol.ys[-1]) - np.asarray(rest.pressure)))
    assert away < 1e-6
    assert away == pytest.approx(1.2e-7, abs=0.05e-7)
    assert force(model, sol.ys[-1]) == pytest.approx(4.67188150e-3, rel=2e-9)
    # And no faster or slower than the material: e^{-t/τ}.
    distance = np.linalg.norm(np.asarray(sol.xs) - np.asarray(rest.state), axis=1)
    late = np.asarray(sol.ts) >= 4.0
    assert np.all(np.diff(np.log(distance[late])) <= -0.5 + 1e-6)


@pytest.mark.thorough
def test_fem_contact_trajectory_bound_is_proved_and_holds(bodies):
    model = build(bodies[0])
    settings = dict(ts=np.linspace(1.0, 6.0, 6), rtol=0.0, method=model.method)
    coarse, fine = (
        dvax.solve(model.problem, model.untouched, 0.0, 6.0, atol=atol, **settings)
        for atol in (1e-5, 1e-9)
    )
    found = dvax.bound_error(model.problem, coarse, model.constants)
    sharp = dvax.bound_error(model.problem, fine, model.constants)
    assert found.status == sharp.status == "proved"
    true = np.linalg.norm(np.asarray(coarse.xs) - np.asarray(fine.xs), axis=1)
    assert np.all(true <= np.asarray(found.x) + np.asarray(sharp.x))
    assert np.max(found.x) < 2e-5 and np.max(true) > 10 * np.max(sharp.x)


@pytest.mark.thorough
def test_fem_contact_constants_are_proved_by_verify(bodies):
    model = build(bodies[0], relaxation_time=2.0, b_u=0.25)
    check = dvax.verify(model.problem, model.untouched, 0.0, 4.0)
    assert check.status == "proved"
    c = model.constants
    for name in (
        "gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega", "m_P",
        "norm_P_inv", "one_sided",
    ):  # fmt: skip
        mine, theirs = float(getattr(c, name)), float(getattr(check.constants, name))
        assert mine == pytest.approx(theirs, rel=1e-9, abs=1e-12), name
    # b_u is inside: (1 + b_u)/β, and the gain ‖C‖β/(τ(1+b_u)), by which the paper's rate fails.
    assert float(c.gamma) == pytest.approx(0.0125)
    assert float(c.growth_rate) == pytest.approx(-0.5 + 100 * 3.5570 / (2 * 1.25), rel=1e-4)
    assert float(c.sharp_decay_rate) == 0.5


@pytest.mark.thorough
def test_fem_contact_trajectories_approach_in_the_energy_norm(bodies):
    model = build(bodies[0], stiffness=30.0)
    starts = np.random.default_rng(3).normal(size=(2, model.untouched.size)) * 0.01
    ts = np.linspace(0.0, 3.0, 13)
    a, b = (
        dvax.solve(model.problem, jnp.asarray(x), 0.0, 3.0, ts=ts, rtol=0.0, atol=1e-7)
        for x in starts
    )
    distance = np.linalg.norm(np.asarray(a.xs) - np.asarray(b.xs), axis=1)
    assert np.all(distance <= np.exp(-ts) * distance[0] + 4e-7)


@pytest.mark.slow
def test_fem_contact_fully_saturated_body_creeps_exponentially(bodies):
    body, tau, cap = bodies[0], 1.7, 1e-4
    model = build(body, indentation=lambda t: 2.0 + 0.0 * t, pressure_cap=cap, relaxation_time=tau)
    ts = np.array([0.3, 1.0, 4.0])
    sol = dvax.solve(model.problem, model.untouched, 0.0, 4.0, ts=ts, method=dvax.ETD2RK())
    assert np.all(np.asarray(sol.ys) == cap)
    compliant = body.trace @ ((body.weights * cap) @ body.trace)
    for t, x in zip(ts, np.asarray(sol.xs)):
        seen = body.trace @ x / np.sqrt(tau)
        np.testing.assert_allclose(seen, -(1 - np.exp(-t / tau)) * compliant, rtol=1e-9)


def bulged():
    """Triangles under a curved top, so that the normals vary from point to point."""
    mesh = skfem.MeshTri.init_tensor(np.linspace(-2.0, 2.0, 25), np.linspace(-2.0, 0.0, 13))
    points = mesh.p.copy()
    points[1] += 0.02 * (1 + points[1] / 2) * np.cos(2 * points[0])
    top, held = (
        mesh.facets_satisfying(lambda x, at=at: np.abs(x[1] - at) < 1e-9) for at in (0.0, -2.0)
    )
    return skfem.MeshTri(points, mesh.t).with_boundaries({"contact": top, "clamped": held})


class Whole:
    """All displacements of a body of triangles, assembled independently."""

    def __init__(self, mesh):
        element = skfem.ElementVector(skfem.ElementTriP2())
        self.basis = skfem.Basis(mesh, element)
        self.free = self.basis.complement_dofs(self.basis.get_dofs("clamped"))
        K = linear_elasticity(0.3 / (1.3 * 0.4), 1 / 2.6).assemble(self.basis)
        self.K = K[self.free][:, self.free].tocsc()
        edge = skfem.FacetBasis(mesh, element, facets=mesh.boundaries["contact"], intorder=9)
        self.w = edge.dx.ravel()
        N = np.zeros((self.w.size, edge.N))
        for f, dofs in zip(edge.basis, edge.element_dofs):
            value = np.einsum("dfq,dfq->fq", np.asarray(f[0]), np.asarray(edge.normals))
            np.add.at(N, (np.arange(len(N)), np.repeat(dofs, edge.dx.shape[1])), value.ravel())
        self.N = scipy.sparse.csc_array(N[:, self.free])


def euler(M, B, w, model, dt, steps):
    """Implicit Euler for τMx' + Mx = −BᵀWp(Bx), by Newton: the last x, and p of all steps."""
    beta, cap = float(model.beta), float(model.kappa0)
    a, x, out = float(model.tau) / dt, np.zeros(M.shape[0]), []
    for k in range(1, steps + 1):
        g = np.asarray(model.gap - model.vertical_normal * model.depth(jnp.asarray(k * dt)))
        old = a * (M @ x)
        for _ in range(40):
            drive = beta * (B @ x - g)
            r = (a + 1) * (M @ x) - old + B.T @ (w * np.clip(drive, 0, cap))
            active = scipy.sparse.diags_array(w * beta * ((drive > 0) & (drive < cap)))
            step = scipy.sparse.csc_array((a + 1) * M + B.T @ active @ B)
            change = scipy.sparse.linalg.spsolve(step, r)
            x = x - change
            if np.max(np.abs(change)) < 1e-15:
                break
        out.append(np.clip(beta * (B @ x - g), 0, cap))
    return x, np.array(out)


@pytest.mark.slow
def test_fem_contact_condensed_body_equals_the_whole_body():
    mesh = bulged()
    whole, body = Whole(mesh), ElasticBody(mesh)
    assert body.unknowns == whole.K.shape[0] == 2 * 49 * 24
    # An edge sees the normal parts of its three nodes; two edges that meet at an angle see both
    # components of their common node. The tangential part of a node in the middle is not seen.
    assert body.trace.shape == (24 * 5, 24 * 3)
    model = build(body, indentation=0.05, pressure_cap=0.03, radius=3.0, relaxation_time=0.7)
    root = float(model.tau) ** 0.5
    x, p = euler(whole.K, whole.N, whole.w, model, 0.25, 16)
    unit = scipy.sparse.eye_array(72, format="csc")
    # In the inner product τK of the viscosity: Mx' τ is x' for coordinates of unit length.
    y, q = euler(unit, scipy.sparse.csc_array(body.trace), body.weights, model, 0.25, 16)
    assert 10 < np.sum(p[-1] >= 0.03) < np.sum(p[-1] > 0) < 100
    np.testing.assert_allclose(q, p, rtol=0, atol=1e-11)
    every = np.zeros(whole.basis.N)
    every[whole.free] = x
    at_nodes = model.displacement(root * y)
    for node, value in zip(body.nodes, at_nodes):
        near = np.all(np.abs(whole.basis.doflocs - node[:, None]) < 1e-12, axis=0)
        np.testing.assert_allclose(every[near], value, atol=1e-11)
    # And the energy is the norm of the state.
    assert root * np.linalg.norm(y) == pytest.approx(np.sqrt(0.7 * x @ (whole.K @ x)), rel=1e-9)


@pytest.mark.slow
def test_fem_contact_steady_state_solves_a_quadratic_programme(bodies):
    model = build(bodies[0], b_u=0.5)
    body, rest = bodies[0], model.equilibrium()
    # min ½⟨p, (1.5/β + C)p⟩ + ⟨g, p⟩ over the box, as least squares, by Stark and Parker's method.
    root = np.sqrt(body.weights)
    half = root[:, None] * body.trace
    hessian = half @ half.T + 0.015 * np.eye(len(root))
    factor = np.linalg.cholesky(hessian)
    gap = np.asarray(model.gap) - 0.01
    aim = np.linalg.solve(factor, -root * gap)
    found = scipy.optimize.lsq_linear(
        factor.T / 1.0, aim, bounds=(0.0, 0.01 * root), method="bvls", tol=1e-15
    )
    np.testing.assert_allclose(found.x / root, np.asarray(rest.pressure), atol=1e-9)
    # There the state of the evolution stands still.
    rate = -rest.state / model.tau + model.problem.reduced(3.0, rest.state)
    assert float(jnp.linalg.norm(rate)) < 1e-9


@pytest.mark.slow
def test_fem_contact_equilibrium_converges_where_newton_cycles(bodies):
    body = bodies[0]
    C = body.trace @ (body.trace * body.weights[:, None]).T
    gap = body.points[:, 0] ** 2 / 20.0 - 0.01
    seen, state = {}, np.where(-100.0 * gap >= 0.01, 2, np.where(gap < 0, 1, 0))
    # From x = 0: all points at the cap, then all apart, and so on.
    for k in range(20):
        p = 0.01 * (state == 2)
        free = state == 1
        if free.any():
            rest = gap + C @ p
            p[free] = np.linalg.solve((C + np.eye(len(C)) / 100)[np.ix_(free, free)], -rest[free])
        drive = 100.0 * (-C @ p - gap)
        new = np.where(drive <= 0, 0, np.where(drive >= 0.01, 2, 1))
        if np.array_equal(new, state) or new.tobytes() in seen:
            break
        seen[new.tobytes()] = k
        state = new
    assert not np.array_equal(new, state), "undamped Newton is expected to cycle here"
    # β‖C‖ = 35 570, where the safeguard of the solver alone takes more than a thousand steps.
    for beta in (1e2, 1e4):
        rest = build(body, stiffness=beta).equilibrium()
        # With β‖C‖ = 3.6e6 roundoff alone keeps the bound above the tolerance.
        at_roundoff = float(rest.vi.residual) <= float(rest.vi.rounding)
        assert rest.vi.result == dvax.vi.RESULTS.successful or at_roundoff
        assert int(rest.vi.iterations) < 10


@pytest.mark.slow
def test_fem_contact_stress_balances_the_punch(run, tmp_path: Path):
    model, sol = run
    t, x = float(sol.ts[3]), sol.xs[3]
    p = np.asarray(sol.ys[3])
    pushed = force(model, p)
    stress, areas = model.stress(t, x), model.body.areas()
    # Against v = (0, y + 4), 0 where clamped: ∫ σ_yy = −4 F; against v = (1, 0)(y + 4): ∫ σ_xy = 0.
    assert np.sum(areas) == pytest.approx(32.0)
    assert np.sum(areas * stress[:, 1]) == pytest.approx(-4.0 * pushed, rel=1e-10)
    assert abs(np.sum(areas * stress[:, 3])) < 1e-10 * pushed
    # Plane strain: at rest and in motion σ_zz = ν(σ_xx + σ_yy).
    np.testing.assert_allclose(stress[:, 2], 0.3 * (stress[:, 0] + stress[:, 1]), atol=1e-15)
    whole, contact = (meshio.read(path) for path in model.write(tmp_path / "at.vtu", t, x))
    assert whole.cells[0].type == "quad9" and contact.cells[0].type == "vertex"
    np.testing.assert_allclose(contact.point_data["pressure"], p, rtol=1e-12)
    np.testing.assert_allclose(whole.cell_data["stress"][0][:, 4], stress[:, 1])
    # The displacement that was written is, at the top, the one that the law saw.
    seen = model.body.trace @ np.asarray(x)
    top = np.abs(whole.points[:, 1]) < 1e-12
    order = np.argsort(whole.points[top, 0])
    s, down = whole.points[top, 0][order], whole.point_data["displacement"][top, 1][order]
    near = np.interp(contact.points[:, 0], s, down)
    np.testing.assert_allclose(near, seen, atol=0.02 * np.max(np.abs(seen)))
    middle = np.argmin(np.abs(contact.points[:, 0]))
    assert seen[middle] == pytest.approx(near[middle], rel=1e-3)
    with pytest.raises(dvax.InputError, match="extension .vtu or .vtk"):
        model.write(tmp_path / "at.stl", t, x)


@pytest.mark.thorough
def test_fem_contact_indentation_may_be_a_table(bodies):
    record = dvax.signals.Table([0.0, 2.0, 3.0, 5.0], [0.0, 0.01, 0.01, 0.002])
    model = build(bodies[0], indentation=record)
    same = build(bodies[0])
    settings = dict(ts=np.linspace(0.5, 3.0, 6), rtol=0.0, atol=1e-8)
    a, b = (dvax.solve(m.problem, m.untouched, 0.0, 3.0, **settings) for m in (model, same))
    np.testing.assert_allclose(np.asarray(a.ys), np.asarray(b.ys), atol=2e-6)
    assert 3.0 in np.asarray(model.problem.knots(0.0, 5.0, model.untouched))
    with pytest.raises(dvax.InputError, match="never extrapolated"):
        dvax.solve(model.problem, model.untouched, 0.0, 6.0)
    with pytest.raises(dvax.InputError, match="Call equilibrium"):
        model.equilibrium()
    held = model.equilibrium(0.01)
    assert force(model, held.pressure) == pytest.approx(CAPPED[0], rel=2e-9)


@pytest.mark.thorough
def test_fem_contact_force_has_derivatives_in_all_parameters(bodies):
    body = bodies[0]

    def resultant(values):
        stiffness, cap, depth = values
        model = build(body, stiffness=stiffness, pressure_cap=cap, indentation=depth)
        return jnp.sum(model.weights * model.equilibrium().pressure)

    at = jnp.array([100.0, 0.01, 0.01])
    slope = jax.grad(resultant)(at)
    for k, h in enumerate((1e-2, 1e-7, 1e-7)):
        step = jnp.zeros(3).at[k].set(h)
        quotient = (resultant(at + step) - resultant(at - step)) / (2 * h)
        assert float(slope[k]) == pytest.approx(float(quotient), rel=1e-5)


@pytest.mark.slow
def test_fem_contact_solution_does_not_depend_on_the_units(bodies):
    sizes = dict(zip(("fine", "coarse", "layers"), MESHES[0]))
    mm = ElasticBody({**sizes, "width": 8e3, "height": 4e3, "fine_half_width": 500.0},
                     youngs_modulus=200.0)  # fmt: skip
    there = FemContact(mm, indentation=10.0, stiffness=20.0, pressure_cap=2.0, radius=1e4)
    figures, here = there.figures(there.equilibrium().pressure), build(bodies[0])
    plain = here.figures(here.equilibrium().pressure)
    for name, unit in (("force", 2e5), ("contact_half_width", 1e3), ("saturated_length", 1e3)):
        assert figures[name] == pytest.approx(unit * plain[name], rel=1e-9), name


def test_fem_contact_punch_above_the_body_exerts_no_force(bodies):
    model = build(bodies[0])
    rest = model.equilibrium(-0.001)
    assert set(model.figures(rest.pressure).values()) == {0.0}
    # And a flat one, pressed in, leaves no point apart.
    flat = build(bodies[0], radius=np.inf, pressure_cap=np.inf)
    assert np.all(np.asarray(flat.equilibrium().pressure) > 0)
    assert (model.method, build(bodies[0], stiffness=1e4).method) == (
        dvax.ETD2RK(), dvax.ExpRosenbrock(),
    )  # fmt: skip


BAD = [
    ("stiffness", 0.0), ("stiffness", np.inf), ("pressure_cap", -1.0), ("radius", 0.0),
    ("relaxation_time", np.inf), ("b_u", -0.1), ("centre", np.nan), ("indentation", np.inf),
    ("indentation", "deep"), ("ramp", 0.0), ("stiffness", [1.0, 2.0]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_fem_contact_rejects_bad_parameters_by_name(bodies, name, value):
    with pytest.raises(dvax.InputError) as caught:
        build(bodies[0], **{name: value})
    assert [name in problem.place for problem in caught.value.problems] == [True]


def test_fem_contact_reports_all_bad_parameters_at_once(bodies):
    with pytest.raises(dvax.InputError) as caught:
        build(bodies[0], stiffness=0.0, pressure_cap=0.0, indentation=np.nan, b_u=-1.0)
    assert len(caught.value.problems) == 4
