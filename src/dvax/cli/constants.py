"""The constants of a configured contact law, with their units."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvax.runs.config import Config

# What is no pure number: moduli of F and P⁻¹ are indentation per pressure, rates are 1/time.
COMPLIANCES = frozenset({"gamma", "L_F", "m_P", "norm_P_inv"})
RATES = frozenset(
    {"alpha_f", "beta_f", "omega", "L_tilde", "growth_rate", "decay_rate", "sharp_decay_rate"}
)


def constant_rows(config: "Config") -> list[Mapping[str, Any]]:
    """Name, symbol, value, unit, label in the paper, status and meaning of each constant.

    The constants do not depend on the data g and ℓ, which therefore are not read. q_ρ is given at
    ρ = β, the paper's choice.
    """
    from dvax.models import Contact

    law, units = config.model, config.units
    numbers = {name: getattr(law, name) for name in ("alpha", "beta", "b_x", "b_u", "d_x", "d_u")}
    model = Contact(**numbers, kappa0=law.kappa0, g=0.0, ell=0.0)

    def unit(name: str) -> str:
        if name in COMPLIANCES:
            return f"{units.indentation}/{units.pressure}"
        return f"1/{units.time}" if name in RATES else ""

    rows = model.constants.table(T=config.time.end, rho=law.beta)
    return [row._asdict() | {"unit": unit(row.name)} for row in rows]
