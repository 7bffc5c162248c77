"""Free flights are found, without a sample of contact, in logs made by SciPy."""

import pickle
import subprocess
import sys
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from lgvi.logs import Log
from lgvi.logs.free_flights import FreeFlight, find_free_flights, read_intervals
from lgvi.logs.signal import LogError, Signal
from lgvi.plotting.log import plot_log

G = 9.80665
RATE = 2000.0  # Hz, of the motion that the sensors sample
UP = np.array([0, 0, 1.0])


class Story:
    """Force of contact by mass (in space), and angular velocity (in the body), bit by bit."""

    def __init__(self, seed, moments=(1.0, 1.6, 2.1)):
        self.random = np.random.default_rng(seed)
        axes = Rotation.from_rotvec(self.random.normal(size=3)).as_matrix()
        self.J = axes @ np.diag(moments) @ axes.T
        self.omega, self.force, self.flights = np.zeros((1, 3)), G * UP[None], []
        self.speed = np.zeros(3)

    def direction(self):
        vector = self.random.normal(size=3)
        return vector / np.linalg.norm(vector)

    def add(self, omega, force):
        self.omega = np.concatenate([self.omega, omega])
        self.force = np.concatenate([self.force, np.broadcast_to(force, omega.shape)])

    def waves(self, t, size, low, high):
        random = self.random
        return sum(
            size
            * random.normal(size=3)
            * np.sin(2 * np.pi * random.uniform(low, high) * t + random.uniform(0, 6, 3))
            for _ in range(4)
        )

    def hold(self, duration, shaking=0.2, turning=0.1, low=6, high=13):
        t = times(duration)
        still = 1 - np.exp(-t / 0.05)
        omega = (1 - still) * self.omega[-1] + still * self.waves(t, turning, low, high)
        self.add(omega, G * UP + still * self.waves(t, shaking, low, high))

    def run(self, duration, swing=1.0):
        t = times(duration)
        force = np.maximum(0, 2.6 * np.sin(2 * np.pi * 2.7 * t)) * G * UP
        self.add(self.waves(t, 1.5 * swing, 1, 4), force + self.waves(t, swing, 1, 5))

    def spin_on_table(self, duration):
        up = self.attitudes()[-1].T @ UP
        t = times(duration)
        self.add(self.random.uniform(8, 20) * (1 - np.exp(-t / 0.05)) * np.exp(-t) * up, G * UP)

    def throw(self, spin):
        random = self.random
        t = times(random.uniform(0.1, 0.25))
        u = t / t[-1]
        push = random.uniform(1.5, 4) * G * np.sin(np.pi * u) ** random.choice([0.5, 1.0, 1.5])
        tilted = UP + 0.4 * random.normal(size=3)
        force = np.maximum(1 - 2 * u, 0) * G * UP + push * tilted / np.linalg.norm(tilted)
        self.add((1 - u) * self.omega[-1] + u * spin * self.direction(), force)
        self.speed = 3 * UP

    def let_go(self, duration=0.015):
        t = times(duration)
        self.add(np.tile(self.omega[-1], (len(t), 1)), (1 - t / t[-1]) * G * UP)
        self.speed = np.zeros(3)

    def fly(self, duration, drag=0.01):
        t = times(duration)[:, 0]

        def derivative(_, state):
            w, v = np.split(state, 2)
            torque_free = np.linalg.solve(self.J, np.cross(self.J @ w, w))
            return np.concatenate([torque_free, -G * UP - drag * np.linalg.norm(v) * v])

        start = np.concatenate([self.omega[-1], self.speed])
        motion = solve_ivp(
            derivative, (0, t[-1]), start, method="DOP853", t_eval=t, rtol=1e-9, atol=1e-9
        )
        w, v = np.split(motion.y.T, 2, axis=1)
        begin = len(self.omega) / RATE
        self.flights.append((begin, begin + duration))
        self.add(w, -drag * np.linalg.norm(v, axis=1, keepdims=True) * v)
        self.speed = v[-1]

    def catch(self):
        random, t = self.random, times(0.4)
        ringing = np.exp(-t / 0.04) * np.cos(2 * np.pi * random.uniform(15, 60) * t) ** 2
        hit = random.uniform(3, 10) * G * np.minimum(t / 0.003, 1) * ringing * self.direction()
        self.add(np.exp(-t / 0.03) * self.omega[-1], hit + (1 - np.exp(-t / 0.06)) * G * UP)

    def bounce(self, contact):
        t = times(contact)
        u = t / t[-1]
        peak = (np.linalg.norm(self.speed) + 1.6) / contact * np.pi / 2
        after = 0.5 * self.omega[-1] + 4 * self.direction()
        self.add((1 - u) * self.omega[-1] + u * after, peak * np.sin(np.pi * u) * UP)
        self.speed = 1.6 * UP

    def attitudes(self):
        """Products of all rotations before, by doubling."""
        R = Rotation.from_rotvec(self.omega / RATE).as_matrix()
        shift = 1
        while shift < len(R):
            R = np.concatenate([R[:shift], R[:-shift] @ R[shift:]])
            shift *= 2
        return R

    def log(self, place, rate=200.0, gyro=0.005, force=0.05, limits=(34.9, 78.5)):
        """What a phone records: noise, bias, errors of scale, rounding, limits."""
        omega, random = self.omega, self.random
        alpha = np.gradient(omega, 1 / RATE, axis=0)
        felt = np.einsum("nji,nj->ni", self.attitudes(), self.force)
        felt += np.cross(alpha, place) + np.cross(omega, np.cross(omega, place))
        fine = np.arange(len(omega)) / RATE
        t = np.arange(0.01, fine[-1], 1 / rate)
        t += 0.02 / rate * random.normal(size=len(t))
        signals = {}
        for name, unit, values, noise, step, bias, limit in (
            ("gyro", "rad/s", omega, gyro, 0.001, 0.02, limits[0]),
            ("acc", "m/s²", felt, force, 0.0024, 0.1, limits[1]),
        ):
            sampled = np.column_stack([np.interp(t, fine, column) for column in values.T])
            sampled *= 1 + 0.01 * random.normal(size=3)
            sampled += bias * random.normal(size=3) + noise * random.normal(size=sampled.shape)
            sampled = np.clip(np.round(sampled / step) * step, -limit, limit)
            quantity = "angular_velocity" if name == "gyro" else "specific_force"
            signals[name] = Signal(name, t, sampled, unit, quantity=quantity, limit=limit)
        return Log("thrown.csv", "made", signals)


