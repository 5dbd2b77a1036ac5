"""`lieint animate`: what is drawn is the motion, the body has its inertia, and files are what they say."""

import html.parser
import itertools
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import lieint_jax as li
from lieint_jax import plots
from lieint_jax.command import cli
from lieint_jax.plots import runs, scene, solids

pytestmark = pytest.mark.long

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
DT = 0.05
all_steps = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Two bodies over t = 4, a state saved at every other step."""
    path = tmp_path_factory.mktemp("runs") / "run.zarr"
    states = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    li.run(STEP, states, DT, 80, save_every=2, store=path, progress=False)
    return path


def stored(system, q, p, t, work=None):
    """A run of one body, as `scene.scene_of` accepts it; of a system that counts its work, with that."""
    state = li.State(jnp.asarray(q), jnp.asarray(p))
    state = state if work is None else state._replace(t=jnp.asarray(t), work=jnp.asarray(work))
    info = li.StepInfo(jnp.zeros(len(t)), jnp.ones(len(t), bool))
    return li.Run.of(li.schemes.extrapolate(system), li.Trajectory(t, state, info), time_unit="s")


def animate(path, arguments=()):
    return cli.main(["animate", str(path), *map(str, arguments)])


def test_frames_between_saved_states_show_the_states_that_were_not_saved(store):
    """Saved every 0.1, interpolated every 0.05: the steps in between are met to 2e-7."""
    run = li.open(store)
    found = scene.scene_of(run.member(1), "a body", 81)
    np.testing.assert_allclose(found.t, DT * np.arange(81), rtol=0, atol=1e-12)
    start = jax.tree.map(lambda x: jnp.asarray(x[0, 1]), run.state)
    every = all_steps(STEP, start, DT, 80, save_every=1)
    R = np.asarray(jax.jit(jax.vmap(BODY.rotation_matrix))(every.state))
    np.testing.assert_allclose(found.rotations[::2, 0], R[::2], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.rotations[1::2, 0], R[1::2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.momenta, np.broadcast_to(found.momenta[0], (81, 1, 3)), rtol=0, atol=1e-13)
    axis = R[0].T @ found.paths[0, 0]  # in the body
    np.testing.assert_allclose(found.paths[:: 2 * found.fine, 0], R[::2] @ axis, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        np.abs(axis) / np.linalg.norm(axis), [0, 0, 1], rtol=0, atol=1e-13
    )  # of greatest inertia


@pytest.mark.quick
@pytest.mark.parametrize("J", [[1.0, 2.0, 2.5], [[2.0, 0.2, -0.1], [0.2, 2.5, 0.15], [-0.1, 0.15, 3.0]]])
def test_a_box_has_the_given_inertia_up_to_its_size(J):
    """Homogeneous, its second moments are a third of those of its corners with an eighth of the mass each."""
    corners = solids.of_inertia(np.array(J)).corners
    E = corners.T @ corners
    J = np.diag(J) if np.ndim(J) == 1 else np.array(J)
    np.testing.assert_allclose((np.trace(E) * np.eye(3) - E) / np.trace(E) * np.trace(J) / 2, J, rtol=0, atol=1e-14)


@pytest.mark.quick
def test_a_body_with_a_mass_is_the_ellipsoid_of_its_inertia():
    """In rotated axes; its corners are on the ellipsoid, and reach the ends of its semi-axes."""
    squares, R = np.array([9.0, 4.0, 1.0]), np.linalg.qr(np.arange(9.0).reshape(3, 3) % 4 + np.eye(3))[0]
    corners = solids.of_inertia(R @ np.diag(1.7 / 5 * (squares.sum() - squares)) @ R.T, 1.7).corners
    corners = corners @ R / np.sqrt(squares)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 1, rtol=1e-12)


@pytest.mark.quick
def test_a_top_has_the_given_inertia():
    """Up to its size, that of a cone on its point: J₃ = 3mr²/10, J₁ = 3m(r²/4 + h²)/5."""
    r, h, e = 0.5, 0.9, np.array([0.6, 0.0, 0.8])
    J1, J3 = 3 / 5 * (r**2 / 4 + h**2), 3 / 10 * r**2
    found = solids.top(J1 * np.eye(3) + (J3 - J1) * np.outer(e, e), e)
    height = found.corners[-1] @ e
    radii = np.linalg.norm(found.corners[1:-1] - height * e, axis=1)
    np.testing.assert_allclose(radii / height, r / h, rtol=1e-12)
    np.testing.assert_array_equal(found.corners[0], 0)


def test_sparsely_saved_states_are_shown_without_interpolation():
    """At 2.8 rad between saved states the frames are saved states, and a note says so."""
    t = 2.8 * np.arange(6.0)
    q = np.stack([np.cos(t / 2), 0 * t, 0 * t, np.sin(t / 2)], axis=1)
    found = scene.scene_of(stored(BODY, q, np.tile([0.0, 0.0, 3.0], (6, 1)), t), "a body", 4)
    np.testing.assert_array_equal(found.t, t[:4])
    np.testing.assert_allclose(found.rotations[:, 0, 0, 0], np.cos(t[:4]), rtol=0, atol=1e-14)
    assert "up to 160° of rotation: the frames are the first 4 saved states; save more often" in found.notes[-1]


def uniform(t, rate=1.0):
    """A run of one member that turns about its z axis."""
    q = np.stack([np.cos(rate * t / 2), 0 * t, 0 * t, np.sin(rate * t / 2)], axis=1)
    return stored(BODY, q, np.tile([0.0, 0.0, 3.0 * rate], (len(t), 1)), t)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_span_begins_and_ends_at_the_requested_times(sign):
    run = uniform(sign * np.linspace(0, 8, 9))
    found = scene.scene_of(run, "a body", 41, (sign * 2.3, sign * 4.7))
    np.testing.assert_allclose(found.t, sign * np.linspace(2.3, 4.7, 41), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.rotations[:, 0, 0, 0], np.cos(found.t), rtol=0, atol=1e-12)
    assert not any("first" in note for note in found.notes)
    assert found.needed < 41
    short = scene.scene_of(run, "a body", 5, (sign * 2.0, None))  # 6 rad at 15° a frame
    np.testing.assert_allclose(short.t[[0, -1]], [sign * 2, sign * (2 + np.pi / 3)], rtol=0, atol=1e-12)
    assert short.needed == 24
    assert "the first 1.047 of 6 s" in short.notes
    fast = scene.scene_of(run, "a body", 5, (0.0, sign * 8.0))  # with an end it is all shown, in frames of 115°
    np.testing.assert_allclose(fast.t, sign * np.linspace(0, 8, 5), rtol=0, atol=1e-14)
    np.testing.assert_allclose(fast.rotations[:, 0, 0, 0], np.cos(fast.t), rtol=0, atol=1e-12)
    assert "up to 115° of rotation from frame to frame, which may seem backward" in fast.notes
    chord = np.linalg.norm(np.diff(fast.paths[:, 0], axis=0), axis=1).max() / np.linalg.norm(fast.paths[0, 0])
    assert chord <= np.deg2rad(15) / 4 * 1.01  # the path is as fine as that of a slow film
    for span in ((-1.0, None), (3.0, 3.0), (3.0, 9.0), (4.0, 3.0)):
        with pytest.raises(ValueError, match=r"--from and --to must lie in the run, from -?0 to -?8 s"):
            scene.scene_of(run, "a body", 5, tuple(x if x is None else sign * x for x in span))


@pytest.mark.quick
def test_a_span_of_sparsely_saved_states_shows_the_saved_states():
    found = scene.scene_of(uniform(2.8 * np.arange(6.0)), "a body", 9, (2.0, 9.0))
    np.testing.assert_array_equal(found.t, 2.8 * np.arange(1.0, 4.0))
    whole = scene.scene_of(uniform(2.8 * np.arange(9.0)), "a body", 3, (None, 2.8 * 8))
    np.testing.assert_array_equal(whole.t, 2.8 * np.array([0.0, 3.0, 6.0]))
    assert "the frames are the saved states, one of 3;" in whole.notes[-1]
    with pytest.raises(ValueError, match="fewer than two states are saved from t = 3 to 4"):
        scene.scene_of(uniform(2.8 * np.arange(6.0)), "a body", 9, (3.0, 4.0))


def test_a_path_is_drawn_between_saved_states_and_ends_are_marked():
    """Chords of a spin of 1 rad a saved state would leave the curve by 12 %; farther apart it is dots."""
    tilted = np.array([np.cos(0.4), np.sin(0.4), 0, 0])
    for gap, joined in ((1.0, True), (2.8, False)):
        t = gap * np.arange(9.0)
        run = uniform(t)
        q = np.asarray(jax.vmap(li.groups.so3.multiply, (0, None))(run.state.q, jnp.asarray(tilted)))
        turning = stored(li.systems.rigid_body([1.0, 1.0, 1.0]), q, np.tile([0.0, 0.0, 1.0], (9, 1)), t)
        fig = runs.motion(turning, "a body")
        [ax] = fig.axes
        assert [text.get_text() for text in ax.get_legend().get_texts()] == ["start", "end"]
        [seen] = [line for line in ax.lines if line.get_color() == plots.BLUE and line.get_alpha() == 0.9]
        assert (seen.get_linestyle() == "-") is joined
        count = sum(np.isfinite(line.get_data_3d()[0]).sum() for line in ax.lines if line.get_color() == plots.BLUE)
        assert count > 100 if joined else count == 9
        assert ("dots" in ax.get_title()) is not joined


def test_a_gif_has_its_frames_and_they_move(store, tmp_path, capsys):
    out = tmp_path / "turn.gif"
    assert animate(store, ["--out", out, "--seconds", 0.5, "--fps", 10, "--member", 1]) == 0
    told = capsys.readouterr().out
    assert f"Rigid body, {store.name}, member 1: t = 0 … t = " in told  # neither the scheme's name nor a unit "1"
    assert "5 frames" in told
    assert re.search(r"the rest does not fit at this speed: --seconds \d+ shows all, --to T all up to T, --from", told)
    with Image.open(out) as film:
        assert film.n_frames == 5
        assert film.info["duration"] == 100
        pictures = []
        for k in range(5):
            film.seek(k)
            pictures.append(np.asarray(film.convert("RGB"), int))
    assert all(np.abs(a - b).max() > 100 for a, b in itertools.pairwise(pictures))
    assert animate(store, ["--out", out]) == 2
    assert f"{out} exists and is not overwritten; --force" in capsys.readouterr().err


def test_with_an_end_a_film_is_as_long_as_it_is_smooth(store, tmp_path, capsys):
    """At 2 frames a second, six seconds do not suffice for 4.2 rad."""
    out = tmp_path / "turn.gif"
    assert animate(store, ["--out", out, "--fps", 2, "--to", 4]) == 0
    told = capsys.readouterr().out
    assert "t = 0 … t = 4, " in told
    assert "does not fit" not in told
    with Image.open(out) as film:
        assert 15 < film.n_frames < 25
    assert animate(store, ["--out", out, "--fps", 2, "--to", 4, "--seconds", 3, "--force"]) == 0
    told = capsys.readouterr().out
    assert "t = 0 … t = 4, 6 frames" in told
    assert re.search(r"--seconds \d+ shows it smoothly", told)


class Links(html.parser.HTMLParser):
    """The addresses that a page loads something from."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "href", "data") and value]


