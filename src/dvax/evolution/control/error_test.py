"""The error test: the defect of a step in units of the tolerance."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from ..._tree import Tree
from ..law_tolerance import RootMeanSquares
from ..stepper import Step

_ROUNDINGS = 1e6
"""Roundings of f̃ up to which a defect counts as roundoff: a law with a small modulus γ amplifies
rounding by 1/γ."""

_LARGEST_ROUNDOFF = 1e-4
"""Share of f̃ above which no defect counts as roundoff, whatever t is."""

_INSIDE = 0.5
"""Largest error inside a step whose defect has mean zero, in h times the mean modulus."""


class Attempt(NamedTuple):
    """An attempted step, as the parts of the controller use it.

    - `size`: its length;
    - `smallest`: the smallest step size, eight roundings of t;
    - `error`: the largest defect divided by the tolerance (1 is the limit), signed where it cancels;
    - `modulus`: the same of the modulus of the defect, without the decay of earlier errors;
    - `unit`: the factor from the signed defect to `error`, which is 1 unless earlier errors decay;
    - `integrated`: the defect integrated over the step, in units of the tolerance of the whole run;
    - `roundoff`: the largest `error` that rounding of f̃ and of t can explain;
    - `finite`: no value is non-finite that a smaller step would leave so, and ‖x‖² does not overflow;
    - `usable`: finite, and the law was solved at its start.
    """

    size: Any
    smallest: Any
    error: Any
    modulus: Any
    unit: Any
    integrated: Any
    roundoff: Any
    finite: Any
    usable: Any

    def by_modulus(self, noisy: Any, horizon: Any) -> "Attempt":
        """Return the attempt as measured by the modulus where errors are `noisy`: roundoff cancels by
        chance in a signed mean, so that no step size would bring it below a tolerance for long. The
        decay of earlier errors is that of the step (`unit`)."""
        by_modulus = jnp.maximum(self.error, self.unit * self.modulus)
        error = jnp.where(noisy, by_modulus, self.error)
        integrated = jnp.where(noisy, self.modulus * self.size / horizon, self.integrated)
        return self._replace(error=error, integrated=integrated)


class ErrorTest(eqx.Module):
    """Compare the defect of a step with (atol + rtol‖x‖)/horizon.

    ‖·‖ is the root mean square in the state space, part by part where the state is a tuple, so that
    parts with different units are each compared with their own size. It is not taken entry by entry:
    that would ask for a smaller defect wherever an entry passes through zero.

    - `certify`: the defect counts by its modulus alone, as a certificate integrates it;
    - `knows_decay`: e is carried by the linear part of f̃ too, as a method that linearises does, and not
      by a difference quotient.
    """

    rtol: Any
    atol: Any
    horizon: Any
    sizes: RootMeanSquares
    certify: bool = eqx.field(static=True)
    knows_decay: bool = eqx.field(static=True)

    def attempt(self, t0: Any, t1: Any, x0: Tree, step: Step, span: Any) -> Attempt:
        """Measure a step from (t0, x0) to t1 in a run of this span."""
        h = t1 - t0
        eps, largest = jnp.finfo(h.dtype).eps, jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        # Step sizes are choices: under differentiation they are constants.
        modulus = lax.stop_gradient(self.horizon * self._ratio(step.error, x0, step.x1))
        error = modulus
        if step.signed is not None and not self.certify:
            error = lax.stop_gradient(self.horizon * self._ratio(step.signed, x0, step.x1))
        integrated = error * h / self.horizon
        # Data that varies within the run has the rounding of t besides, relative to the span.
        relative = eps * (1.0 + largest / span)
        rate = self.horizon * self._ratio(step.c[0], x0, step.x1)
        roundoff = jnp.minimum(_ROUNDINGS * relative, _LARGEST_ROUNDOFF) * rate
        unit = jnp.ones_like(error)
        if step.carried is not None:
            estimated = self._of_estimate(h, integrated, x0, step)
            unit = jnp.where(error > 0.0, estimated / jnp.where(error > 0.0, error, 1.0), 1.0)
            unit = jnp.where(jnp.isfinite(unit), unit, 1.0)
            error, roundoff = estimated, roundoff * unit
        # Inside the step the defect has not cancelled or decayed yet.
        error = jnp.maximum(error, _INSIDE * modulus * h / self.horizon)
        # A law that is not solved inside the step may be that of a stage far away: the step was too
        # large.
        error, modulus = (jnp.where(step.solved, v, jnp.inf) for v in (error, modulus))
        finite = step.finite & jnp.all(jnp.isfinite(jnp.stack(self.sizes(x0))))
        return Attempt(
            size=h,
            smallest=8 * eps * largest,
            error=error,
            modulus=modulus,
            unit=unit,
            integrated=jnp.where(step.solved, integrated, jnp.inf),
            roundoff=lax.stop_gradient(roundoff),
            finite=finite,
            usable=step.start_solved & finite,
        )

    def _of_estimate(self, h: Any, integrated: Any, x0: Tree, step: Step) -> Any:
        """Return the error of a step that is measured by the estimated error e of x.

        With |·| in tolerances, a step leaves l of e and adds d with |d| = `integrated`. It may add λd
        with |l + λd|² = max(|e|, |l|)² + h/horizon, where l and d count by the moduli of their entries:
        then |e|² stays below 1. That is

            1/λ = (p + √(p² + r|d|²))/r,   p = ⟨l, d⟩,   r = h/horizon + max(|e|² − |l|², 0).

        A larger |e| or |l| counts as 1: where a jump has left more, its decay must not be spent.

        Defects in different entries, as kinks in a field are, thus add up as their squares do.
        If the decay of e is known, |λd| = (1 − |l|/|e|)(1 − |e|) + h/horizon is allowed as well, which
        keeps |e| below 1 too.
        """
        assert step.carried is not None
        before, left = (self._ratio(e, x0, step.x1) for e in step.carried)
        scale = 1.0 / jnp.maximum(left, 1.0)
        before, left = jnp.minimum(before, 1.0), jnp.minimum(left, 1.0)
        added = step.error if step.signed is None else step.signed
        both = jtu.tree_map(lambda l, d: scale * jnp.abs(l) + h * d, step.carried[1], added)
        share = h / self.horizon
        p = 0.5 * (self._ratio(both, x0, step.x1) ** 2 - left**2 - integrated**2)
        p, r = jnp.maximum(p, 0.0), share + jnp.maximum(before**2 - left**2, 0.0)
        error = (p + jnp.sqrt(p**2 + r * integrated**2)) / r
        if self.knows_decay:
            decay = 1.0 - left / jnp.where(before > 0.0, before, 1.0)
            room = jnp.clip(decay, 0.0, 1.0) * jnp.maximum(1.0 - before, 0.0)
            error = jnp.minimum(error, integrated / (jnp.where(before > 0.0, room, 0.0) + share))
        return lax.stop_gradient(jnp.where(jnp.isnan(error), jnp.inf, error))

    def excursion(self, x0: Tree, step: Step) -> Any:
        """Return the size of what may lie between the samples of the defect, in units of what may
        stay unseen."""
        assert step.excursion is not None
        parts = zip(self.sizes(x0), self.sizes(step.x1), strict=True)
        least = jnp.min(jnp.stack([self.atol + self.rtol * jnp.maximum(*p) for p in parts]))
        return lax.stop_gradient(step.excursion(self.rtol, self.atol, least / self.horizon))

    def _ratio(self, error: Tree, before: Tree, after: Tree) -> Any:
        parts = zip(self.sizes(error), self.sizes(before), self.sizes(after), strict=True)
        ratios = [e / (self.atol + self.rtol * jnp.maximum(a, b)) for e, a, b in parts]
        ratio = jnp.max(jnp.stack(ratios)) if len(ratios) > 1 else ratios[0]
        # NaN must neither accept a step nor lengthen the next one.
        return jnp.where(jnp.isnan(ratio), jnp.inf, ratio)
