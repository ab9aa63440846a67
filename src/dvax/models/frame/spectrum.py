"""Inelastic response spectra: many frames under one record."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ...errors import Problems, SolveError, input_error
from ...evolution import DormandPrince, solve
from .accelerogram import Accelerogram
from .frame import Frame
from .peaks import largest


class Spectrum(NamedTuple):
    """max |d| of frames and of the same frames elastic, at all times, and their d_y (in).

    `peak` / `elastic` is the factor by which yielding changes what is demanded of a frame, `peak` /
    `yield_displacement` the ductility that it needs."""

    peak: np.ndarray
    elastic: np.ndarray
    yield_displacement: np.ndarray


def response_spectrum(
    record: Accelerogram,
    period: Any,
    damping: Any,
    yield_ratio: Any,
    viscosity_ratio: Any,
    *,
    rtol: float = 1e-4,
    chunk: int = 256,
    workers: int | None = None,
) -> Spectrum:
    """The peaks of `Frame`s, for arrays of arguments that are broadcast against each other.

    All frames of a `chunk` are one program (`jax.vmap` of `dvax.solve`), with steps of their own each;
    `workers` threads (as many as there are processors, by default) run chunks side by side. Frames with
    an η/k below 1/200 of the step of the record, for which that explicit method is too stiff, are
    solved one after the other by `Frame.solve`, at a cost that does not grow as η/k → 0. `rtol` is that
    of `dvax.solve`: peaks come out some hundred times better.

    **Raises:** `dvax.InputError` where an argument breaks the rules of `Frame`; `dvax.SolveError` where
    a run failed, with the frame that it was.

    ```python
    >>> import numpy as np
    >>> from dvax.models import Accelerogram, response_spectrum
    >>> push = Accelerogram(0.1, 0.3 * np.sin(np.arange(31)))
    >>> spectrum = response_spectrum(push, [0.5, 0.7], 0.05, [[1.0], [0.5]], 0.01, chunk=4)
    >>> spectrum.peak.round(2).tolist()                         # elastic, and yielding at half of it
    [[2.48, 6.6], [2.04, 4.62]]

    ```
    """
    names = ("period", "damping", "yield_ratio", "viscosity_ratio")
    given = [np.asarray(v, float) for v in (period, damping, yield_ratio, viscosity_ratio)]
    wrong = Problems()
    for name, value in zip(names, given, strict=True):
        bad = ~np.isfinite(value) | (value < 0 if name == "damping" else value <= 0)
        if bad.any():
            place = tuple(int(i) for i in np.argwhere(bad)[0])
            rule = "≥ 0" if name == "damping" else "positive"
            wrong.add(
                f"dvax.models.response_spectrum({name})", f"{value[place]:g} at index {place}",
                f"every entry is {rule}", "Fix it",
            )  # fmt: skip
    wrong.raise_any()
    try:
        T, z, ratio, tau = np.broadcast_arrays(*given)
    except ValueError as error:
        shapes = ", ".join(
            f"{name} {value.shape}" for name, value in zip(names, given, strict=True)
        )
        raise input_error(
            "dvax.models.response_spectrum", f"shapes {shapes}",
            "the arguments are broadcast against each other", "Give each an axis of its own",
        ) from error  # fmt: skip
    shape = T.shape
    run = _Runs(record, rtol, chunk, workers)
    # The elastic frame is the same for every yield ratio.
    pairs, which = np.unique(np.stack([T.ravel(), z.ravel()]), axis=1, return_inverse=True)
    free = np.full(pairs.shape[1], np.inf)
    elastic = run(pairs[0], pairs[1], free, np.ones_like(free))[which.ravel()]
    limit = ratio.ravel() * elastic
    rows = np.stack([T.ravel(), z.ravel(), limit, tau.ravel()])
    stiff = rows[3] < record.step / _STIFF
    peak = np.empty(len(limit))
    if not stiff.all():
        peak[~stiff] = run(*rows[:, ~stiff])
    peak[stiff] = [_alone(record, rtol, *row) for row in rows[:, stiff].T]
    return Spectrum(peak.reshape(shape), elastic.reshape(shape), limit.reshape(shape))


_STIFF = 200.0
"""Steps of a record, in units of η/k, from which on one frame by `PiecewiseLinear` (0.7 ms an interval)
is cheaper than the steps that `DormandPrince` needs for stability (5 to 10 µs each, three η/k long)."""


def _alone(
    record: Accelerogram, rtol: float, period: float, damping: float, limit: float, tau: float
) -> float:
    """The peak of one frame, whatever its η/k."""
    frame = Frame(record=record, period=period, damping=damping, yield_displacement=limit,
                  viscosity_ratio=tau)  # fmt: skip
    return float(frame.largest_displacement(frame.solve(rtol=rtol, atol=1e-3 * rtol)))


class _Runs:
    """The program of a chunk, and its runs."""

    def __init__(self, record: Accelerogram, rtol: float, chunk: int, workers: int | None):
        times = jnp.asarray(record.knots())

        def one(period: Any, damping: Any, limit: Any, tau: Any) -> jax.Array:
            frame = Frame(record=record, period=period, damping=damping, yield_displacement=limit,
                          viscosity_ratio=tau)  # fmt: skip
            found = solve(
                frame.problem, jnp.zeros(3), 0.0, record.duration, ts=times, rtol=rtol,
                atol=1e-3 * rtol, method=DormandPrince(), adjoint="forward",
            )  # fmt: skip
            d, v, _ = found.xs.T
            a = jax.vmap(frame.acceleration)(found.ts, found.xs)
            # Times that were not reached are infinite, and their states NaN.
            return largest(d, v, a, record.step)

        example = [jax.ShapeDtypeStruct((chunk,), times.dtype)] * 4
        self._program = jax.jit(jax.vmap(one)).lower(*example).compile()
        self._chunk, self._workers = chunk, workers or os.cpu_count() or 1

    def __call__(self, *columns: np.ndarray) -> np.ndarray:
        """The peaks of frames, a row each of periods, damping ratios, yield displacements, η/k."""
        count = len(columns[0])
        # Frames of one period take their steps together.
        order = np.argsort(columns[0], kind="stable")
        table = np.stack(columns)[:, order]
        padded = np.pad(table, ((0, 0), (0, -count % self._chunk)), mode="edge")
        parts = np.split(padded, padded.shape[1] // self._chunk, axis=1)
        with ThreadPoolExecutor(self._workers) as pool:
            found = list(pool.map(lambda part: np.asarray(self._program(*part)), parts))
        peaks = np.empty(count)
        peaks[order] = np.concatenate(found)[:count]
        if not np.all(np.isfinite(peaks)):
            k = int(np.flatnonzero(~np.isfinite(peaks))[0])
            T, z, limit, tau = (float(column[k]) for column in columns)
            raise SolveError(
                f"The frame with period {T:g} s, damping {z:g}, yield displacement {limit:g} in and "
                f"η/k = {tau:g} s did not reach the end of the record. Solve it alone to see why."
            )
        return peaks