def test_an_animated_page_needs_no_other_file(store, tmp_path):
    pytest.importorskip("plotly")
    out = tmp_path / "turn.html"
    assert animate(store, ["--out", out, "--seconds", 0.5, "--fps", 10]) == 0
    text, links = out.read_text(encoding="utf-8"), Links()
    links.feed(text)
    assert not links.found
    assert "plotly.js v" in text
    assert "Plotly.newPlot(" in text
    assert text.count('"name":"4"') == 1  # the last of five frames
    assert '"name":"5"' not in text
    assert out.stat().st_size < 7e6  # 4.9 MB, nearly all of it plotly


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "turn.avi"], "an animation is written as .gif, .mp4, .html, got turn.avi"),
        (["--out", "nowhere/turn.gif"], "the folder nowhere does not exist"),
        (["--out", "turn.gif", "--member", "2"], "the run has members 0 to 1, got --member 2"),
        (["--out", "turn.gif", "--seconds", "-1"], "the duration in seconds must be positive, got -1"),
        (["--fps", "1000000"], "6 seconds of 1000000 frames are 6000000 frames, the most are 5000"),
        (
            ["--out", "turn.gif", "--from", "3", "--to", "9"],
            "must lie in the run, from 0 to 4, in its order; got 3 to 9",
        ),
    ],
)
def test_bad_requests_are_refused_with_a_sentence(store, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert animate(store, arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_missing_packages_for_animations_are_named(store, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    assert animate(store, ["--out", tmp_path / "turn.html"]) == 2
    assert 'pip install "lieint_jax[animate]"' in capsys.readouterr().err
    monkeypatch.setattr("matplotlib.animation.FFMpegWriter.isAvailable", lambda: False)
    assert animate(store, ["--out", tmp_path / "turn.mp4"]) == 2
    assert "ffmpeg, which is not installed: install it" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.quick
def test_a_system_without_rigid_bodies_is_refused_with_the_possible_systems():
    bob = li.systems.pendulum(1.0, 9.81, [0.0, 0.0, 1.0])
    run = stored(bob, np.tile([0.0, 0.0, 1.0], (3, 1)), np.zeros((3, 3)), np.arange(3.0))
    with pytest.raises(ValueError, match=r"^Pendulum has no rigid bodies. Rigid bodies, gyrostats, tops"):
        scene.scene_of(run, "a body", 5)
    deployed = li.systems.inertia_in_time(lambda t: jnp.array([1.0, 2.0, 2.5]) + t)
    run = stored(deployed, np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), np.ones((3, 3)), np.arange(3.0))
    with pytest.raises(ValueError, match=r"^InertiaInTime has no rigid bodies"):
        scene.scene_of(run, "a body", 5)


def test_a_top_stands_on_its_tip_and_precesses_about_the_vertical():
    top = li.systems.heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, 20.0])
    start = top.state(li.groups.so3.exp(jnp.array([0.3, 0.0, 0.0])), angular_velocity=[0.0, 0.0, 50.0])
    run = all_steps(li.schemes.splitting(top), start, 0.01, 1000, save_every=5)
    found = scene.scene_of(stored(top, run.state.q, run.state.p, run.t), "a body", 60)
    corners = np.stack([found.corners(k, 0) for k in range(60)])
    np.testing.assert_array_equal(corners[:, 0], 0)
    assert corners[..., 2].min() > -1e-12  # it does not fall below the table
    assert abs(found.momenta[..., 2] - found.momenta[0, 0, 2]).max() < 1e-10  # γ·π, interpolated between saves


