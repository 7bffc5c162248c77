"""Pictures of estimates, bodies and motions. The only part of the package that needs Matplotlib.

Each function draws in the axes that are given as `ax`, or in a new figure, and returns the figure.
Colours are told apart by colour-blind readers, and ink is that of Matplotlib's style, so that
`plt.style.use("dark_background")` makes dark pictures.
"""

from .animation import animate as animate
from .expected_errors import plot_identifiability as plot_identifiability
from .log import plot_log as plot_log
from .moments import plot_moments as plot_moments
from .plan import plot_plan as plot_plan
from .polhode import plot_invariants as plot_invariants
from .polhode import plot_polhode as plot_polhode
from .polhode import plot_snapshots as plot_snapshots
from .posterior import plot_posterior as plot_posterior
from .readings import plot_fit as plot_fit
from .readings import plot_residuals as plot_residuals
from .shapes import plot_body as plot_body
