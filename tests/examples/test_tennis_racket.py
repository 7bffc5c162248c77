"""The tennis-racket example runs and its invariants hold to rounding."""

import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "tennis_racket.py"


def test_the_flip_conserves_what_it_must(tmp_path):
    plot = tmp_path / "racket.png"
    command = [sys.executable, str(EXAMPLE), "--steps", "5000", "--plot", str(plot)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    flips = re.search(r"turned over (\d+) times", result.stdout)
    assert flips
    assert int(flips[1]) >= 3
    errors = [float(error) for error in re.findall(r"\d\.\de-\d+", result.stdout)]
    assert len(errors) == 3
    assert max(errors) < 1e-13
    assert plot.stat().st_size > 10_000
