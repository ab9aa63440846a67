"""The constants of a configured contact law, as a run writes them into its trajectory."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvax.app.runs.config import Config


def constant_rows(config: "Config") -> list[Mapping[str, Any]]:
    """Name, symbol, value, unit, label in the paper, status and meaning of each constant.

    The constants do not depend on the data g and ℓ, which therefore are not read. q_ρ is given at
    ρ = β, the paper's choice.
    """
    from dvax.app.runs.contact_frames import constant_rows as rows_of
    from dvax.models import Contact

    law = config.model
    numbers = {name: getattr(law, name) for name in ("alpha", "beta", "b_x", "b_u", "d_x", "d_u")}
    model = Contact(**numbers, kappa0=law.kappa0, g=0.0, ell=0.0)
    return [*rows_of(model.constants, config, config.time.end, law.beta)]