def times(duration):
    return np.arange(1, round(duration * RATE) + 1)[:, None] / RATE


def require_right(flights, truth, shortest=0.3):
    """Each flight that is long enough is covered by 80 %, and no contact is in any."""
    for flight in flights:
        assert any(a <= flight.begin and flight.end <= b for a, b in truth), (flight, truth)
    for a, b in truth:
        covered = sum(max(0, min(f.end, b) - max(f.begin, a)) for f in flights)
        assert b - a < shortest or covered >= 0.8 * (b - a), (a, b, flights)


def thrown(seed, spin=10.0, duration=0.7):
    story = Story(seed)
    story.hold(1.0)
    story.throw(spin)
    story.fly(duration)
    story.catch()
    story.hold(0.5)
    return story


PLACE = np.array([0.03, -0.02, 0.05])


@pytest.mark.parametrize("seed", range(12))
def test_flights_are_found_in_random_logs_without_a_sample_of_contact(seed):
    story = Story(seed)
    random = story.random
    story.hold(0.7)
    for what in random.permutation(["throw", "throw", "drop", "bounce", "run", "table", "shake"]):
        if what == "throw":
            story.throw(random.uniform(2, 25))
            story.fly(random.uniform(0.3, 1.0))
            story.catch()
        elif what == "drop":
            story.let_go()
            story.fly(random.uniform(0.3, 0.5))
            story.catch()
        elif what == "bounce":
            story.throw(random.uniform(2, 20))
            story.fly(random.uniform(0.3, 0.6))
            for _ in range(2):
                story.bounce(random.uniform(0.03, 0.1))
                story.fly(random.uniform(0.2, 0.4))
            story.catch()
        elif what == "run":
            story.run(2.0)
        elif what == "table":
            story.spin_on_table(1.0)
        else:
            story.hold(1.5, shaking=8.0, turning=5.0, low=2, high=5)
        story.hold(0.4)
    place = random.uniform(0, 0.08) * story.direction()
    log = story.log(place, rate=random.choice([100.0, 200.0, 500.0]))
    require_right(find_free_flights(log), story.flights, shortest=0.35)


