"""Inelastic response spectra: the peaks of many frames under one record."""

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
from .peaks import peak_displacement


class Spectrum(NamedTuple):
    """Peak displacements (in): of the frames, of the elastic frames, and the yield displacements d_y.

    `peak` / `elastic` is the inelastic displacement ratio, `peak` / `yield_displacement` the ductility
    demand.
    """

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
    """Return the peaks of `Frame`s, for arrays of arguments that broadcast against each other.

    The frames of a `chunk` are solved by one program (`jax.vmap` of `dvax.solve`), each with its own
    step sizes. `workers` threads (by default the number of processors) run chunks in parallel. Frames
    with η/k below 1/200 of the step of the record are too stiff for this explicit method. `Frame.solve`
    solves them one after the other, at a cost that does not depend on η/k. `rtol` is that of
    `dvax.solve`; the relative errors of the peaks are smaller.

    **Raises:** `dvax.InputError` if an argument is invalid for `Frame`; `dvax.SolveError` if a run
    failed, with the parameters of the frame.

    ```python
    >>> import numpy as np
    >>> from dvax.models import Accelerogram, response_spectrum
    >>> push = Accelerogram(0.1, 0.3 * np.sin(np.arange(31)))
    >>> spectrum = response_spectrum(push, [0.5, 0.7], 0.05, [[1.0], [0.5]], 0.01, chunk=4)
    >>> spectrum.peak.round(2).tolist()                         # yield ratios 1 and 0.5
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
                f"every entry must be {rule}", "Correct the entry",
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
            "the arguments must broadcast against each other", "Give each a separate axis",
        ) from error  # fmt: skip
    shape = T.shape
    run = _ChunkedRuns(record, rtol, chunk, workers)
    # The elastic frame is the same for every yield ratio.
    pairs, which = np.unique(np.stack([T.ravel(), z.ravel()]), axis=1, return_inverse=True)
    no_limit = np.full(pairs.shape[1], np.inf)
    elastic = run(pairs[0], pairs[1], no_limit, np.ones_like(no_limit))[which.ravel()]
    limit = ratio.ravel() * elastic
    rows = np.stack([T.ravel(), z.ravel(), limit, tau.ravel()])
    stiff = rows[3] < record.step / _MAX_STIFFNESS
    peak = np.empty(len(limit))
    if not stiff.all():
        peak[~stiff] = run(*rows[:, ~stiff])
    peak[stiff] = [_stiff_peak(record, rtol, *row) for row in rows[:, stiff].T]
    return Spectrum(peak.reshape(shape), elastic.reshape(shape), limit.reshape(shape))


_MAX_STIFFNESS = 200.0
"""Largest step of the record, in units of η/k, for `DormandPrince`. It needs steps of at most three η/k
(5 to 10 µs each) for stability; `PiecewiseLinear` costs 0.7 ms an interval of the record."""


def _stiff_peak(
    record: Accelerogram, rtol: float, period: float, damping: float, limit: float, tau: float
) -> float:
    """Return the peak of one frame, at a cost that does not depend on η/k."""
    frame = Frame(record=record, period=period, damping=damping, yield_displacement=limit,
                  viscosity_ratio=tau)  # fmt: skip
    return float(frame.largest_displacement(frame.solve(rtol=rtol, atol=1e-3 * rtol)))


class _ChunkedRuns:
    """A compiled program for the frames of a chunk."""

    def __init__(self, record: Accelerogram, rtol: float, chunk: int, workers: int | None):
        times = jnp.asarray(record.knots())

        def peak(period: Any, damping: Any, limit: Any, tau: Any) -> jax.Array:
            frame = Frame(record=record, period=period, damping=damping, yield_displacement=limit,
                          viscosity_ratio=tau)  # fmt: skip
            solution = solve(
                frame.problem, jnp.zeros(3), 0.0, record.duration, ts=times, rtol=rtol,
                atol=1e-3 * rtol, method=DormandPrince(), adjoint="forward",
            )  # fmt: skip
            d, v, _ = solution.xs.T
            a = jax.vmap(frame.acceleration)(solution.ts, solution.xs)
            # If the run failed, the remaining times are infinite and their states NaN.
            return peak_displacement(d, v, a, record.step)

        example = [jax.ShapeDtypeStruct((chunk,), times.dtype)] * 4
        self._program = jax.jit(jax.vmap(peak)).lower(*example).compile()
        self._chunk, self._workers = chunk, workers or os.cpu_count() or 1

    def __call__(self, *columns: np.ndarray) -> np.ndarray:
        """Return the peaks for vectors of periods, damping ratios, yield displacements and η/k."""
        count = len(columns[0])
        # Sort by period: frames of similar period need similar numbers of steps.
        order = np.argsort(columns[0], kind="stable")
        table = np.stack(columns)[:, order]
        padded = np.pad(table, ((0, 0), (0, -count % self._chunk)), mode="edge")
        parts = np.split(padded, padded.shape[1] // self._chunk, axis=1)
        with ThreadPoolExecutor(self._workers) as pool:
            chunks = list(pool.map(lambda part: np.asarray(self._program(*part)), parts))
        peaks = np.empty(count)
        peaks[order] = np.concatenate(chunks)[:count]
        if not np.all(np.isfinite(peaks)):
            k = int(np.flatnonzero(~np.isfinite(peaks))[0])
            T, z, limit, tau = (float(column[k]) for column in columns)
            raise SolveError(
                f"The frame with period {T:g} s, damping {z:g}, yield displacement {limit:g} in and "
                f"η/k = {tau:g} s did not reach the end of the record. Use dvax.models.Frame.solve for "
                "its error message."
            )
        return peaks
