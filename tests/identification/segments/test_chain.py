"""Chains of segments: derivatives against differences, and independence of sizes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi import MoserVeselovIntegrator
from lgvi.identification import InitialStates, Model, Recordings
from lgvi.identification.model.configuration import ModelAt
from lgvi.identification.model.selection import select_free_leaves
from lgvi.identification.segments.chain import Windows, gaps, linearise
from lgvi.identification.segments.segment import Chains, Sizes, Window

SIZE = 1e-5  # of differences
SIZES = Sizes(steps=8, quick_lanes=8)
METHOD = MoserVeselovIntegrator(1.0, order=2, throw=False)
INERTIA = np.array([[1.0, 0.1, 0.0], [0.1, 2.0, 0.2], [0.0, 0.2, 2.8]])


@pytest.fixture(scope="module")
def model():
    """A flywheel with a delay; sensors whose clocks are late and early, and one is robust."""
    return Model(
        lgvi.PhysicalRigidBody.from_inertia(INERTIA),
        [
            lgvi.AttitudeSensor(0.1, time_offset=0.037),
            lgvi.Gyroscope(0.1, time_offset=-0.012, loss=lgvi.Huber(1.0)),
        ],
        rotor_inertia=0.2,
        rotor_delay=0.02,
        time_scale=1.1,
    )


@pytest.fixture(scope="module")
def recordings():
    """Of two trajectories, with gyroscope and camera at times of their own."""
    random, trajectories = np.random.default_rng(0), []
    for duration in (1.0, 2.6):
        t, of_camera = np.arange(0, duration, 0.06), np.arange(0.01, duration, 0.1)
        of_wheel = np.arange(0, duration + 0.25, 0.25)
        attitude = random.normal(size=(len(of_camera), 4))
        attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
        trajectories.append(
            Recordings.from_arrays(
                angular_velocity=(t, random.normal(size=(len(t), 3))),
                attitude=(of_camera, attitude),
                rotor_momentum=(of_wheel, np.sin(np.outer(of_wheel, [1.0, 2.0, 3.0]))),
                name=str(duration),
            )
        )
    return Recordings.concatenate(trajectories)


@pytest.fixture(scope="module")
def chains(recordings):
    """The first trajectory, and the second in two parts that are joined."""
    windows = [Window(0, -np.inf, np.inf), Window(1, -np.inf, 1.3, True), Window(1, 1.3, np.inf)]
    channels = ("attitude", "angular_velocity")
    return Chains(recordings, windows, np.full(2, 0.05), channels, optimised=False, sizes=SIZES)


def free(model: Model) -> tuple:
    offsets = [sensor.time_offset for sensor in model.sensors.values()]
    return model.body, model.time_scale, model.rotor_inertia, model.rotor_delay, *offsets


def point(model: Model, leaves: np.ndarray | None = None) -> ModelAt:
    selected = select_free_leaves(model, free, ())
    return ModelAt(model, selected.selected, selected.theta if leaves is None else leaves, None)


def states_of(number: int) -> InitialStates:
    random = np.random.default_rng(2)
    R = Rotation.from_quat(random.normal(size=(number, 4))).as_matrix()
    return InitialStates(R, random.normal(size=(number, 3)))


def found_at(model: Model, chains: Chains, way: np.ndarray, blocks: int = 1) -> Windows:
    """The problem some way from the point, (windows, 6+p), with one step of the leaves."""
    at = point(model)
    states = states_of(len(chains.windows)).moved(way[:, :6])
    at = point(model, at.leaves + way[0, 6:])
    return linearise(at, states, chains, METHOD, 0.05, blocks, None, None)


def squares(triangles: np.ndarray) -> np.ndarray:
    return np.swapaxes(triangles, -1, -2) @ triangles


@pytest.fixture(scope="module")
def found(model, chains):
    unknowns = 6 + len(point(model).leaves)
    return found_at(model, chains, np.zeros((len(chains.windows), unknowns)))


def differences(
    model: Model, chains: Chains, way: np.ndarray
) -> tuple[Windows, Windows, np.ndarray]:
    """The problem a little before and after the point, and the slope of the cost between."""
    before, after = (found_at(model, chains, sign * SIZE * way) for sign in (-1, 1))
    return before, after, (after.cost - before.cost) / (2 * SIZE)


def slope_by_rows(found: Windows, way: np.ndarray) -> np.ndarray:
    """The slope of the cost, by the rows of the windows."""
    return 2 * np.sum(squares(found.triangles)[:, :-1, -1] * way, axis=1)


def clocks(model: Model) -> np.ndarray:
    """True for the unknowns that are times of a clock."""
    names = select_free_leaves(model, free, ()).names
    return np.array([False] * 6 + ["time" in name for name in names])


def test_gradients_and_ends_are_differences(model, chains, found):
    random, times = np.random.default_rng(4), clocks(model)
    way = random.normal(size=(len(chains.windows), len(times))) * ~times
    way[:, 6:] = way[0, 6:]
    before, after, slope = differences(model, chains, way)
    np.testing.assert_allclose(slope, slope_by_rows(found, way), rtol=1e-6)
    following, joined = states_of(3).at(np.array([1, 2, 0])), np.array([False, True, False])
    rows = gaps(found, following, joined)
    turned = following.moved(SIZE * np.roll(way, -1, axis=0)[:, :6])
    back = following.moved(-SIZE * np.roll(way, -1, axis=0)[:, :6])
    slope = (gaps(after, turned, joined) - gaps(before, back, joined))[1, :, -1] / (2 * SIZE)
    expected = rows[1, :, :6] @ way[2, :6] + rows[1, :, 6:-1] @ way[1]
    np.testing.assert_allclose(slope, expected, rtol=1e-7)
    assert not rows[[0, 2]].any()


def test_a_clock_moves_readings_along_the_motion(model, chains):
    # A node that moves changes the steps beside it too: the shorter these are, the less it matters.
    finer, times = replace(chains, finer=8), clocks(model)
    for clock in np.flatnonzero(times):
        way = np.zeros((len(chains.windows), len(times)))
        way[:, clock] = 1
        _, _, slope = differences(model, finer, way)
        expected = slope_by_rows(found_at(model, finer, 0 * way), way)
        np.testing.assert_allclose(slope, expected, atol=5e-3 * float(np.max(abs(slope))))


@pytest.mark.parametrize(
    "sizes",
    [
        Sizes(steps=11, quick_lanes=3, at_once=10),  # more windows than lanes, in parts of time
        Sizes(steps=8, quick_lanes=8, least_lanes=3, long=0),
        Sizes(steps=8, quick_lanes=1, at_once=30),  # one window after another
    ],
)
def test_results_do_not_depend_on_sizes(model, chains, found, sizes):
    other = replace(chains, sizes=sizes)
    again = found_at(model, other, np.zeros((3, 6 + len(point(model).leaves))))
    expected = squares(found.triangles)
    np.testing.assert_allclose(squares(again.triangles), expected, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-12)
    np.testing.assert_allclose(again.loss_sums, found.loss_sums, rtol=1e-12)
    np.testing.assert_allclose(again.of_end, found.of_end, rtol=1e-9, atol=1e-9)


def test_windows_may_have_other_leaves_each(model, chains):
    """As in a bootstrap, where each draw has an inertia, clocks and a delay of its own."""
    leaves = point(model).leaves + 0.01 * np.arange(-1, 2)[:, None]
    states, options = states_of(3), (METHOD, 0.05, 1, None, None)
    together = linearise(point(model, leaves), states, chains, *options)
    for i in range(3):
        alone = point(model, leaves[i]), states.at(np.array([i])), chains.only(np.array([i]))
        expected = linearise(*alone, *options)
        assert together.cost[i] == pytest.approx(expected.cost[0], rel=1e-12)
        actual, desired = (squares(x) for x in (together.triangles[i], expected.triangles[0]))
        np.testing.assert_allclose(actual, desired, rtol=1e-9, atol=1e-8)


def test_blocks_of_time_make_up_the_whole(model, chains, found):
    zero = np.zeros((3, 6 + len(point(model).leaves)))
    blocks = found_at(model, chains, zero, blocks=5).blocks
    assert blocks is not None
    total = np.sum(squares(blocks), axis=1)
    np.testing.assert_allclose(total, squares(found.triangles), rtol=1e-9, atol=1e-8)
    assert np.all(np.sum(blocks[..., -1] ** 2, axis=-1) > 0)


def test_steps_of_half_the_size_are_twice_as_many(model, chains, found):
    halved = chains.halve_steps()
    np.testing.assert_array_equal(halved.steps, 2 * chains.steps)
    zero = np.zeros((3, 6 + len(point(model).leaves)))
    np.testing.assert_allclose(found_at(model, halved, zero).cost, found.cost, rtol=1e-3)


def test_some_windows_are_not_taken_for_all_that_are_kept(chains):
    fixed = replace(chains, channels=())
    ((_, every),) = fixed.parts(np.arange(3), np.zeros((3, 1)), np.zeros(3))
    ((numbers, alone),) = fixed.parts(np.array([1]), np.zeros((1, 1)), np.zeros(1))
    np.testing.assert_array_equal(numbers, [0])
    np.testing.assert_array_equal(
        alone.segments.dt, every.segments.dt[every.first[1] :][: alone.counts[0]]
    )
    np.testing.assert_array_equal(alone.counts, every.counts[1])
