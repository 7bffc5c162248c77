"""Mass properties against sums over points, meshes, MuJoCo and a reader of URDF."""

import io
from operator import add, sub
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
import yourdfpy

from lgvi import MassProperties

from ..systems import rotation

MUJOCO: Any = mujoco
ONE: Any = 1.0


def cloud(seed, points=6):
    """Masses (points,) at places (points, 3)."""
    random = np.random.default_rng([seed, 240])
    return random.uniform(0.1, 1, points), random.normal(size=(points, 3))


def properties_of(mass, x):
    """The same by sums over points."""
    centre = mass @ x / np.sum(mass)
    return MassProperties(np.sum(mass), centre, inertia_of(mass, x - centre))


def inertia_of(mass, x):
    return np.sum(
        [m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(mass, x, strict=True)], 0
    )


def assert_same(found, expected, rtol=1e-12):
    size = np.sqrt(np.trace(expected.inertia) / expected.mass)
    np.testing.assert_allclose(found.mass, expected.mass, rtol=rtol)
    np.testing.assert_allclose(found.centre, expected.centre, rtol=rtol, atol=rtol * size)
    np.testing.assert_allclose(
        found.inertia, expected.inertia, rtol=rtol, atol=rtol * np.trace(expected.inertia)
    )


def test_bodies_are_joined_and_taken_apart():
    (m, x), (n, y) = cloud(0), cloud(1)
    both = properties_of(np.concatenate([m, n]), np.concatenate([x, y]))
    a, b = properties_of(m, x), properties_of(n, y)
    assert_same(a + b, both)
    assert_same(sum([a, b]), both)
    assert_same(both - b, a)
    assert_same(both - a, b)
    assert (a + b).is_physical
    assert not (b - a - a).is_physical
    for operator in (add, sub):
        with pytest.raises(TypeError, match="unsupported operand"):
            operator(a, ONE)


def test_a_body_in_another_frame_is_that_of_its_points_there():
    m, x = cloud(2)
    R, p = rotation(3, 240), np.array([1.0, -2.0, 0.5])
    assert_same(properties_of(m, x).rotated(R).moved(p), properties_of(m, x @ R.T + p))
    np.testing.assert_allclose(
        properties_of(m, x).inertia_about(p), inertia_of(m, x - p), rtol=1e-12
    )


def test_the_pseudo_inertia_is_the_second_moment_of_the_mass():
    m, x = cloud(4)
    y = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    P = properties_of(m, x).pseudo_inertia
    np.testing.assert_allclose(P, (m * y.T) @ y, rtol=1e-12, atol=1e-13)
    assert_same(MassProperties.from_pseudo_inertia(P), properties_of(m, x), rtol=1e-11)


@pytest.mark.parametrize("points", [1, 2, 3, 4])
def test_a_body_is_physical_if_its_pseudo_inertia_is_definite(points):
    body = properties_of(*cloud(5, points))
    thicker = MassProperties(body.mass, body.centre, body.inertia + 1e-9 * np.eye(3))
    thinner = MassProperties(body.mass, body.centre, body.inertia - 1e-9 * np.eye(3))
    assert thicker.is_physical
    assert thinner.is_physical == (points == 4)
    assert not MassProperties(-body.mass, body.centre, thicker.inertia).is_physical
    assert not MassProperties(jnp.nan, body.centre, thicker.inertia).is_physical


def test_principal_axes_are_a_rotation_to_them():
    body = properties_of(*cloud(6))
    moments, axes = body.principal()
    assert np.all(np.diff(moments) > 0)
    np.testing.assert_allclose(np.linalg.det(axes), 1, rtol=1e-12)
    turned = body.rotated(axes.T)
    np.testing.assert_allclose(turned.inertia, np.diag(moments), atol=1e-12)


