"""VI(K, My + q) in rational arithmetic: active sets, linear systems, optimality conditions."""

import itertools
import math
from decimal import Decimal, localcontext
from fractions import Fraction
from random import Random


class Undecided(Exception):
    """The search for the active set did not terminate."""


def rational(array):
    """A float array as nested lists of the rationals that its entries are."""
    return [rational(row) for row in array] if array.ndim else Fraction(float(array))


def solve(A, b):
    """x with Ax = b, or None where A is singular: Bareiss' elimination in integers."""
    n = len(b)
    if n == 0:
        return []
    rows = [[*row, right] for row, right in zip(A, b, strict=True)]
    rows = [[int(v * math.lcm(*(w.denominator for w in row))) for v in row] for row in rows]
    last = 1
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k]), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        top, at = rows[k], rows[k][k]
        for i in range(k + 1, n):
            row, by = rows[i], rows[i][k]
            rows[i] = [0 if j <= k else (row[j] * at - by * top[j]) // last for j in range(n + 1)]
        last = at
    x = [Fraction(0)] * n
    for i in reversed(range(n)):
        rest = rows[i][n] - sum(rows[i][j] * x[j] for j in range(i + 1, n))
        x[i] = Fraction(rest) / rows[i][i]
    return x


def times(M, y):
    return [sum(a * b for a, b in zip(row, y, strict=True)) for row in M]


def box(M, q, lower, upper, guess):
    """The guess solves the problem of q + r for some r. From there q + λr is followed from λ = 1 to 0:
    the solution is piecewise linear in λ, and for a P-matrix one index at a time changes its place
    (parametric principal pivoting). r is random where it may be, so that no two change together."""
    n, random = len(q), Random(0)
    bounds = list(zip(lower, upper, strict=True))
    place = [-1 if v <= a else 1 if v >= b else 0 for v, (a, b) in zip(guess, bounds, strict=True)]

    def at_places(values):
        return [(a, v, b)[p + 1] for v, (a, b), p in zip(values, bounds, place, strict=True)]

    F = [a + b for a, b in zip(times(M, at_places(guess)), q, strict=True)]
    r = [-v - p * Fraction(random.randint(1, 10**6), 10**6) for p, v in zip(place, F, strict=True)]

    def solution(y, q):
        """y and My + q, where y is as given at the bounds and My + q = 0 elsewhere."""
        free = [i for i in range(n) if place[i] == 0]
        held = [i for i in range(n) if place[i] != 0]
        right = [-q[i] - sum(M[i][j] * y[j] for j in held) for i in free]
        for i, v in zip(free, solve([[M[i][j] for j in free] for i in free], right), strict=True):
            y[i] = v
        return y, [a + b for a, b in zip(times(M, y), q, strict=True)]

    parameter = Fraction(1)
    while True:
        y, F = solution(at_places([0] * n), q)
        dy, dF = solution([0] * n, r)
        changes = [(Fraction(0), n, 0)]  # the next λ, the index that changes there, its new place
        for i, (a, b) in enumerate(bounds):
            if place[i] == 0 and dy[i] != 0:
                end, new = (a, -1) if dy[i] > 0 else (b, 1)
                changes.append(((end - y[i]) / dy[i], i, new))
            elif a < b and place[i] * dF[i] < 0:
                changes.append((-F[i] / dF[i], i, 0))
        parameter, i, new = max(change for change in changes if change[0] < parameter)
        if i == n:
            return y
        place[i] = new


def polyhedron(M, q, G, d, E, e, guess):
    """{Gy ≤ d, Ey = e}: sets of active rows, those nearest to the one of the guess first."""
    n, m = len(q), len(d)
    slack = [di - gi for di, gi in zip(d, times(G, guess), strict=True)]
    active = {i for i in range(m) if slack[i] <= Fraction(1, 10**7)}
    sets = [set(c) for k in range(min(m, n) + 1) for c in itertools.combinations(range(m), k)]
    for J in sorted(sets, key=lambda J: len(J ^ active)):
        rows = [G[i] for i in sorted(J)] + E
        size = n + len(rows)
        A = [[*M[i], *(row[i] for row in rows)] for i in range(n)]
        A += [[*row, *([Fraction(0)] * len(rows))] for row in rows]
        x = solve(A, [-v for v in q] + [d[i] for i in sorted(J)] + e)
        if x is None or len(x) != size:
            continue
        y, multipliers = x[:n], x[n : n + len(J)]
        inside = all(a <= b for a, b in zip(times(G, y), d, strict=True))
        if inside and all(v >= 0 for v in multipliers):
            return y
    raise Undecided("no active set")


def ball(M, q, radius, guess):
    """‖y‖ ≤ r: (M + μ)y = −q with μ ≥ 0 and ‖y‖ = r, or μ = 0; μ by bisection to fifty digits."""
    n = len(q)
    with localcontext() as context:
        context.prec = 60
        number = lambda v: Decimal(v.numerator) / Decimal(v.denominator)  # noqa: E731

        def at(mu):
            rows = [
                [number(v) + (mu if i == j else 0) for j, v in enumerate(M[i])] for i in range(n)
            ]
            return _decimal_solve(rows, [-number(v) for v in q])

        size = lambda y: sum(v * v for v in y).sqrt()  # noqa: E731
        free = at(Decimal(0))
        if size(free) <= number(radius):
            return [Fraction(v) for v in free]
        low, high = Decimal(0), Decimal(1)
        while size(at(high)) > number(radius):
            low, high = high, 4 * high
        for _ in range(200):
            middle = (low + high) / 2
            low, high = (middle, high) if size(at(middle)) > number(radius) else (low, middle)
        return [Fraction(v) for v in at(high)]


def _decimal_solve(rows, right):
    n = len(right)
    rows = [[*row, b] for row, b in zip(rows, right, strict=True)]
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(k + 1, n):
            by = rows[i][k] / rows[k][k]
            rows[i] = [a - by * b for a, b in zip(rows[i], rows[k], strict=True)]
    x = [Decimal(0)] * n
    for i in reversed(range(n)):
        rest = rows[i][n] - sum(rows[i][j] * x[j] for j in range(i + 1, n))
        x[i] = rest / rows[i][i]
    return x


def distance(y, exact):
    """‖y − y*‖ of a float array, correctly rounded up to an ulp or two."""
    return math.sqrt(sum((a - b) ** 2 for a, b in zip(rational(y), exact, strict=True)))
