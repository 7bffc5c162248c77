"""Draw the small pictures of the gallery: those of the examples, in the size of a card.

    python docs/cards.py [EXAMPLE ...]

Text is then as large as that of the page, which it would not be in the large pictures made small.
"""

import runpy
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib as mpl
from matplotlib.figure import Figure

DOCS = Path(__file__).parent
CARDS = DOCS / "images" / "cards"
SIZE = 4.4, 2.3  # inches
LARGER = {  # what has long labels, or many panels
    "drone_inertia": (5.2, 3.2),
    "identify_real_attitudes": (6.2, 3.2),
    "learned_torque": (6.2, 2.8),
    "plan_experiment": (6.2, 4.2),
    "powered_flight": (5.2, 4.4),
}
SMALL = {"font.size": 8, "lines.linewidth": 1, "lines.markersize": 3, "savefig.dpi": 200}


def draw(name: str) -> None:
    """Run an example that draws pictures, of which the last becomes its card."""
    save = Figure.savefig

    def save_small(figure: Figure, *_, **__) -> None:
        figure.set_size_inches(LARGER.get(name, SIZE))
        save(figure, CARDS / f"{name}.png")

    Figure.savefig = save_small
    mpl.rc_file(DOCS / "matplotlibrc")
    mpl.rcParams.update(SMALL)
    example = DOCS.parent / "examples" / f"{name}.py"
    option = "--plots" if '"--plots"' in example.read_text("utf-8") else "--plot"
    with TemporaryDirectory() as folder:
        where = Path(folder) / ("" if option == "--plots" else "picture.png")
        sys.argv = [example.name, option, str(where)]
        sys.path.insert(0, str(example.parent))
        runpy.run_path(str(example), run_name="__main__")


def main() -> None:
    names = sys.argv[1:] or sorted(
        file.stem
        for file in (DOCS.parent / "examples").glob("*.py")
        if '"--plot' in file.read_text("utf-8")
    )
    if len(names) == 1:
        draw(names[0])
        return
    for name in names:
        subprocess.run([sys.executable, __file__, name], check=True)


if __name__ == "__main__":
    main()