def test_the_distance_depends_neither_on_frame_nor_on_units():
    a, b = (properties_of(*cloud(seed)) for seed in (7, 8))
    P, Q = a.pseudo_inertia, b.pseudo_inertia
    expected = np.sqrt(np.sum(np.log(np.linalg.eigvals(np.linalg.solve(P, Q)).real) ** 2) / 2)
    np.testing.assert_allclose(a.distance(b), expected, rtol=1e-10)
    np.testing.assert_allclose(b.distance(a), expected, rtol=1e-10)
    R, p = rotation(9, 240), np.array([0.3, -0.2, 0.1])
    elsewhere = (each.rotated(R).moved(p) for each in (a, b))
    in_mm = (MassProperties(x.mass, 1e3 * x.centre, 1e6 * x.inertia) for x in elsewhere)
    first, second = in_mm
    np.testing.assert_allclose(first.distance(second), expected, rtol=1e-8)
    assert a.distance(a) < 1e-12
    assert not np.isfinite(a.distance(MassProperties(-1.0, a.centre, a.inertia)))
    heavier = MassProperties(1.001 * a.mass, a.centre, 1.001 * a.inertia)
    np.testing.assert_allclose(a.distance(heavier), 2**0.5 * np.log(1.001), rtol=1e-9)


def test_a_distance_is_the_same_far_from_the_origin(dtype):
    box = MassProperties.box(jnp.ones((), dtype), jnp.asarray([0.1, 0.1, 0.05], dtype))
    a = box.moved(jnp.asarray([100, 3, 0], dtype))
    b = MassProperties(a.mass * 1.01, a.centre, a.inertia * 1.01)
    np.testing.assert_allclose(a.distance(b), 2**0.5 * np.log(1.01), rtol=1e-4)


def test_an_inertia_that_is_not_symmetric_is_that_of_no_body():
    body = MassProperties(1.0, np.zeros(3), np.diag([2.0, 2.0, 3.0]) + 0.1 * np.eye(3, k=1))
    assert not body.is_physical
    with pytest.raises(ValueError, match="must have a symmetric inertia to be written"):
        body.to_mjcf()
    both = jax.tree.map(lambda x: jnp.stack([x, x]), body)
    with pytest.raises(ValueError, match="One body is written per call"):
        both.to_urdf()


def test_a_distance_has_a_finite_gradient_at_zero_too():
    unit = MassProperties(1.0, jnp.zeros(3), jnp.eye(3))
    gradient = jax.grad(lambda body: body.distance(unit))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(gradient(unit)))
    change = gradient(MassProperties(2.0, jnp.zeros(3), 2.0 * jnp.eye(3)))
    np.testing.assert_allclose(change.mass + jnp.sum(change.inertia), 2**0.5 / 2, rtol=1e-9)


def test_a_difference_has_the_derivative_of_both():
    a, b = (properties_of(*cloud(seed)) for seed in (10, 11))
    total, (da, db) = a + b, (properties_of(*cloud(seed)) for seed in (12, 13))

    def rest(step):
        first, second = (
            jax.tree.map(lambda x, dx: x + step * dx, *each) for each in ((total, da), (b, db))
        )
        return jax.tree.leaves(first - second)

    _, slopes = jax.jvp(rest, (0.0,), (1.0,))
    for slope, up, down in zip(slopes, rest(1e-6), rest(-1e-6), strict=True):
        np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-7, atol=1e-8)


def test_solids_are_those_of_meshes(tmp_path):
    many: dict[str, Any] = {"sections": 3000}
    for body, mesh, rtol in (
        (MassProperties.box(2.0, [1.0, 2.0, 3.0]), trimesh.creation.box([1, 2, 3]), 1e-12),
        (MassProperties.cylinder(2.0, 0.3, 2.0), trimesh.creation.cylinder(0.3, 2, **many), 2e-6),
        (MassProperties.sphere(2.0, 0.3), trimesh.creation.icosphere(6, 0.3), 1e-3),
        (MassProperties.rod(2.0, 3.0), trimesh.creation.box([1e-9, 1e-9, 3]), 1e-9),
    ):
        assert_same(MassProperties.from_mesh(mesh, mass=2.0), body, rtol)
    box, mesh = MassProperties.box(3.0, [1.0, 2.0, 3.0]), trimesh.creation.box([1, 2, 3])
    mesh.apply_translation([0.1, 0.2, 0.3])
    mesh.center_mass = [5, 5, 5]  # it is not that of the surface
    assert_same(MassProperties.from_mesh(mesh, density=0.5).moved([-0.1, -0.2, -0.3]), box, 1e-12)
    mesh.export(tmp_path / "box.stl")
    read = MassProperties.from_mesh(tmp_path / "box.stl", density=0.5)
    assert_same(read, box.moved([0.1, 0.2, 0.3]), 1e-6)


