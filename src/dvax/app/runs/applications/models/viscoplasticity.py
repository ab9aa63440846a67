"""`[model] name = "viscoplasticity"`: a Duvaut–Lions material point on a measured strain path."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication, FramesKeys
from dvax.app.runs.applications.history import read_history
from dvax.app.runs.schema import in_unit
from dvax.errors import Problems, input_error
from dvax.evolution import ETD2RK, Solution
from dvax.models import DruckerPrager, DuvautLions, Model, VonMises
from dvax.models.duvaut_lions import mandel, tensor
from dvax.signals import Table

COMPONENTS = ("11", "22", "33", "23", "13", "12")


class ViscoplasticitySection(FramesKeys):
    """The material, and the strain path."""

    name: Literal["viscoplasticity"] = Field(description="the model")
    strain: str = Field(description="CSV file of times and strains e11, e22, e33, e23, e13, e12")
    bulk_modulus: Annotated[float, in_unit("MPa")] = Field(160e3, gt=0, description="K [MPa]")
    shear_modulus: Annotated[float, in_unit("MPa")] = Field(80e3, gt=0, description="G [MPa]")
    relaxation_time: Annotated[float, in_unit("s")] = Field(
        0.05, gt=0, description="tau [s]; rate-independent as it goes to 0"
    )
    yield_condition: Literal["von-mises", "drucker-prager"] = Field(
        "von-mises", description="cylinder or cone"
    )
    strength: Annotated[float, in_unit("MPa")] | None = Field(
        None, gt=0, description="of von Mises, in tension [MPa]"
    )
    friction: float | None = Field(
        None, gt=0, description="of Drucker and Prager, slope of the limit over the pressure"
    )
    tension: Annotated[float, in_unit("MPa")] | None = Field(
        None, ge=0, description="of Drucker and Prager, hydrostatic tensile strength [MPa]"
    )
    t_end: Annotated[float, in_unit("s")] | None = Field(
        None, gt=0, description="end of the run [s], by default the last time of the strain path"
    )


_DEFAULTS = {"von-mises": {"strength": 250.0}, "drucker-prager": {"friction": 0.9, "tension": 0.0}}


class ViscoplasticityApplication(AbstractModelApplication):
    """Stress and plastic strain over time."""

    section = ViscoplasticitySection
    files = ("strain",)
    end = "model.t_end"
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "bulk": ("bulk_modulus",), "shear": ("shear_modulus",), "relaxation": ("relaxation_time",),
    }  # fmt: skip
    certified = False  # the projection onto a ball or a cone has no enclosure
    bound_words = "bound on the error of the plastic strain in the norm of the energy, ε : C : ε"
    bound_unit = "MPa^(1/2)"

    def __init__(self, table: ViscoplasticitySection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        file, units = paths["strain"], {f"e{c}": "1" for c in COMPONENTS}
        path = read_history(file, units, "s")
        t_end = float(path.times[-1] if table.t_end is None else table.t_end)
        path.check_covers(file, t_end, "s")
        rows = np.zeros((len(path.times), 3, 3))
        for name, values in path.columns.items():
            i, j = int(name[1]) - 1, int(name[2]) - 1
            rows[:, i, j] = rows[:, j, i] = values
        self.moved = [k for k, c in enumerate(COMPONENTS) if np.any(path.columns.get(f"e{c}", 0.0))]
        self.numbers = self._yield_numbers()
        von_mises = table.yield_condition == "von-mises"
        # In an isotropic material a shear that is not moved has no stress; nor have the normal
        # components, if none is moved and yielding does not depend on the pressure.
        normal = not von_mises or min(self.moved, default=3) < 3
        shear = [k for k in self.moved if k >= 3]
        self.responding = [*(range(3) if normal else ()), *shear]
        self.point = DuvautLions(
            bulk=table.bulk_modulus, shear=table.shear_modulus, relaxation=table.relaxation_time,
            strain=Table(path.times, np.asarray(mandel(rows))),
            yields=(VonMises if von_mises else DruckerPrager)(**self.numbers),
        )  # fmt: skip
        model = Model(
            self.point.problem, self.point.virgin, t_end,
            states={"plastic_strain_parts": "1"}, responses={"admissible_stress_parts": "MPa"},
            constants=self.point.constants, settings={"method": ETD2RK(), "rtol": 1e-5, "atol": 1e-8},
        )  # fmt: skip
        self.set_model(model, None)

    def _yield_numbers(self) -> dict[str, float]:
        """Return the numbers of the yield condition, or raise an error for those of another one."""
        kind, problems = self.table.yield_condition, Problems()
        for other in _DEFAULTS.keys() - {kind}:
            for name in _DEFAULTS[other]:
                if (value := getattr(self.table, name)) is not None:
                    with problems.collect():
                        raise input_error(
                            f"model.{name}", f"{value:g}",
                            f"it is a number of {other}, and yield_condition is {kind}",
                            "Leave it out, or change yield_condition",
                        )  # fmt: skip
        problems.raise_any()
        given = {name: getattr(self.table, name) for name in _DEFAULTS[kind]}
        return _DEFAULTS[kind] | {n: v for n, v in given.items() if v is not None}

    @property
    def fit(self) -> str:
        return self.point.fit

    def sizes(self) -> list[tuple[str, str, str]]:
        numbers = ", ".join(f"{name} = {value:g}" for name, value in self.numbers.items())
        moved = ", ".join(f"e{COMPONENTS[k]}" for k in self.moved)
        return [
            ("yield condition", self.table.yield_condition, numbers),
            ("strain", moved, "moved"),
        ]

    def notes(self) -> tuple[str, ...]:
        largest = float(np.abs(np.asarray(self.point.strain.values)).max())  # pyright: ignore[reportAttributeAccessIssue]
        if largest <= 0.05:
            return ()
        return (
            f"model.strain goes up to {largest:.3g}, and the model is that of small strains; "
            "check whether its unit is [1] or [%].",
        )

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        point, ts, xs = self.point, solution.ts, solution.xs
        stress, plastic, strain = (
            np.asarray(tensor(v))
            for v in (
                jax.vmap(point.stress)(ts, xs), jax.vmap(point.plastic_strain)(xs),
                jax.vmap(point.strain.value)(ts),
            )
        )  # fmt: skip
        pressure = -np.trace(stress, axis1=1, axis2=2) / 3
        q = np.asarray(jax.vmap(point.von_mises)(ts, xs))
        numbers = self.numbers
        limit = np.full(q.shape, numbers["strength"]) if "strength" in numbers else (
            numbers["friction"] * np.maximum(pressure + numbers["tension"], 0.0)
        )  # fmt: skip
        size = np.sqrt(2 / 3) * np.linalg.norm(plastic, axis=(1, 2))
        over = np.linalg.norm(np.asarray(_trial(point, ts, xs)) - np.asarray(solution.us), axis=1)
        series = {
            "equivalent_stress": Variable(("time",), q, "MPa", "√(3/2)‖dev σ‖"),
            "yield_limit": Variable(
                ("time",), limit, "MPa", "equivalent stress at which it yields"
            ),
            "pressure": Variable(("time",), pressure, "MPa", "−tr σ/3"),
            "equivalent_plastic_strain": Variable(("time",), size, "1", "√(2/3)‖ε_p‖"),
            "overstress": Variable(("time",), over, "MPa", "distance from the yield set"),
        }
        of = {"strain": (strain, "1"), "stress": (stress, "MPa"), "plastic_strain": (plastic, "1")}
        for what, (values, unit) in of.items():
            words = what.replace("_", " ")
            for k in self.moved if what == "strain" else self.responding:
                c = COMPONENTS[k]
                entry = values[:, int(c[0]) - 1, int(c[1]) - 1]
                series[f"{what}_{c}"] = Variable(("time",), entry, unit, f"{words}, component {c}")
        return {**self.named(solution), **self.bound_series(bound), **series}

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        q, size = series["equivalent_stress"], series["equivalent_plastic_strain"]
        proved = None if bound is None else bound.proved()
        most = None if proved is None else float(proved.max())
        G = self.table.shear_modulus
        soft = min(2 * G, 3 * self.table.bulk_modulus)
        # Work of the stress on the plastic strain, by the trapezoidal rule. Shear counts twice.
        work = sum(
            (1 if k < 3 else 2) * np.trapezoid(series[f"stress_{c}"], series[f"plastic_strain_{c}"])
            for k, c in ((k, COMPONENTS[k]) for k in self.responding)
        )
        figures = {
            # |Δq| ≤ √(3/2)‖Δσ‖ ≤ √(3G)‖Δε_p‖ in the norm of the energy.
            "peak_stress": Figure(
                float(q.max()), "MPa", "largest equivalent stress at the saved times",
                None if most is None else float(np.sqrt(3 * G)) * most,
            ),
            "overstress": Figure(
                float(series["overstress"].max()), "MPa",
                "largest distance of the stress from the yield set",
            ),
            "plastic_strain": Figure(
                float(size[-1]), "1", f"√(2/3)‖ε_p‖ at t = {series['time'][-1]:g} s",
                None if proved is None else float(np.sqrt(2 / (3 * soft)) * proved[-1]),
            ),
            "dissipated_energy": Figure(
                float(work), "MJ/m^3", "work on the plastic strain, from the saved times"
            ),
        }  # fmt: skip
        return self.joined(self.final_values(end) | self.bound_figure(bound), figures)


def _trial(point: DuvautLions, ts: Any, xs: Any) -> jax.Array:
    """Return the stress at every time, in the components of the response."""
    h = point.problem.h
    return jax.vmap(lambda t, x: h(t, x, jnp.zeros_like(x), None))(ts, xs)


APPLICATION = ViscoplasticityApplication