@pytest.mark.parametrize("dissipative", [False, True])
def test_two_bodies_are_drawn_at_their_centers(dissipative):
    """By the attitudes and positions of the run itself where a frame is at a saved state."""
    law = li.tides.constant_lag(1.0, [2.0, 1.0], [1.0, 1.0], 0.5, 0.1) if dissipative else None
    V = li.potentials.point_masses(1.0, [2.0, 1.0])
    bodies = li.systems.rigid_bodies([2.0, 1.0], [[0.5, 0.6, 0.7], [0.1, 0.2, 0.2]], V, law)
    state = bodies.state([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], angular_velocities=[[0.0, 0.1, 1.0], [0.5, 0.0, 0.3]])
    run = all_steps(li.schemes.bodies_energy_momentum(bodies), state, 0.05, 40, save_every=2)
    assert (run.state.work is not None) is dissipative
    found = scene.scene_of(stored(bodies, run.state.q, run.state.p, run.t, run.state.work), "a body", 21)
    assert len(found.solids) == 2
    np.testing.assert_allclose(found.centers, run.state.q[:, :, :3], rtol=0, atol=1e-12)
    turns = jax.jit(jax.vmap(jax.vmap(li.groups.so3.to_matrix)))(run.state.q[:, :, 3:])
    np.testing.assert_allclose(found.rotations, turns, rtol=0, atol=1e-12)
    middles = np.stack([found.corners(3, b).mean(axis=0) for b in range(2)])
    np.testing.assert_allclose(middles, found.centers[3], rtol=0, atol=1e-12)


