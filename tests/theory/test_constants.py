"""The constants of the paper against an independent implementation of their formulas."""

import numpy as np
import pytest
from tests.closed_forms import c1, c2

import dvax

GOOD = dict(
    gamma=0.5, L_F=3.0, alpha_h=1.2, beta_h=0.7, alpha_f=0.4, beta_f=2.0, M=1.5, omega=-3.0,
    m_P=0.25, norm_P_inv=2.0,
)  # fmt: skip


def formulas(c, T, rho, lam):
    """eq:LU_def, reduceLip, cor:hadamard_wellposed, cor:incremental_stability, eq:smalless with
    ‖I − ρP⁻¹‖ from the ends of the spectrum, eq:Sop."""
    L = c["alpha_h"] * c["norm_P_inv"] / c["gamma"]
    L_tilde = c["alpha_f"] + c["beta_f"] * L
    rate = c["omega"] + c["M"] * L_tilde
    spread = max(abs(1 - rho * c["m_P"]), abs(1 - rho * c["norm_P_inv"]))
    return {
        "L": L,
        "L_tilde": L_tilde,
        "growth_rate": rate,
        "decay_rate": -c["omega"] - c["M"] * L_tilde,
        "hadamard": c["M"] * np.exp(max(rate, 0.0) * T) * (1 + L),
        "contraction_factor": spread + rho * c["beta_h"] * c["norm_P_inv"],
        "bielecki_factor": c["M"] * L_tilde / (lam - c["omega"]),
    }


def test_constants_agree_with_their_formulas():
    rng = np.random.default_rng(4)
    for _ in range(100):
        low, high = np.sort(rng.exponential(size=2))
        m, norm = np.sort(rng.exponential(size=2))
        c = dict(
            gamma=low, L_F=high, m_P=m, norm_P_inv=norm, M=1 + rng.exponential(),
            omega=rng.normal() * 3,
            **{name: rng.exponential() for name in ("alpha_h", "beta_h", "alpha_f", "beta_f")},
        )  # fmt: skip
        T, rho, lam = rng.exponential(size=3) + [0, 0, 20.0]
        found, expected = dvax.Constants(**c), formulas(c, T, rho, lam)
        for name in ("L", "L_tilde", "growth_rate", "decay_rate"):
            assert float(getattr(found, name)) == pytest.approx(
                expected[name], rel=1e-12, abs=1e-12
            )
        assert float(found.hadamard(T)) == pytest.approx(expected["hadamard"], rel=1e-12)
        assert float(found.contraction_factor(rho)) == pytest.approx(expected["contraction_factor"])
        assert float(found.bielecki_factor(lam)) == pytest.approx(expected["bielecki_factor"])
        # ρ* is the best there is: no other one makes ‖I − ρP⁻¹‖ smaller.
        norm_at = lambda r, a=m, b=norm: max(abs(1 - r * a), abs(1 - r * b))  # noqa: E731
        best = norm_at(float(found.best_rho))
        assert all(norm_at(r) >= best - 1e-12 for r in np.linspace(0, 3 / norm, 200))


def test_constants_of_the_published_example():
    one, two = c1().constants, c2().constants
    assert (float(one.L), float(one.L_tilde)) == (1.0, 1.5)
    assert float(one.hadamard(2.0)) == pytest.approx(2 * np.e, rel=1e-14)
    assert float(two.gamma) == pytest.approx(0.6796227590, abs=1e-10)
    assert float(two.L_F) == pytest.approx(1.8918058124, abs=1e-10)
    assert float(two.L) == pytest.approx(0.3711482167, abs=1e-10)


def test_constants_hold_for_random_affine_systems():
    # F(y) = P⁻¹y − (H_x x − H_u P⁻¹y): every inequality that the constants stand for, at random
    # points, with moduli from numpy's norms and eigenvalues.
    rng = np.random.default_rng(5)
    for _ in range(10):
        root = rng.normal(size=(3, 3))
        P = root @ root.T + 0.5 * np.eye(3)
        inverse = np.linalg.inv(P)
        H_u = 0.3 * rng.normal(size=(3, 3))
        H_x, F_x, F_u = rng.normal(size=(3, 3, 3))
        J = (np.eye(3) + H_u) @ inverse
        gamma = np.linalg.eigvalsh(0.5 * (J + J.T))[0]
        if gamma <= 0.01:
            continue
        ends = np.linalg.eigvalsh(inverse)
        norm = lambda m: np.linalg.norm(m, 2)  # noqa: E731
        c = dvax.Constants(
            gamma=gamma, L_F=norm(J), alpha_h=norm(H_x), beta_h=norm(H_u), alpha_f=norm(F_x),
            beta_f=norm(F_u), M=1.0, omega=-1.0, m_P=ends[0], norm_P_inv=ends[-1],
        )  # fmt: skip
        # Without a constraint u = (I + H_u)⁻¹H_x x.
        response = np.linalg.solve(np.eye(3) + H_u, H_x)
        assert norm(response) <= float(c.L) * (1 + 1e-12)
        assert norm(F_x + F_u @ response) <= float(c.L_tilde) * (1 + 1e-12)


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"gamma": 0.0}, "gamma"),
        ({"gamma": -1.0}, "gamma"),
        ({"gamma": float("nan")}, "gamma"),
        ({"gamma": 4.0}, "gamma"),
        ({"L_F": float("inf")}, "L_F"),
        ({"alpha_h": -0.1}, "alpha_h"),
        ({"beta_f": float("nan")}, "beta_f"),
        ({"M": 0.9}, "M"),
        ({"omega": float("nan")}, "omega"),
        ({"m_P": 0.0}, "m_P"),
        ({"m_P": 3.0}, "m_P"),
        ({"norm_P_inv": -1.0}, "norm_P_inv"),
        ({"alpha_f": None}, "alpha_f"),
        ({"alpha_f": "large"}, "alpha_f"),
    ],
)
def test_constants_reject_invalid_values(changed, name):
    with pytest.raises(dvax.InputError, match=rf"Constants\({name}\)"):
        dvax.Constants(**{**GOOD, **changed})


def test_constants_report_all_invalid_values_at_once():
    with pytest.raises(dvax.InputError) as caught:
        dvax.Constants(**{**GOOD, "M": 0.0, "alpha_f": -1.0, "m_P": -1.0})
    for name in ("M", "alpha_f", "m_P"):
        assert f"Constants({name})" in str(caught.value)


def test_constants_status_is_the_weakest_of_its_inputs():
    c = dvax.Constants(**GOOD, status={"gamma": "proved", "alpha_h": "estimated"})
    assert c.status_of("gamma") == "proved"
    assert c.status_of("gamma", "M") == "declared"
    assert c.status_of("gamma", "alpha_h") == "estimated"
    rows = {row.name: row for row in c.table(T=2.0)}
    assert rows["gamma"].status == "proved" and rows["L"].status == "estimated"
    assert rows["L"].value == pytest.approx(1.2 * 2.0 / 0.5) and rows["L"].label == "eq:LU_def"
    assert rows["hadamard"].value == pytest.approx(float(c.hadamard(2.0)))
    assert "sharp_decay_rate" not in rows


def test_constants_reject_an_unknown_status():
    for status in ({"gama": "proved"}, {"gamma": "certain"}):
        word = next(iter(status))
        with pytest.raises(dvax.InputError, match=word):
            # The annotations of the tests' own import hook are not what is tested here.
            dvax.theory.constants._check_status(("gamma",), status)
