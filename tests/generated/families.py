"""All families, by name."""

from .coupled import curved, full_matrix, oscillator, pair, scaled_control
from .dispatch import balanced, firms, sticky_price
from .family import ALL, Family
from .projected import projected

SOME = ("default", "ExpRosenbrock")
STIFF = ("ExpRosenbrock",)
HIGH = ("default", "ETD4RK", "DormandPrince")
FOURTH = ("ETD4RK", "DormandPrince")
WAVES = (20.0, 2000.0)


def _all() -> list[Family]:
    one = "Box of one"
    return [
        # Short contacts: K moves and touches what is asked for within a step.
        projected(one, "tent", feedback=False),
        projected(one, "vee", feedback=False),
        projected(one, "bump", generator="Scalar"),
        projected(one, "three tents"),
        projected(one, "few touches", feedback=False),
        projected(one, "gauss"),
        projected(one, "trapezoid", generator="Scalar"),
        projected("Box", "three bumps", generator="Dense"),
        projected("Box", "vee"),
        projected("many boxes", "tent", generator="Diagonal"),
        projected("Ball", "tent"),
        projected("Ball", "three bumps", generator="Dense"),
        projected("Ball that travels", "bump"),
        projected("Ellipsoid", "tent"),
        projected("Polyhedron", "tent", methods=SOME),
        projected("Simplex", "three tents"),
        projected("L1Ball", "bump"),
        projected("SecondOrderCone", "tent"),
        projected("HalfSpace", "three tents"),
        projected("Hyperplane", "bump"),
        projected("AffineSubspace", "tent"),
        projected("Intersection", "bump", methods=SOME),
        projected("Translated", "tent"),
        projected("Scaled", "bump"),
        # Pulses and jumps that nothing announces, in f, in h and in K.
        projected(one, f="pulse", feedback=False),
        projected(one, h="pulse", generator="Scalar"),
        projected("Box", f="three jumps"),
        projected("Box", h="three pulses", generator="Diagonal"),
        projected("Box", "jump", h="jump"),
        projected("Ball", h="pulse", f="jump"),
        projected("Ball", "pulse"),
        projected("HalfSpace", h="jump", generator="Dense"),
        projected("Simplex", "jump", h="trapezoid"),
        projected("SecondOrderCone", h="three jumps"),
        projected("Ellipsoid", h="pulse", methods=SOME),
        projected("L1Ball", f="pulse", h="jump"),
        projected("WholeSpace", f="pulse", h="three pulses"),
        projected(one, f="few squares", h="saw"),
        # Announced ones.
        projected(one, "announced tents", h="announced pulse"),
        projected("Box", f="announced jump", h="linear table"),
        projected("Ball", "linear table", h="announced pulse"),
        projected("Simplex", "constant table"),
        projected("HalfSpace", h="constant table", f="tent"),
        projected("Polyhedron", h="announced jump", methods=SOME),
        # Periodic data, often a whole number of periods.
        projected(one, f="waves", feedback=False, span=WAVES, methods=FOURTH, samples=40),
        projected(one, h="waves", generator="Scalar", span=WAVES, methods=FOURTH, samples=40),
        projected(one, "waves", span=WAVES, methods=FOURTH, samples=40),
        projected("Ball", h="waves", generator="Scalar", span=WAVES, methods=FOURTH, samples=40),
        projected(one, h="a hundred waves", generator="Scalar", span=WAVES, samples=40),
        projected("Box", "few waves", h="few waves"),
        projected(one, h="squares", generator="Scalar", samples=40),
        # Stiff and saturated laws.
        projected(one, gain=(1.0, 1e6), methods=STIFF),
        projected(one, "tent", gain=(1.0, 1e6), generator="Scalar", methods=STIFF),
        projected("Box", h="jump", gain=(1.0, 1e6), methods=STIFF),
        projected("Ball", "bump", gain=(1.0, 1e6), methods=STIFF),
        projected("many boxes", h="linear table", gain=(1.0, 1e6), methods=STIFF),
        projected(one, f="pulse", gain=(1.0, 1e3), methods=HIGH),
        projected("Box", "jump", gain=(1.0, 1e3), generator="Diagonal", methods=HIGH),
        projected("Ball", h="three tents", gain=(1.0, 1e3), methods=HIGH),
        # Other laws.
        full_matrix(2, "tent"),
        full_matrix(2, "jump", h="pulse"),
        full_matrix(4, "bump"),
        full_matrix(6, "tent", methods=SOME, samples=40),
        scaled_control("three tents"),
        scaled_control("nothing", "three jumps"),
        curved("tanh", "tent"),
        curved("weighted", "bump"),
        oscillator("tent"),
        oscillator("three bumps", "jump"),
        pair("tent", "pulse"),
        # Markets.
        sticky_price(6, 24, ALL, 40),
        sticky_price(24, 48, STIFF, 40),
        sticky_price(100, 168, STIFF, 6),
        firms(30, 3, 24, STIFF, 60),
        firms(102, 3, 48, STIFF, 12),
        balanced(20, 24, ("default",), 12),
    ]


FAMILIES: dict[str, Family] = {family.name: family for family in _all()}
