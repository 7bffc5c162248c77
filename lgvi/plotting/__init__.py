"""Pictures of estimates, bodies and motions. The only part of the package that needs Matplotlib.

Each function draws in the axes that are given as `ax`, or in a new figure, and returns the figure.
Colours are told apart by colour-blind readers, and ink is that of Matplotlib's style, so that
`plt.style.use("dark_background")` makes dark pictures.
"""

from .animation import animate
from .body import plot_body
from .fit import plot_fit, plot_residuals
from .identifiability import plot_identifiability
from .moments import plot_moments
from .motion import plot_invariants, plot_polhode, plot_snapshots

__all__ = [
    "animate",
    "plot_body",
    "plot_fit",
    "plot_identifiability",
    "plot_invariants",
    "plot_moments",
    "plot_polhode",
    "plot_residuals",
    "plot_snapshots",
]
