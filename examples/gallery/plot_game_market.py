"""
A price game: three firms, one price
====================================

Three firms sell electricity into one market. Each knows that it lowers the price when it sells
more, and has a limited capacity, which for the wind farm varies over the day. At every price the
productions are a Nash equilibrium; the price follows the demand with a delay.
`dvax.models.Market` states the law; units are hours, MW and $/MWh.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models import Market

jax.config.update("jax_enable_x64", True)
names = ["coal", "gas", "wind"]
market = Market(
    cost=[20.0, 35.0, 0.0],
    slope=[0.05, 0.08, 0.01],
    firm=[0, 1, 2],
    b=0.05,
    speed=2.0,
    intercept=lambda t: 90.0 + 25.0 * jnp.sin(2 * jnp.pi * (t - 8.0) / 24.0),
    capacity=lambda t: jnp.stack([300.0, 400.0, 250.0 + 200.0 * jnp.cos(2 * jnp.pi * t / 24.0)]),
)
sol = market.run(0.0, 48.0)

# %%

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(sol.ts, sol.xs)
top.set(ylabel="price [$/MWh]", title="A price game of three firms")
bottom.stackplot(sol.ts, sol.us.T, labels=names, colors=["C7", "C1", "C2"])
bottom.set(xlabel="time t [h]", ylabel="production [MW]")
bottom.legend(loc="upper left", ncols=3)

# %%
# The certificate
# ---------------
#
# Besides the bound on the error there is an economic one: no firm gains by another production.

bound = dvax.bound_error(market.problem, sol, market.constants)
figures = market.figures(sol)
print(f"constants: {market.constants.status_of('gamma', 'L_F')}")
print(f"error of the price: at most {float(np.max(bound.x)):.0e} $/MWh ({bound.status})")
print("no firm gains more than a cent an hour:", figures["max_deviation_profit"] < 0.01)