def test_a_mesh_that_tells_no_mass_is_refused(unchecked):
    box = trimesh.creation.box([1, 2, 3])
    with pytest.raises(ValueError, match=r"`mass` or `density` must be given, .* but none is"):
        MassProperties.from_mesh(box)
    with pytest.raises(ValueError, match="not both, but both are"):
        MassProperties.from_mesh(box, mass=1.0, density=1.0)
    with pytest.raises(TypeError, match=r"`mesh` must be a `trimesh.Trimesh` .*, but is 3"):
        MassProperties.from_mesh(3, mass=1.0)
    with pytest.raises(ValueError, match=r"`mass` must have shape \(\)"):
        MassProperties.from_mesh(box, mass=np.ones(3))
    with pytest.raises(FileNotFoundError, match=r"`mesh` must .*, but is 'nowhere.stl'"):
        MassProperties.from_mesh("nowhere.stl", mass=1.0)
    open_box = trimesh.Trimesh(box.vertices, box.faces[1:])
    with pytest.raises(ValueError, match=r"`mesh` must be closed, .*`is_watertight` is False"):
        MassProperties.from_mesh(open_box, mass=1.0)


def test_a_thousand_bodies_are_those_that_mujoco_compiles():
    bodies = [properties_of(*cloud(seed)) for seed in range(1000)]
    elements = "".join(f"<body><freejoint/>{body.to_mjcf()}</body>" for body in bodies)
    model = MUJOCO.MjModel.from_xml_string(f"<mujoco><worldbody>{elements}</worldbody></mujoco>")
    for i, body in enumerate(bodies, start=1):
        numbers = {
            "mass": [model.body_mass[i]],
            "pos": model.body_ipos[i],
            "diaginertia": model.body_inertia[i],
            "quat": model.body_iquat[i],
        }
        attributes = {name: " ".join(map(str, each)) for name, each in numbers.items()}
        text = " ".join(f'{name}="{each}"' for name, each in attributes.items())
        assert_same(MassProperties.from_mjcf(f"<inertial {text}/>"), body, 1e-9)
    assert_same(MassProperties.from_mjcf(bodies[0].to_mjcf()), bodies[0], 1e-15)


BOX = '<inertial pos="0.1 0.2 0" mass="2" diaginertia="1 2 2.5" quat="1 2 3 4"/>'
BY_GEOMS = '<body name="hull"><freejoint/><geom size="0.1"/>{}</body>'
IN_FRAMES = (
    """<frame pos="1 0 2" quat="1 0 0 2"><frame pos="0 1 0" quat="0 3 1 0">{}</frame></frame>"""
)


def model_of(bodies, settings="", attributes=""):
    compiler = f"<compiler {settings}/>" if settings else ""
    return f"<mujoco {attributes}>{compiler}<worldbody>{bodies}</worldbody></mujoco>"


