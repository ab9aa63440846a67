"""Ground acceleration records: evenly spaced samples with linear interpolation."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import Problems
from ...formats.at2 import read_at2
from ...signals import AbstractSignal

GRAVITY = 9.80665 / 0.0254
"""Standard gravity in in/s². Earthquake engineering often uses 386.4, which is 0.08 % larger."""


class Accelerogram(AbstractSignal):
    """a_g(t) in in/s², from samples in units of standard gravity every `step` seconds from t = 0.

    It is a `dvax.signals.Table(kind="linear")` that finds the interval of t by a division instead of a
    search, since response spectra evaluate it for thousands of oscillators seven times a step.

    **Arguments:** `step` in s, positive; `acceleration` in g, at least two samples.

    **Raises:** `dvax.InputError` if the step is not positive or samples are not finite.

    ```python
    >>> from dvax.models import Accelerogram
    >>> record = Accelerogram(0.02, [0.0, 0.1, -0.1])
    >>> round(float(record(0.01)), 3), record.knots().tolist()      # 0.05 g
    (19.304, [0.0, 0.02, 0.04])

    ```
    """

    step: float
    samples: jax.Array

    def __init__(self, step: Any, acceleration: Any):
        name = "dvax.models.Accelerogram"
        samples = _tree.host(_tree.as_float(acceleration, f"{name}(acceleration)"))
        with np.errstate(over="ignore"):  # what overflows is refused below
            scaled = GRAVITY * samples
        wrong = Problems()
        if not (isinstance(step, float | int) and np.isfinite(step) and step > 0):
            wrong.add(
                f"{name}(step)", repr(step), "it must be a positive number of seconds",
                "Give the time between two samples",
            )  # fmt: skip
        if samples.ndim != 1 or samples.size < 2:
            wrong.add(
                f"{name}(acceleration)", f"shape {samples.shape}",
                "it must be a vector of at least two samples", "Give one number for each sample",
            )  # fmt: skip
        elif not np.all(np.isfinite(scaled)):
            k = int(np.flatnonzero(~np.isfinite(scaled))[0])
            wrong.add(
                f"{name}(acceleration)", f"{samples[k]} at sample {k}",
                "all samples must be finite, in in/s² too", "Fill the gaps explicitly",
            )  # fmt: skip
        wrong.raise_any()
        self.step = float(step)
        self.samples = jnp.asarray(scaled)

    @classmethod
    def from_at2(cls, path: str | os.PathLike[str]) -> "Accelerogram":
        """Return the record of a file in the PEER strong-motion format.

        The file has lines of description that state the unit g, a line such as
        `NPTS=  1559, DT= .02000 SEC`, and the values.

        **Raises:** `dvax.InputError` with the lines of all errors.
        """
        return cls(*read_at2(path))

    def value(self, t: Any) -> jax.Array:
        return dvax_linear_table(jnp.asarray(self.knots()), self.samples, t)

    def knots(self) -> Any:
        return self.step * np.arange(self.samples.shape[0])

    def span(self) -> tuple[Any, Any]:
        return 0.0, self.duration

    @property
    def duration(self) -> float:
        """The time of the last sample (s)."""
        return self.step * (self.samples.shape[0] - 1)


@jax.jit
def dvax_linear_table(times: jax.Array, values: jax.Array, t: Any) -> jax.Array:
    """Interpolate linearly between evenly spaced times.

    It has the name of the corresponding function of `dvax.signals.Table`, for which `dvax.programs`
    has rules.
    """
    first, width = times[0], times[1] - times[0]
    place = (t - first) / width
    k = jnp.clip(jnp.floor(place), 0.0, float(times.shape[0] - 2))
    i = k.astype(int)
    left, right = values[i], values[i + 1]
    return jnp.where((t >= first) & (t <= times[-1]), left + (place - k) * (right - left), jnp.nan)