def area(solid):
    corners = [solid.corners[list(face)] for face in solid.faces]
    return sum(np.linalg.norm(np.cross(x[1:-1] - x[0], x[2:] - x[0]), axis=1).sum() / 2 for x in corners)


def volume(solid):
    """Of a closed surface whose faces are counted by their distance from a point inside a convex solid."""
    corners = [solid.corners[list(face)] - solid.corners.mean(axis=0) for face in solid.faces]
    return sum(abs(np.linalg.det([x[0], *pair])) / 6 for x in corners for pair in itertools.pairwise(x[1:]))


@pytest.mark.quick
def test_solids_have_their_volumes_and_keep_their_surface_in_smaller_faces():
    sides = np.sin(np.pi / 12) * 12 / np.pi  # of a polygon of 24 corners, over a circle
    cylinder, ball = solids.cylinder(0.5, 3.0), solids.ellipsoid(np.array([1.0, 2.0, 3.0]))
    assert volume(solids.box(np.array([1.0, 2.0, 3.0]))) == pytest.approx(6, rel=1e-12, abs=0)
    assert volume(cylinder) == pytest.approx(sides * np.pi * 0.75, rel=1e-12, abs=0)
    assert volume(ball) == pytest.approx(8 * np.pi, rel=0.05)
    joined = solids.join([cylinder, solids.box(np.array([1.0, 2.0, 3.0]))])
    assert area(joined) == pytest.approx(area(cylinder) + 22, rel=1e-12, abs=0)
    assert max(np.ptp(joined.corners[list(face)], axis=0).max() for face in joined.faces) <= 0.25 * 3


