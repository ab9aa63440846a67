"""The results of a solve: success and the kinds of failure."""

import equinox as eqx


class RESULTS(eqx.Enumeration):
    """The result of a solve, described in a sentence."""

    successful = "The end time was reached."
    max_steps = "The largest number of steps was reached before t1."
    step_too_small = (
        "The step became too small to move t, or to lower its error, while the defect stayed above "
        "the tolerance."
    )
    picard_unconverged = (
        "Picard's sweeps did not converge on the shortest window, or the law was not solved there. "
        "Shorten dt, or use fewer nodes: dvax.Picard(nodes=16)."
    )
    implicit_unsolved = (
        "The equations of the shortest implicit step were not solved. f, h or K may be NaN or "
        "infinite there, or jump; else pass dvax.Implicit(solver) a solver with another root finder."
    )
    switching_unresolved = (
        "The constraints changed repeatedly at one time, and no mode is consistent after it. Check "
        "that the law is strongly pseudomonotone (dvax.verify), or use dvax.ExpRosenbrock()."
    )
    stiff = (
        "Stability limits the steps of the method, and not accuracy: dvax.ExpRosenbrock() may take "
        "longer ones."
    )
    nonfinite = "f, h or K returned NaN or infinity."
    law_unsolved = "The frozen law was not solved to its tolerance."
    invalid_number = (
        "A traced number breaks a rule: t0 < t1, no saved time before t0; dt, dt0, dt_max and horizon "
        "positive; rtol and atol not negative, and one of them positive."
    )
