"""The worked problems give what theory says."""

import importlib
import re

import asteroid
import chaos
import cubesat
import detumble
import flat_spin
import gravity_gradient
import heavy_top
import numpy as np
import pytest

from .pages import GALLERY, PRINTED, assert_page_shows

# Their own tests run them as their pages do, and look at these.
LOOKED_AT = (
    *("chaos", "drone_inertia", "learned_torque", "plan_experiment", "powered_flight"),
    "weigh_by_flywheel",
)
NUMBER = r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?"


def numbers(pattern, text):
    """The numbers in a printed line, where the pattern has `#`."""
    found = re.search(pattern.replace("#", f"({NUMBER})"), text)
    assert found, text
    return [float(number) for number in found.groups()]


@pytest.mark.slow
def test_a_fast_top_sleeps_and_a_slow_one_falls(output, tmp_path):
    text = output(heavy_top, "--plot", tmp_path / "top.png")
    least, most = numbers("sleeping .* leans by # to # degrees", text)
    assert 0.5 < least < most < 1
    least, most = numbers("nutating .* leans by # to # degrees", text)
    assert least == pytest.approx(np.degrees(0.5), abs=0.1)
    _, most = numbers("falling .* leans by # to # degrees", text)
    assert most > 60
    assert max(map(float, re.findall(rf"changes by ({NUMBER})", text))) < 1e-10
    assert (tmp_path / "top.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_satellite_librates_as_fast_as_theory_says(output, tmp_path):
    text = output(gravity_gradient, "--plot", tmp_path / "satellite.png")
    seen, expected = numbers("orbit: #; of small ones, by theory: #", text)
    assert seen == pytest.approx(expected, rel=1e-3)
    first, last = numbers("reaches # rad in the first orbits, and # in the last", text)
    assert last == pytest.approx(first, rel=1e-3)


@pytest.mark.slow
def test_a_satellite_in_thin_air_swings_as_fast_as_theory_says(output, tmp_path):
    text = output(cubesat, "--plot", tmp_path / "cubesat.png")
    seen, expected = numbers("swings: # rad/s; by theory: #", text)
    assert seen == pytest.approx(expected, rel=1e-3)
    most, less = numbers("up to #, with a fifth of the dipole # degrees", text)
    assert 0 < less < most < 90


@pytest.mark.slow
def test_a_long_satellite_ends_in_a_flat_spin(output, tmp_path):
    text = output(flat_spin, "--plot", tmp_path / "flat_spin.png")
    assert numbers("space changes by # of it", text)[0] < 1e-12
    assert numbers("energy rises in # of", text)[0] == 0
    end, least = numbers("at the end: # J; the least for this momentum: # J", text)
    assert least < end < 1.1 * least


def test_wheels_take_up_all_momentum(output, tmp_path):
    text = output(detumble, "--plot", tmp_path / "detumble.png")
    before, after = numbers("rates: # rad/s at the start, # after", text)
    assert after < 1e-5 * before
    wheels, total = numbers("wheels: # kg m²/s at the end, of # in all", text)
    assert wheels == pytest.approx(total, rel=1e-3)
    assert numbers("in space changes by # of it", text)[0] < 1e-13


@pytest.mark.slow
def test_an_asteroid_keeps_energy_and_momentum(output, tmp_path):
    text = output(asteroid, "--turns", 5000, "--plot", tmp_path / "asteroid.png")
    assert "5000 turns, 100000 steps" in text
    assert max(map(float, re.findall(rf": +({NUMBER})$", text, re.MULTILINE))) < 1e-12


@pytest.mark.slow
def test_motions_part_exponentially(output, tmp_path):
    text = output(chaos, "--plot", tmp_path / "chaos.png")
    assert_page_shows("chaos", text)
    time_of_parting, orbits = (
        numbers("factor of e in # orbits", text)[0],
        numbers("apart after # orbits", text)[0],
    )
    # From 1e-9 to 0.1 rad in so many Lyapunov times.
    assert orbits / time_of_parting == pytest.approx(np.log(1e8), rel=0.25)
    one, many = numbers("moment: # rad after one orbit, # after", text)
    assert many > 1e6 * one


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name, blocks in PRINTED.items() if blocks and name not in LOOKED_AT]
)
def test_a_page_shows_what_its_example_prints(name, output):
    assert_page_shows(name, output(importlib.import_module(name)))


def test_every_example_has_a_page():
    examples = {file.stem for file in (GALLERY.parents[1] / "examples").glob("*.py")}
    assert examples == set(PRINTED) - {"index"}