@pytest.mark.parametrize("rate", [100.0, 500.0])
def test_the_centripetal_term_is_no_contact(rate):
    """At 25 rad/s and 6 cm the accelerometer reads 4 g, more than a hand gives."""
    story = thrown(0, spin=25.0)
    log = story.log(PLACE, rate)
    t, f = log.signals["acc"].times, log.signals["acc"].values
    a, b = story.flights[0]
    assert np.linalg.norm(f[(t > a) & (t < b)], axis=1).max() > 3 * G
    (flight,) = find_free_flights(log)
    require_right([flight], story.flights)
    assert "accelerometer 6." in flight.words


@pytest.mark.parametrize("seed", range(3))
def test_a_soft_release_is_seen_although_the_spin_is_felt_as_4_g(seed):
    story = Story(seed, moments=(1.0, 1.0, 1.0))
    story.hold(0.5)
    story.throw(25.0)
    story.add(np.tile(story.omega[-1], (300, 1)), G * UP)
    story.let_go(0.05)
    story.fly(0.5)
    story.catch()
    flights = find_free_flights(story.log(PLACE))
    assert len(flights) == 1
    require_right(flights, story.flights)


@pytest.mark.parametrize("contact", [0.004, 0.03])
def test_a_bounce_ends_a_flight_even_at_the_centre_of_mass(contact):
    for seed in range(4):
        story = Story(seed)
        story.hold(0.5)
        story.throw(5.0)
        for _ in range(3):
            story.fly(0.4)
            story.bounce(contact)
        story.fly(0.4)
        story.catch()
        flights = find_free_flights(story.log(np.zeros(3)))
        assert len(flights) == 4
        require_right(flights, story.flights)


def test_a_wheel_with_a_horizontal_axis_does_not_fly():
    """Its weight turns, as seen from the wheel, around what the spin explains."""
    for seed in range(10):
        story = Story(seed)
        t = times(6.0)
        speed = story.random.uniform(3, 25) * (1 + 0.2 * np.sin(3 * t))
        story.add((1 - np.exp(-t)) * speed * story.direction(), G * UP)
        assert not find_free_flights(story.log(0.2 * story.direction()))


@pytest.mark.parametrize("swing", [0.35, 1.0])
def test_a_runner_does_not_fly(swing):
    """Between steps the legs move what they carry."""
    for seed in range(5):
        story = Story(seed)
        story.run(6.0, swing)
        assert not find_free_flights(story.log(PLACE))


def test_units_names_and_axes_do_not_matter():
    story = thrown(1)
    log = story.log(PLACE)
    gyro, acc = log.signals["gyro"], log.signals["acc"]
    expected = find_free_flights(log)
    assert len(expected) == 1
    to_frd = np.diag([1.0, -1, -1])
    other = {
        "w": replace(gyro, name="w", unit="deg/s", values=np.degrees(gyro.values), quantity=""),
        "f": replace(acc, unit="g", values=acc.values @ to_frd / G, frame="FRD", quantity=""),
    }
    other["w"] = replace(other["w"], frame="FLU", limit=np.nan)
    other["f"] = replace(other["f"], limit=np.nan)
    renamed = replace(log, signals=other)
    found = find_free_flights(renamed, specific_force="f", angular_velocity="w")
    np.testing.assert_allclose([f[1:] for f in found], [f[1:] for f in expected], atol=0.011)
    told = {"w": replace(other["w"], unit=""), "f": other["f"]}
    again = find_free_flights(
        replace(log, signals=told),
        specific_force="f",
        angular_velocity="w",
        units={"angular_velocity": "deg/s"},
    )
    assert again == found
    columns = {
        f"a{i}": replace(acc, name=f"a{i}", values=acc.values[:, i], quantity="") for i in range(3)
    }
    split = replace(log, signals={"gyro": gyro, **columns})
    assert find_free_flights(split, specific_force=list(columns)) == expected