def test_a_shape_is_drawn_about_its_center_of_mass_and_its_axes_are_compared(tmp_path):
    """A slab that lies along y, for a body whose inertia is that of a slab along x."""
    path = tmp_path / "slab.obj"
    corners = [(x, y, z) for x in (0, 1) for y in (0, 3) for z in (0, 2)]
    faces = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {face}\n" for face in faces))
    found = solids.read(path)
    np.testing.assert_allclose(found.centered().corners.min(axis=0), [-0.5, -1.5, -1.0], rtol=0, atol=1e-12)
    t = np.linspace(0, 1, 5)
    with pytest.warns(UserWarning, match=r"the principal axes of slab\.obj differ by 90° from those of the body"):
        drawn = scene.scene_of(uniform(t), "a body", 5, shapes=[found])
    np.testing.assert_allclose(
        drawn.corners(0, 0) * found.centered().size(), found.centered().corners, atol=1e-12, rtol=0
    )
    with pytest.raises(ValueError, match="--shape is given 2 times, but the number of bodies in the run is 1"):
        scene.scene_of(uniform(t), "a body", 5, shapes=[found, found])


def test_a_shape_of_triangles_is_drawn_about_its_center_of_mass(tmp_path):
    path = tmp_path / "corner.obj"
    path.write_text("v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    found = solids.read(path)
    assert len(found.solid.faces) == 4
    assert area(found.solid) == pytest.approx(24 + 8 * np.sqrt(3), rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(found.centered().corners.min(axis=0), [-1, -1, -1], rtol=0, atol=1e-12)


@pytest.mark.quick
def test_the_axes_of_a_shape_are_compared_where_moments_differ():
    c, s = np.cos(np.deg2rad(25)), np.sin(np.deg2rad(25))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    solid, zero = solids.box(np.ones(3)), np.zeros(())

    def brick(rotation):
        second = rotation @ np.diag([9.0, 4.0, 1.0]) @ rotation.T / 12
        return solids.BodyShape("brick", solid, li.shapes.Shape(zero, np.zeros(3), jnp.asarray(second), zero, zero))

    turned = brick(R)
    assert brick(np.eye(3)).tilt(np.array([1.0, 2.0, 2.5])) == pytest.approx(0, abs=1e-12)
    assert turned.tilt(np.array([1.0, 2.0, 2.5])) == pytest.approx(25, abs=1e-9)
    assert turned.tilt(np.array([1.0, 1.0, 1.5])) == pytest.approx(0, abs=1e-9)  # its own axes there are arbitrary
    assert turned.tilt(np.array([2.5, 2.0, 1.0])) == pytest.approx(90, abs=1e-9)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.off", "", r"a surface is read from a file \.obj, .* got .*a\.off"),
        ("a.stl", "solid nothing", r"a\.stl: there must be vertices and faces, got 0 and 0"),
    ],
)
def test_a_bad_file_of_a_shape_is_refused_by_its_name(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        solids.read(tmp_path / name)
    with pytest.raises(ValueError, match=r"there is no file nowhere\.obj"):
        solids.read(Path("nowhere.obj"))
