"""
A variational inequality by itself: two shops
=============================================

Two shops divide their weekly advertising between three towns. Each visitor goes to a shop with a
probability that grows with its advertising there; both pay for crowding. The equilibrium solves
VI(K, F) on a product of two simplices, without any differential equation. F is strongly monotone
and no gradient.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
value = jnp.array([3.0, 2.0, 1.5])


def F(y, budget):
    first, second = y
    # Costs of crowding: own advertising counts double; the shops react with opposite signs.
    return (2.0 * first + 1.5 * second - value, 2.0 * second - 1.5 * first - value[::-1])


def K(budget):
    return dvax.sets.Product(dvax.sets.Simplex(budget), dvax.sets.Simplex(1.0))


budgets = np.linspace(0.2, 2.0, 37)
space = dvax.spaces.Product(dvax.spaces.Euclidean(3), dvax.spaces.Euclidean(3))
start = (jnp.zeros(3), jnp.zeros(3))
solve = jax.jit(
    jax.vmap(lambda b: dvax.solve_vi(F, K(b), start, b, gamma=2.0, space=space, tol=1e-9))
)
found = solve(budgets)

# %%
# Where a curve leaves zero there is a kink: a town becomes worth its price.

figure, (left, right) = plt.subplots(1, 2, sharey=True)
for axes, y, title in ((left, found.y[0], "First shop"), (right, found.y[1], "Second shop")):
    for town in range(3):
        axes.plot(budgets, y[:, town], label=f"town {town + 1}")
    axes.set(xlabel="budget of the first shop", title=title)
left.set(ylabel="advertising")
left.legend()

# %%
# The certificate
# ---------------
#
# γ = 2 is the least eigenvalue of the symmetric part of the matrix of F: 2 I. Each solution has a
# bound on its distance to the exact one.

print("all solved:", bool((found.result == dvax.vi.RESULTS.successful).all()))
print(f"largest error bound: {float(found.error_bound.max()):.0e}")