def test_the_gyroscope_with_the_clock_of_the_accelerometer_is_taken():
    log = thrown(1).log(PLACE)
    late = log.signals["gyro"].times + 7.0
    other = replace(log.signals["gyro"], name="other", times=late, clock="other")
    assert find_free_flights(replace(log, signals={"other": other, **log.signals})) == (
        find_free_flights(log)
    )


@pytest.mark.parametrize("is_known", [True, False])
def test_samples_at_the_limit_are_in_no_flight(is_known):
    """A constant spin is one still when it is cut off."""
    story = Story(2, moments=(1.0, 1.0, 1.0))
    story.hold(1.0)
    story.throw(20.0)
    story.fly(0.5)
    story.catch()
    assert len(find_free_flights(story.log(np.zeros(3)))) == 1
    log = story.log(np.zeros(3), limits=(10.0, 78.5))
    if not is_known:
        gyro = replace(log.signals["gyro"], limit=np.nan)
        log = replace(log, signals={**log.signals, "gyro": gyro})
    assert not find_free_flights(log)


def test_gaps_are_in_no_flight():
    log = thrown(2).log(PLACE)
    a, b = thrown(2).flights[0]
    for name in ("gyro", "acc"):
        signal = log.signals[name]
        kept = abs(signal.times - (a + b) / 2) > 0.03
        missing = replace(signal, times=signal.times[kept], values=signal.values[kept])
        parts = find_free_flights(replace(log, signals={**log.signals, name: missing}))
        assert [flight.name for flight in parts] == ["1", "2"]
        assert parts[0].end < (a + b) / 2 - 0.03 < (a + b) / 2 + 0.03 < parts[1].begin


def test_times_that_repeat_or_go_back_do_not_matter():
    story = thrown(3)
    log, signals = story.log(PLACE), {}
    begin = int(story.flights[0][0] * 200) + 20
    for name, signal in log.signals.items():
        order = np.sort(np.concatenate([np.arange(len(signal)), [40, 41, begin]]))
        order[begin : begin + 12] = order[begin : begin + 12][::-1]
        signals[name] = replace(signal, times=signal.times[order], values=signal.values[order])
    assert find_free_flights(replace(log, signals=signals)) == find_free_flights(log)


def test_samples_without_a_number_do_no_harm():
    story = thrown(3)
    log, random = story.log(PLACE), np.random.default_rng(3)
    for signal in log.signals.values():
        signal.values[random.random(len(signal)) < 0.02] = np.nan
    require_right(find_free_flights(log), story.flights)


def test_a_sensor_that_is_stuck_does_not_fly():
    """Zeros, before a sensor starts or for all the log, look like a fall without spin."""
    story = thrown(4)
    log = story.log(PLACE)
    for signal in log.signals.values():
        signal.values[:120] = 0
    require_right(find_free_flights(log), story.flights)
    for signal in log.signals.values():
        signal.values[:] = 0
    assert not find_free_flights(log)


def test_without_a_gyroscope_one_metre_per_square_second_is_no_mistake_of_the_unit():
    story = thrown(0, spin=4.5)
    log = story.log(np.array([0.03, 0.03, 0.03]))
    find_free_flights(replace(log, signals={"acc": log.signals["acc"]}))


def test_without_a_gyroscope_drops_are_found_and_runners_do_not_fly():
    story = Story(5)
    story.hold(0.5)
    story.run(4.0)
    story.hold(0.5)
    story.let_go()
    story.fly(0.5)
    story.catch()
    log = story.log(np.array([0.02, 0, 0]))
    (flight,) = find_free_flights(replace(log, signals={"acc": log.signals["acc"]}))
    require_right([flight], story.flights)
    assert "no gyroscope" in flight.words


