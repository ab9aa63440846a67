"""Pictures of a market: prices and production."""

from collections.abc import Mapping

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Price and production over the hours."""
    hours = data["hour"].values
    prices = [Curve(hours, data["price"].values, "at rest (Cournot–Nash)", 0)]
    if "sticky_price" in data:
        sticky = data["sticky_price"].values
        prices.append(Curve(hours, sticky, "sticky", 1, "dash"))
    made = data["made"].values
    firms = [Curve(hours, made[:, k], f"area {k + 1}", 2 + k) for k in range(made.shape[1])]
    panels = [
        Panel(prices, "price", data["price"].unit),
        Panel(firms, "made by the firm of", data["made"].unit),
    ]
    if "sticky_price" in data:
        lag = Curve(hours, data["sticky_price"].values - data["price"].values, "lag", None)
        panels.append(Panel([lag], "sticky − at rest", data["price"].unit, share=0.6))
    return [
        panels_picture(
            "market",
            "Price and production",
            "At rest no firm gains by making another amount. The sticky price follows demand at a "
            "finite rate and is behind where load or wind move fast.",
            panels,
            "hour of the data",
            "h",
        )
    ]
