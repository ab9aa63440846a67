"""The constants of the theory and the quantities derived from them, with their labels in the paper."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from .. import _repr, _tree
from ..errors import InputProblem, Problems
from .domain import Domain
from .status import ORDER, Status, weakest

_PRIMARY = (
    "gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega", "m_P", "norm_P_inv",
)  # fmt: skip


class Row(NamedTuple):
    """One line of `Constants.table`: a constant with its value, label, status and meaning.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> rows = dvax.verify(problem, -1.0, 0.0, 2.0).constants.table()
    >>> print(rows[0].symbol, rows[0].value, rows[0].status)
    γ 2.0 proved

    ```
    """

    name: str
    symbol: str
    value: float
    label: str
    status: Status
    meaning: str


class Constants(eqx.Module):
    """The moduli of a coupled system, declared by the caller or proved by a model.

    **Arguments** (paper's symbol and label):

    - `gamma` (γ) and `L_F`: strong pseudomonotonicity and Lipschitz modulus of the frozen operator
      (ass:strong_pseudomono);
    - `alpha_h` (ass:h_lipschitz_x), `beta_h` (ass:lipschitz_smallness): Lipschitz moduli of h in
      x and in u;
    - `alpha_f`, `beta_f`: those of f (ass:f_lipschitz);
    - `M`, `omega`: ‖e^{At}‖ ≤ M e^{ωt} (lem:semigroup_bound_prelim);
    - `m_P`, `norm_P_inv`: min σ(P⁻¹) and ‖P⁻¹‖ (ass:operators);
    - `one_sided` (μ), optional: ⟨A(x−x') + f̃(x) − f̃(x'), x−x'⟩ ≤ μ‖x−x'‖². The paper's constants
      use absolute values where μ keeps signs, so μ ≤ ω + M L̃ if M = 1;
    - `energy` (M, μ), optional: ‖x₁−x₂‖ ≤ M e^{μt}‖Δx₀‖ by contraction in another norm, of condition
      number M² (`dvax.verify(energy=True)` computes one);
    - `status`: "proved" or "declared" for all of them, or a mapping from name to status;
    - `domain`: the `args`, times and states for which they hold, from `dvax.verify`; None for all.

    **Raises:** `dvax.InputError` if γ, L_F, m_P or ‖P⁻¹‖ is not positive, a Lipschitz modulus is
    negative, M < 1, or γ > L_F.

    ```python
    >>> import dvax
    >>> c = dvax.Constants(gamma=2.0, L_F=2.0, alpha_h=2.0, beta_h=1.0, alpha_f=0.5, beta_f=1.0,
    ...                    M=1.0, omega=-1.0, m_P=1.0, norm_P_inv=1.0)
    >>> float(c.L), float(c.L_tilde), round(float(c.hadamard(2.0)), 6)
    (1.0, 1.5, 5.436564)

    ```
    """

    gamma: Any
    L_F: Any
    alpha_h: Any
    beta_h: Any
    alpha_f: Any
    beta_f: Any
    M: Any
    omega: Any
    m_P: Any
    norm_P_inv: Any
    one_sided: Any
    energy: tuple[Any, Any] | None
    statuses: tuple[tuple[str, Status], ...] = eqx.field(static=True)
    domain: Domain | None

    def __init__(
        self,
        *,
        gamma: Any,
        L_F: Any,
        alpha_h: Any,
        beta_h: Any,
        alpha_f: Any,
        beta_f: Any,
        M: Any,
        omega: Any,
        m_P: Any,
        norm_P_inv: Any,
        one_sided: Any = None,
        energy: tuple[Any, Any] | None = None,
        status: Status | Mapping[str, Status] = "declared",
        domain: Domain | None = None,
    ):
        self.domain = domain
        self.energy = None
        if energy is not None:
            M_energy, rate = (_tree.as_float(v, "dvax.Constants(energy)") for v in energy)
            self.energy = M_energy, rate
        values = (gamma, L_F, alpha_h, beta_h, alpha_f, beta_f, M, omega, m_P, norm_P_inv)
        for name, value in zip(_PRIMARY, values, strict=True):
            setattr(self, name, _tree.as_float(value, f"dvax.Constants({name})"))
        self.one_sided = (
            None if one_sided is None else _tree.as_float(one_sided, "dvax.Constants(one_sided)")
        )
        names: tuple[str, ...] = (*_PRIMARY, "one_sided", "energy")
        given_statuses: dict[str, Status] = {}
        for name in names if isinstance(status, str) else status:
            given_statuses[name] = status if isinstance(status, str) else status[name]
        _check_status(names, given_statuses)
        # A constant that is None has no status, so that it does not weaken the others.
        present = [n for n in sorted(names) if getattr(self, n) is not None]
        pairs: list[tuple[str, Status]] = [(n, given_statuses.get(n, "declared")) for n in present]
        self.statuses = tuple(pairs)
        self._check()

    def __repr__(self) -> str:
        optional = ("one_sided", "energy")
        names = (*_PRIMARY, *(name for name in optional if getattr(self, name) is not None))
        title = (
            "Constants" if self.domain is None else "Constants for the times and states of `domain`"
        )
        return _repr.table(
            title,
            [(n, f"{_repr.value_text(getattr(self, n)):<14} {self.status_of(n)}") for n in names],
        )

    @property
    def L(self) -> Any:
        """Lipschitz constant of the state-to-control map: L = α_h ‖P⁻¹‖/γ (eq:LU_def)."""
        c = _tree.host(self)
        return c.alpha_h * c.norm_P_inv / c.gamma

    @property
    def L_tilde(self) -> Any:
        """Lipschitz constant of the reduced map: L̃ = α_f + β_f L (reduceLip)."""
        c = _tree.host(self)
        return c.alpha_f + c.beta_f * self.L

    @property
    def growth_rate(self) -> Any:
        """ω + M L̃, the exponent of every estimate of thm:continuous_dependence."""
        c = _tree.host(self)
        return c.omega + c.M * self.L_tilde

    @property
    def decay_rate(self) -> Any:
        """η − M L̃ with η = −ω: the rate at which two trajectories approach, if it is positive
        (cor:incremental_stability)."""
        return -self.growth_rate

    @property
    def sharp_decay_rate(self) -> Any:
        """−μ with the one-sided constant μ, or None if that is unknown: ‖x₁−x₂‖ ≤ e^{μt}‖Δx₀‖, since
        d/dt ½‖x₁−x₂‖² ≤ μ‖x₁−x₂‖²."""
        return None if self.one_sided is None else -_tree.host(self.one_sided)

    def hadamard(self, T: Any) -> Any:
        """Return C_T = M e^{(ω+ML̃)₊T}(1 + L), with ‖(x₁,u₁)−(x₂,u₂)‖ ≤ C_T‖Δx₀‖
        (cor:hadamard_wellposed)."""
        return self.largest_separation(T) * (1.0 + self.L)

    def separation(self, t: Any) -> Any:
        """Return S = M e^{(ω+ML̃)t}, with ‖x₁(t)−x₂(t)‖ ≤ S‖Δx₀‖ (1stestistability)."""
        c, lib = _tree.host(self), _tree.array_module(self, t)
        return c.M * _exp(lib, self.growth_rate * t)

    def response_separation(self, t: Any) -> Any:
        """Return S = L M e^{(ω+ML̃)t}, with ‖u₁(t)−u₂(t)‖ ≤ S‖Δx₀‖ (2ndestistability)."""
        return self.L * self.separation(t)

    def largest_separation(self, T: Any) -> Any:
        """Return S = M e^{(ω+ML̃)₊T}, with max over [0, T] of ‖x₁−x₂‖ ≤ S‖Δx₀‖ (supesti1); LS is the
        factor for u (supesti2)."""
        c, lib = _tree.host(self), _tree.array_module(self, T)
        return c.M * _exp(lib, lib.maximum(self.growth_rate, 0.0) * T)

    def sharp_separation(self, t: Any) -> Any:
        """Return e^{μt}, the `separation` with the one-sided constant, or None if that is unknown."""
        lib = _tree.array_module(self, t)
        return None if self.one_sided is None else _exp(lib, _tree.host(self.one_sided) * t)

    @property
    def smallness(self) -> tuple[Any, Any]:
        """(m_P − β_h‖P⁻¹‖, ‖P⁻¹‖(1 + β_h)), which are a γ and an L_F if the first is positive
        (remark:assstrong (i), eq:Liph)."""
        c = _tree.host(self)
        return c.m_P - c.beta_h * c.norm_P_inv, c.norm_P_inv * (1.0 + c.beta_h)

    def contraction_factor(self, rho: Any) -> Any:
        """Return q_ρ = ‖I − ρP⁻¹‖ + ρ β_h ‖P⁻¹‖ (eq:smalless), with ‖I − ρP⁻¹‖ from the spectrum."""
        c, lib = _tree.host(self), _tree.array_module(self, rho)
        spread = lib.maximum(abs(1.0 - rho * c.m_P), abs(1.0 - rho * c.norm_P_inv))
        return spread + rho * c.beta_h * c.norm_P_inv

    @property
    def best_rho(self) -> Any:
        """ρ* = 2/(m_P + ‖P⁻¹‖), which minimises ‖I − ρP⁻¹‖ (remark after eq:smalless)."""
        c = _tree.host(self)
        return 2.0 / (c.m_P + c.norm_P_inv)

    def bielecki_factor(self, lam: Any) -> Any:
        """Return M L̃/(λ − ω), by which the Picard map contracts in the λ-norm if λ > ω + M L̃
        (eq:Sop)."""
        c = _tree.host(self)
        return c.M * self.L_tilde / (lam - c.omega)

    def best_lambda(self, T: Any) -> Any:
        """Return the λ of the Bielecki norm that minimises the error bound in the maximum norm.

        ‖x − Sx‖_λ = r implies ‖x − x*‖_C ≤ e^{λT} r/(1 − q) with q = ML̃/(λ − ω). With s = λ − ω
        and a = ML̃, the factor e^{sT}s/(s − a) is minimal for T s(s − a) = a, that is s = (a + √(a²
        + 4a/T))/2.
        """
        c, lib = _tree.host(self), _tree.array_module(self, T)
        a = c.M * self.L_tilde
        return c.omega + 0.5 * (a + lib.sqrt(a * a + 4.0 * a / T))

    def status_of(self, *names: str) -> Status:
        """Return the weakest status among the named constants."""
        statuses: list[Status] = [status for name, status in self.statuses if name in names]
        return weakest(*statuses)

    @np.errstate(over="ignore", invalid="ignore")  # overflow is ∞ in the table
    def table(self, T: Any = None, rho: Any = None) -> list[Row]:
        """Return every constant with its label and status, and C_T if the horizon T is given."""
        rho = self.best_rho if rho is None else rho
        law = ("alpha_h", "norm_P_inv", "gamma")
        flow = (*law, "alpha_f", "beta_f")
        rate = (*flow, "M", "omega")
        rows = [
            ("gamma", "γ", self.gamma, "ass:strong_pseudomono", ("gamma",),
             "modulus of strong pseudomonotonicity of the frozen operator"),
            ("L_F", "L_F", self.L_F, "ass:strong_pseudomono", ("L_F",),
             "Lipschitz modulus of the frozen operator"),
            ("alpha_h", "α_h", self.alpha_h, "ass:h_lipschitz_x", ("alpha_h",),
             "Lipschitz modulus of the feedback h in the state"),
            ("beta_h", "β_h", self.beta_h, "ass:lipschitz_smallness", ("beta_h",),
             "Lipschitz modulus of the feedback h in the response"),
            ("alpha_f", "α_f", self.alpha_f, "ass:f_lipschitz", ("alpha_f",),
             "Lipschitz modulus of f in the state"),
            ("beta_f", "β_f", self.beta_f, "ass:f_lipschitz", ("beta_f",),
             "Lipschitz modulus of f in the response"),
            ("M", "M", self.M, "lem:semigroup_bound_prelim", ("M",),
             "overshoot of the semigroup"),
            ("omega", "ω", self.omega, "lem:semigroup_bound_prelim", ("omega",),
             "growth rate of the semigroup"),
            ("m_P", "m_P", self.m_P, "remark:assstrong", ("m_P",), "min of the spectrum of P⁻¹"),
            ("norm_P_inv", "‖P⁻¹‖", self.norm_P_inv, "ass:operators", ("norm_P_inv",),
             "max of the spectrum of P⁻¹"),
            ("L", "L", self.L, "eq:LU_def", law, "Lipschitz constant of the response u_x(t)"),
            ("L_tilde", "L̃", self.L_tilde, "lem:lipschitz_reduced", flow,
             "Lipschitz constant of the reduced map"),
            ("growth_rate", "ω + M L̃", self.growth_rate, "thm:continuous_dependence", rate,
             "largest rate at which two trajectories can separate"),
            ("decay_rate", "η − M L̃", self.decay_rate, "cor:incremental_stability", rate,
             "rate at which two trajectories approach, if positive"),
            ("q_rho", "q_ρ", self.contraction_factor(rho), "ass:lipschitz_smallness",
             ("m_P", "norm_P_inv", "beta_h"),
             f"factor of the projection route at ρ = {_number(rho)}; it must be below 1"),
        ]  # fmt: skip
        if T is not None:
            rows.append(
                ("hadamard", "C_T", self.hadamard(T), "cor:hadamard_wellposed", rate,
                 f"Lipschitz constant of the solution map on [0, {_number(T)}]")
            )  # fmt: skip
        if self.one_sided is not None:
            rows.append(
                ("sharp_decay_rate", "−μ", self.sharp_decay_rate,
                 "one-sided, sharper than the paper", ("one_sided",),
                 "rate of approach, if positive; it takes the sign of the feedback into account")
            )  # fmt: skip
        if self.energy is not None:
            overshoot, rate_of_energy = self.energy
            rows.append(
                ("energy_rate", "−μ_Q", -_tree.host(rate_of_energy),
                 "energy norm, sharper than the paper", ("energy",),
                 f"rate of approach, if positive, with an overshoot of {_number(overshoot)}")
            )  # fmt: skip
        return [
            # Adding 0 turns −0 into 0.
            Row(name, symbol, float(value) + 0.0, label, self.status_of(*sources),
                _meaning(meaning, float(value)))
            for name, symbol, value, label, sources, meaning in rows
        ]  # fmt: skip

    def _check(self) -> None:
        c = _tree.host(self)
        rules = [
            *((n, abs(getattr(c, n)) < np.inf, "finite") for n in _PRIMARY),
            *((n, getattr(c, n) > 0, "positive") for n in ("gamma", "L_F", "m_P", "norm_P_inv")),
            *((n, getattr(c, n) >= 0, "≥ 0") for n in ("alpha_h", "beta_h", "alpha_f", "beta_f")),
            ("M", c.M >= 1, "≥ 1"),
            ("energy", True if c.energy is None else c.energy[0] >= 1, "(M, μ) with M ≥ 1"),
            ("gamma", c.gamma <= c.L_F * (1 + 1e-12), "at most L_F"),
            ("m_P", c.m_P <= c.norm_P_inv * (1 + 1e-12), "at most norm_P_inv"),
        ]  # fmt: skip
        wrong = Problems(
            InputProblem(
                f"dvax.Constants({name})",
                _tree.short(getattr(self, name)),
                f"it must be {rule}",
                "Check its definition in the docstring of dvax.Constants",
            )
            for name, holds, rule in rules
            if _tree.is_concrete(holds) and not bool(np.all(holds))
        )
        wrong.raise_any()


def _exp(lib: Any, exponent: Any) -> Any:
    """Return e^exponent, or ∞ without a warning if it overflows."""
    with np.errstate(over="ignore"):
        return lib.exp(exponent)


def _meaning(meaning: str, value: float) -> str:
    return meaning if np.isfinite(value) else f"{meaning}; it is not finite, so it gives no bound"


def _number(value: Any) -> str:
    return f"{float(value):.6g}"


def _check_status(names: Collection[str], values: Mapping[str, Any]) -> None:
    wrong = Problems(
        InputProblem(
            "dvax.Constants(status)",
            f"{name!r}: {value!r}",
            f"it must map names among {', '.join(names)} to one of {', '.join(ORDER)}, since the "
            "status of a bound depends on it",
            "Fix the name or the status",
        )
        for name, value in values.items()
        if name not in names or value not in ORDER
    )
    wrong.raise_any()