def test_least_margin_and_reach_mean_what_they_say():
    log = thrown(6, duration=0.5).log(PLACE)
    (flight,) = find_free_flights(log)
    (narrow,) = find_free_flights(log, margin=0.05)
    np.testing.assert_allclose([narrow.begin - flight.begin, flight.end - narrow.end], 0.04)
    assert not find_free_flights(log, least=0.5)
    assert not find_free_flights(log, reach=0.05)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"least": 0.0}, r"`least` must be finite and above 0, but is 0\.0"),
        ({"least": np.inf}, "`least` must be finite"),
        ({"margin": -0.01}, r"`margin` must be finite and at least 0, but is -0\.01"),
        ({"reach": float("nan")}, "`reach` must be finite and above 0, but is nan"),
    ],
)
def test_arguments_are_checked(options, words):
    with pytest.raises(ValueError, match=words):
        find_free_flights(thrown(0).log(PLACE), **options)


def test_what_is_missing_is_said():
    log = thrown(0, duration=0.3).log(PLACE)
    gyro, acc = log.signals["gyro"], log.signals["acc"]

    def find(**signals):
        return find_free_flights(replace(log, signals=signals))

    with pytest.raises(LogError, match=r"must have an accelerometer.*`--from`.*table of times"):
        find(gyro=gyro)
    with pytest.raises(
        LogError, match=r"`acc`.*unit of specific force, such as m/s², but the file"
    ):
        find(gyro=gyro, acc=replace(acc, unit=""))
    with pytest.raises(LogError, match=r"`gyro`.*must have a unit of angular velocity.*'kg'"):
        find(gyro=replace(gyro, unit="kg"), acc=acc)
    with pytest.raises(LogError, match=r"`acc`.*must have three components, but has 1"):
        find(gyro=gyro, acc=replace(acc, values=acc.values[:, 0]))
    with pytest.raises(LogError, match=r"`gyro`.*in the axes of `acc`, 'FLU'.*but is in 'skew'"):
        find(gyro=replace(gyro, frame="skew"), acc=replace(acc, frame="FLU"))
    with pytest.raises(LogError, match="is not there"):
        find_free_flights(log, specific_force="none")
    with pytest.raises(LogError, match=r"`acc`: reads 0.98 m/s² while .* its unit may be g"):
        find(gyro=gyro, acc=replace(acc, values=acc.values / G))


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_log_of_a_few_samples_has_no_flight(count):
    log = thrown(0, duration=0.3).log(PLACE)
    for name, signal in log.signals.items():
        few = replace(signal, times=signal.times[:count], values=signal.values[:count])
        assert find_free_flights(replace(log, signals={**log.signals, name: few})) == ()


def test_a_flight_is_a_name_and_two_times_and_survives_pickling():
    flight = FreeFlight("3", 1.0, 2.0, "words")
    name, begin, end = flight
    assert (name, begin, end) == ("3", 1.0, 2.0)
    assert pickle.loads(pickle.dumps(flight)).words == "words"


def table(tmp_path, text, encoding="utf-8"):
    file = tmp_path / "times.csv"
    file.write_bytes(text.encode(encoding))
    return file


def test_a_table_of_times_is_read(tmp_path):
    flights = read_intervals(table(tmp_path, "from,to\n1.5, 2\n\n4,5e0\n", "utf-8-sig"))
    assert [tuple(flight) for flight in flights] == [("1", 1.5, 2.0), ("2", 4.0, 5.0)]
    flights = read_intervals(table(tmp_path, 'to , name,from\r\n2,"a, b",1\r\n4,,3\r\n'))
    assert [tuple(flight) for flight in flights] == [("a, b", 1.0, 2.0), ("2", 3.0, 4.0)]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_table_of_a_spreadsheet_is_read(tmp_path, encoding, separator):
    text = f"name{separator}from{separator}to\r\nWürfe, 1{separator}1,5{separator}2\r\n"
    (flight,) = read_intervals(table(tmp_path, text, encoding))
    assert tuple(flight) == ("Würfe, 1", 1.5, 2.0)
    text = text.replace("1,5", "1.5")
    assert read_intervals(table(tmp_path, text, encoding)) == (flight,)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"line 1: must have the columns `from`, `to`"),
        ("from:to\n1:2\n", r"but has \['from:to'\]"),
        ('from,to\n"1,5",2\n', r"line 2, column `from`: must be a time, s, but is '1,5'"),
        ("from;to\n1,5;1.234\n", r"line 2, column `to`: must be a time, s, but is '1\.234'"),
        ("from,to\n1,1_0\n", r"line 2, column `to`: must be a time, s, but is '1_0'"),
        ("from,to,note\n1,2,x\n", "must have the columns"),
        ("from,to,to\n1,2,3\n", "must have the columns"),
        ("from,to\n", "must have a flight in a line at least"),
        ("from,to\n1,2\n3\n", r"line 3: must have 2 cells, but has 1"),
        ("from,to\n1,2\nx,4\n", r"line 3, column `from`: must be a time, s, but is 'x'"),
        ("from,to\n1,nan\n", r"line 2, column `to`: must be a time, s, but is 'nan'"),
        ("from,to\n2,1\n", r"line 2, column `to`: must be after 2 s, but is 1 s"),
        ("from,to\n1,3\n2,4\n", r"line 3: must not overlap.* with that of line 2"),
        ("name,from,to\na,1,2\na,3,4\n", r"line 3, column `name`: .* another name than in line 2"),
        ('from,to\n"1,2\n', "line 2: must be a table, but"),
    ],
)
def test_a_table_that_is_wrong_is_refused_with_its_place(tmp_path, text, words):
    file = table(tmp_path, text)
    with pytest.raises(LogError, match=words) as raised:
        read_intervals(file)
    assert str(raised.value).startswith(str(file))