@pytest.mark.parametrize(
    "text",
    [
        model_of(f'<body name="box">{IN_FRAMES.format(BOX)}</body>'),
        model_of(IN_FRAMES.format(f'<body name="box">{BOX}</body>')),
        model_of(f'<body name="box">{BOX}</body>', attributes='xmlns="http://mujoco.org"'),
        model_of(
            f'<body name="box"><joint/>{BOX}</body>',
            'settotalmass="-1" boundmass="1" boundinertia="0.5" balanceinertia="true"',
        ),
    ],
)
def test_frames_namespaces_and_settings_without_effect_are_read_as_mujoco_reads_them(
    text, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its warnings
    model = MUJOCO.MjModel.from_xml_string(text)
    box = MassProperties(model.body_mass[1], jnp.zeros(3), jnp.diag(model.body_inertia[1]))
    axes = np.zeros(9)
    MUJOCO.mju_quat2Mat(axes, model.body_iquat[1])
    expected = box.rotated(axes.reshape(3, 3)).moved(model.body_ipos[1])
    assert_same(MassProperties.from_mjcf(text), expected)
    assert_same(MassProperties.from_mjcf(text, "box"), expected)


@pytest.mark.parametrize(
    "setting",
    [
        'balanceinertia="true"',
        'boundmass="1.1"',
        'boundinertia="1.5"',
        'settotalmass="5"',
        'fusestatic="true"',
        'alignfree="true"',
        'inertiafromgeom="true"',
    ],
)
def test_a_setting_that_changes_a_body_is_refused(setting, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its warnings
    flat = '<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 2.5"/>'
    bodies = (
        f'<body name="a"><freejoint/><geom size="0.1"/>{flat}<body><geom size="1"/></body></body>'
    )
    if "align" in setting:  # which has no effect where there are other bodies on it
        bodies = bodies.replace('<body><geom size="1"/></body>', "")
    if "balance" not in setting:  # which MuJoCo refuses otherwise
        bodies = bodies.replace("2.5", "1.5")
    changed = MUJOCO.MjModel.from_xml_string(model_of(bodies, setting))
    as_written = changed.body_mass[1] == 1 and min(changed.body_inertia[1]) == 1
    assert not (as_written and changed.body_ipos[1, 0] == 0.1)
    with pytest.raises(
        ValueError, match=rf"changes bodies, but has `{setting}`: compile .*body_ma"
    ):
        MassProperties.from_mjcf(model_of(bodies, setting), "a")


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/>
      <mass value="2"/>
      <inertia ixx="0.3" iyy="0.4" izz="0.5" ixy="0.01" ixz="-0.02" iyz="0.03"/>
    </inertial>
  </link>
  {}
</robot>"""


def test_urdf_is_read_as_another_reader_reads_it():
    body = properties_of(*cloud(14))
    lower = f'<link name="lower">{body.to_urdf()}</link>'
    text = URDF.format(lower)
    robot = yourdfpy.URDF.load(io.StringIO(text), load_meshes=False, build_scene_graph=False)
    for name in ("upper", "lower"):
        read = robot.link_map[name].inertial
        place = read.origin
        expected = MassProperties(read.mass, jnp.zeros(3), read.inertia)
        expected = expected.rotated(place[:3, :3]).moved(place[:3, 3])
        assert_same(MassProperties.from_urdf(text, name), expected)
    assert_same(MassProperties.from_urdf(text, "lower"), body, 1e-15)
    assert_same(MassProperties.from_urdf(f"\n{body.to_urdf()}"), body, 1e-15)
    assert_same(MassProperties.from_urdf(lower), body, 1e-15)
    without_place = '<inertial><mass value="1"/><inertia {}/></inertial>'.format(
        " ".join(
            f'{name}="{value}"'
            for name, value in zip(
                ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), (1, 1, 1, 0, 0, 0), strict=True
            )
        )
    )
    assert_same(
        MassProperties.from_urdf(without_place), MassProperties(1.0, jnp.zeros(3), jnp.eye(3))
    )


UPPER = URDF.format("")
HULL = '<robot><link name="hull"><collision/></link></robot>'
MJCF = '<inertial pos="0 0 0" mass="1" {}/>'


@pytest.mark.parametrize(
    ("read", "text", "name", "message"),
    [
        ("urdf", "<robot", None, "`text` must be XML, .* but is not: "),
        ("urdf", "<robot/>", None, "one element with `inertial`; with it are none"),
        ("urdf", UPPER, "lower", r"link named 'lower' .*; with it are 'upper'\.$"),
        (
            "urdf",
            URDF.format('<mujoco><compiler boundmass="5"/></mujoco>'),
            None,
            'has `boundmass="5"`: compile',
        ),
        (
            "urdf",
            URDF.format('<link name="upper"><inertial/></link>'),
            "upper",
            "Several links have that name",
        ),
        ("mjcf", model_of("<body/>"), None, "are none. The text has no element `inertial` at all"),
        ("urdf", HULL, None, "are none. In URDF a link without `inertial` has no mass"),
        ("urdf", HULL, "hull", "are none. In URDF a link without `inertial` has no mass"),
        (
            "urdf",
            URDF.format('<link name="lower"><inertial/></link>'),
            None,
            "are 'upper', 'lower': choose one by `link`",
        ),
        ("urdf", "<inertial/>", None, "must have `mass` and `inertia` in .*, but has none"),
        (
            "urdf",
            URDF.format("").replace('"2"', '"two"'),
            None,
            "1 finite number in .*, but has 'two'",
        ),
        (
            "urdf",
            URDF.format("").replace('ixx="0.3"', ""),
            None,
            "the attribute `ixx` in its element",
        ),
        ("mjcf", MJCF.format('fullinertia="1 1 1"'), None, "6 finite numbers .* but has '1 1 1'"),
        ("mjcf", MJCF.format('diaginertia="1 1 inf"'), None, "3 finite numbers .* '1 1 inf'"),
        ("mjcf", MJCF.format(""), None, "by `fullinertia`, or by .*, but has .*'mass'"),
        (
            "mjcf",
            MJCF.format('fullinertia="1 1 1 0 0 0" quat="0 1 0 0"'),
            None,
            "by `fullinertia`, or by .*, but has .*'quat'",
        ),
        (
            "mjcf",
            MJCF.format('diaginertia="1 1 1" euler="0 0 1"'),
            None,
            "by `quat` or `fullinertia`, but has `euler`",
        ),
        (
            "mjcf",
            MJCF.format('diaginertia="1 1 1" quat="0 0 0 0"'),
            None,
            "`quat` that is not zero",
        ),
        (
            "mjcf",
            model_of(BY_GEOMS.format(f'<body name="rotor">{BOX}</body>')),
            None,
            "with it are 'rotor', and without it, but with geoms, 'hull': choose one by `body`",
        ),
        (
            "mjcf",
            model_of(BY_GEOMS.format(f'<body name="rotor">{BOX}</body>')),
            "hull",
            "are 'rotor', and .* 'hull'. The mass of a body .*`body_mass`, `body_ipos`, `body_iqu",
        ),
        ("mjcf", model_of(BY_GEOMS.format("")), None, "with it are none, .* in its geoms: compile"),
        (
            "mjcf",
            model_of(2 * f"<body>{BOX}</body>"),
            None,
            "number 1, without a name, number 2, without a name: give its `inertial` alone",
        ),
        ("mjcf", '<mujoco><include file="a.xml"/></mujoco>', None, "`include` is not followed"),
        ("mjcf", UPPER, None, "but is URDF: use `from_urdf`"),
        ("urdf", model_of(f"<body>{BOX}</body>"), None, "but is MJCF: use `from_mjcf`"),
        ("urdf", '<robot><link name="${side}"/></robot>', None, "The text is xacro: expand it"),
        ("urdf", "<sdf><link><inertial/></link></sdf>", None, "but is SDF"),
        (
            "urdf",
            '<robot xmlns:x="http://ros.org/wiki/xacro"><x:macro><link/></x:macro></robot>',
            None,
            "must be a model, but is xacro: expand",
        ),
        ("urdf", UPPER.replace("<mass", "<block/><mass"), None, "each once, but has 'block'"),
        ("urdf", UPPER.replace("<mass", "<origin/><mass"), None, "but has 'origin', 'origin'"),
        ("urdf", UPPER.replace('"2"', '"${m}"'), None, r"has '\$\{m\}': expand it by the program"),
        ("mjcf", model_of(f"<body>{BOX}{BOX}</body>"), None, "one `inertial` in a body, but has 2"),
        (
            "mjcf",
            model_of(f'<body><freejoint align="true"/>{BOX}</body>'),
            None,
            "no `freejoint` with `align=.*compile",
        ),
        ("urdf", '<mass value="2"/>', None, "The text is an element `mass` alone"),
        ("mjcf", BOX, "box", "`body` must be None for an `inertial` alone, but is 'box'"),
        (
            "mjcf",
            model_of(f'<body name="a">{BOX}</body><body>{BOX}</body><body name="a">{BOX}</body>'),
            None,
            r"are 'a' \(number 1\), number 2, without a name, 'a' \(number 3\): choose one",
        ),
        (
            "mjcf",
            model_of(40 * f'<body name="{1000 * "long"}">{BOX}</body>'),
            None,
            r"^.{,150}\.\.\..{,250}, and 35 more: choose one .{,50}$",
        ),
    ],
)
def test_text_that_gives_no_body_is_refused(read, text, name, message):
    reader = MassProperties.from_urdf if read == "urdf" else MassProperties.from_mjcf
    with pytest.raises(ValueError, match=message):
        reader(text, name)


@pytest.mark.usefixtures("unchecked")
def test_bytes_are_refused_without_being_shown_whole():
    with pytest.raises(TypeError, match=r"XML in a string, but is b'.{,45}$"):
        MassProperties.from_urdf(cast(Any, 1000 * b"x"))


def test_bodies_without_mass_change_no_body_and_no_derivative():
    box = MassProperties.box(2.0, [1.0, 2.0, 3.0]).moved([0.3, -0.2, 0.1])
    empty = [MassProperties(0.0, place, jnp.zeros((3, 3))) for place in np.eye(3)[:2]]
    for bodies in ([*empty, box], [empty[0], box, empty[1]], [box, *empty]):
        assert_same(sum(bodies), box)
    a, b = box, MassProperties.box(2.0, [3.0, 2.0, 1.0])
    assert not np.isfinite((a - b).centre).all()  # its moment would be lost
    none = empty[0] + empty[1]
    np.testing.assert_array_equal(none.centre, [0.5, 0.5, 0])
    np.testing.assert_array_equal(none.inertia, np.zeros((3, 3)))
    for rest in (
        box - box,
        none + box - box,
        MassProperties.from_pseudo_inertia((box - box).pseudo_inertia),
    ):
        assert rest.mass == 0
        assert np.all(np.isfinite(rest.centre))
        np.testing.assert_allclose(rest.inertia, np.zeros((3, 3)), atol=1e-15)

    def numbers(bodies):
        whole = sum(bodies)
        rest = whole - bodies[2]
        again = MassProperties.from_pseudo_inertia(rest.pseudo_inertia)
        return [jax.tree.leaves(each) for each in (whole, rest, again)]

    derivatives = jax.jacfwd(numbers)([*empty, box])
    assert all(np.all(np.isfinite(each)) for each in jax.tree.leaves(derivatives))


def test_what_cannot_be_written_is_refused():
    body = MassProperties.box(1.0, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="must be finite to be written, but is"):
        MassProperties(jnp.inf, body.centre, body.inertia).to_urdf()
    with pytest.raises(TypeError, match=r"written outside of `jax.jit`"):
        jax.jit(lambda body: body.to_mjcf())(body)


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_body_is_refused():
    box, script = MassProperties.box(1.0, [1.0, 2.0, 3.0]), __file__
    for difference in (box - box, box - (box + box)):
        with pytest.raises(ValueError, match="must have a mass above 0 to be written"):
            difference.to_mjcf()
    with pytest.raises(TypeError, match="`other` must be `MassProperties`, but is 3"):
        box.distance(cast(Any, 3))
    with pytest.raises(ValueError, match="`mesh` must be the path of a mesh that trimesh reads"):
        MassProperties.from_mesh(script, mass=1.0)
