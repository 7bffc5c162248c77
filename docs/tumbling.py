"""Draw the moving picture of the front page: a box that turns over, without an end.

    python docs/tumbling.py

It is a drawing (SVG) of faces that move and of a path whose pieces fade.
"""

from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.plotting.shapes import equivalent_box, faces_of
from lgvi.plotting.style import COLORS, GREY

jax.config.update("jax_enable_x64", True)

FILE = Path(__file__).parent / "images" / "tumbling.svg"
BODY = lgvi.RigidBody.from_principal_moments([1.0, 2.0, 2.8])  # kg m²
RATES = [0.2020486, 2.0, 0.0]  # rad/s; with this wobble the box comes back after two flips
LOOP = 13.516072  # s, of two flips
FRAMES, SECONDS = 160, 9  # of the picture
TRAIL = 0.25  # how long the path of a corner is seen, in loops
TURN, TILT = 0.6, 0.3  # of the view, rad
WIDTH, HEIGHT, EDGE = 480, 400, 330  # of the picture, and of the longest edge


def loop():
    """Attitudes at equal intervals, of which the last is the first again."""
    integrator = lgvi.MoserVeselovIntegrator(LOOP / FRAMES / 10, order=8)
    motion = integrator.simulate(BODY, jnp.eye(3), omega0=RATES, steps=10 * FRAMES)
    R = np.asarray(motion.R)[::10]
    assert np.allclose(R[-1], R[0], atol=1e-4)
    return R


def seen(points):
    """Points in space as right, up and towards the eye; the spin is about the vertical."""
    turn, tilt = (np.cos(TURN), np.sin(TURN)), (np.cos(TILT), np.sin(TILT))
    z, up, x = np.moveaxis(points, -1, 0)
    x, z = x * turn[0] - z * turn[1], x * turn[1] + z * turn[0]
    return np.stack([x, up * tilt[0] - z * tilt[1], up * tilt[1] + z * tilt[0]], axis=-1)


def on_page(points):
    """Coordinates of the picture, as SVG writes them."""
    xy = points[..., :2] * [EDGE, -EDGE] + [WIDTH / 2, HEIGHT / 2]
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)


def animate(attribute, values, more=""):
    return (
        f'<animate attributeName="{attribute}" values="{";".join(values)}" dur="{SECONDS}s" '
        f'repeatCount="indefinite"{more}/>'
    )


def face(corners, color):
    """A face, which is shown while its front is to the eye."""
    a, b, c = np.moveaxis(corners[:, :3], 1, 0)
    front = np.cross(b - a, c - b)[:, 2] * np.sum(np.cross(b - a, c - b) * a, axis=1) > 0
    shown = animate("visibility", np.where(front, "visible", "hidden"), ' calcMode="discrete"')
    points = animate("points", map(on_page, corners))
    return f'<polygon fill="{color}">{points}{shown}</polygon>'


def trail(path):
    """The pieces of a path that are behind the box, and those before it; each fades."""
    pieces = [], []
    for k, ends in enumerate(pairwise(path)):
        begin = SECONDS * ((k + 1) / FRAMES - 1)
        fade = animate("opacity", "100", f' keyTimes="0;{TRAIL};1" begin="{begin:.3f}s"')
        line = f'<polyline points="{on_page(np.array(ends))}" opacity="0">{fade}</polyline>'
        pieces[int(ends[0][2] + ends[1][2] > 0)].append(line)
    return ["".join(lines) for lines in pieces]


def main() -> None:
    R = loop()
    lengths, axes = equivalent_box(BODY)
    corners = seen(np.einsum("tij,fcj->ftci", R @ axes, faces_of(lengths)))
    faces = [face(*each) for each in zip(corners, np.repeat(COLORS[:3], 2), strict=True)]
    behind, before = trail(seen(R @ axes @ (lengths / 2)))
    line = f'<g fill="none" stroke="{COLORS[1]}" stroke-width="3">'
    FILE.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">'
        f"<title>A box that turns over</title>{line}{behind}</g>"
        f'<g stroke="{GREY}" stroke-width="2" stroke-linejoin="round">{"".join(faces)}</g>'
        f"{line}{before}</g></svg>\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