def test_a_damaged_table_is_refused_or_read(tmp_path):
    random = np.random.default_rng(0)
    whole = b"name,from,to\nfirst,1.25,2.5\nsecond,3,4.75\n"
    file = tmp_path / "times.csv"
    refused = 0
    for _ in range(200):
        damaged = bytearray(whole[: random.integers(1, len(whole) + 1)])
        for place in random.integers(0, len(damaged), random.integers(0, 4)):
            damaged[place] = random.integers(256)
        file.write_bytes(damaged)
        try:
            assert all(flight.begin < flight.end for flight in read_intervals(file))
        except LogError:
            refused += 1
    assert refused > 100


def test_neither_jax_nor_identification_is_imported():
    script = "import sys, lgvi.logs.free_flights, lgvi.logs.contents; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    modules = done.stdout.split()
    assert "lgvi.logs.free_flights" in modules
    assert not {"jax", "scipy", "matplotlib", "lgvi.identification"} & set(modules)


@pytest.fixture
def _closed():
    yield
    plt.close("all")


@pytest.mark.usefixtures("_closed")
def test_the_picture_shows_each_quantity_and_names_each_flight():
    story = thrown(0)
    log = story.log(PLACE)
    log.signals["acc"].values[7] = np.nan
    other = replace(log.signals["gyro"], name="other", quantity="")
    log = replace(log, signals={**log.signals, "other": other})
    flights = find_free_flights(log)
    figure = plot_log(log, flights)
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == ["angular velocity\ngyro (rad/s)", "specific force\nacc (m/s²)"]
    for axis, count in zip(figure.axes, [len(other), len(other) - 1], strict=True):
        assert [len(np.asarray(line.get_xdata())) for line in axis.lines] == [count] * 3
        (shaded,) = axis.patches
        box = shaded.get_path().get_extents(shaded.get_patch_transform())
        np.testing.assert_allclose([box.x0, box.x1], flights[0][1:])
    assert [text.get_text() for text in figure.axes[0].texts] == ["1"]


@pytest.mark.usefixtures("_closed")
def test_the_picture_of_a_long_log_is_light_and_shows_its_spikes():
    t = np.arange(300_000) / 1000
    values = np.random.default_rng(0).normal(size=len(t))
    values[123_456] = 99
    log = Log("long.csv", "made", {f"s{i}": Signal(f"s{i}", t, values) for i in range(30)})
    figure = plot_log(log)
    assert len(figure.axes) == 12
    (line,) = figure.axes[0].lines
    assert len(np.asarray(line.get_xdata())) <= 4000
    assert np.asarray(line.get_ydata()).max() == 99
    with pytest.raises(ValueError, match="12 of Matplotlib's axes"):
        plot_log(log, ax=figure.axes[0])
    with pytest.raises(ValueError, match="must have a sample"):
        plot_log(Log("empty.csv", "made", {}))
