"""Pictures, videos and plots: what they show, that drawing changes nothing, what is said where it cannot be."""

import ctypes.util
import os
import re
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from conftest import make, make_system, same, slow

import multilift_marl as ml
from multilift_marl.errors import RenderingError, pip_install
from multilift_marl.rendering import CAMERAS, Renderer, VideoWriter, renderer, write_video
from multilift_marl.sim.scene import build_model

needs_gl = pytest.mark.skipif(
    not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")), reason="no OpenGL on this machine"
)


def picture(vec, env=0, **keywords):
    """Return one frame as signed numbers."""
    with Renderer(vec, **{"width": 320, "height": 180} | keywords) as renderer:
        return renderer.frame(env).astype(int)


def green(frame):
    """Return where (H, W) a picture is as green as the target."""
    red, much, blue = np.moveaxis(frame, -1, 0)
    return (much > red + 30) & (much > blue + 15)


def on_screen(renderer, points):
    """Return where points (..., 3) appear: 0 at the picture's centre, ± 1 at its edges (..., 2)."""
    camera = renderer.scene.camera[0]
    away = points - camera.pos
    depth, up = away @ camera.forward, away @ camera.up
    right = away @ np.cross(camera.forward, camera.up)
    half = np.array([camera.frustum_width, camera.frustum_top]) / camera.frustum_near
    if not half[0]:
        half[0] = half[1] * 320 / 180
    return np.stack([right / depth, up / depth], axis=-1) / half


@needs_gl
def test_a_frame_is_a_picture_of_the_size_asked_for():
    vec = make(num_envs=1)
    vec.reset(seed=0)
    with Renderer(vec) as renderer:
        frame = renderer.frame()
        assert frame.shape == (540, 960, 3) and frame.dtype == np.uint8
        assert frame.std() > 10 and len(np.unique(frame[::4, ::4].reshape(-1, 3), axis=0)) > 500
    assert picture(vec, width=401, height=301).shape == (301, 401, 3)


@pytest.mark.slow
@needs_gl
@pytest.mark.parametrize("camera", CAMERAS)
def test_frames_change_with_the_team_alone(camera):
    vec = make(num_envs=2)
    vec.reset(seed=0)
    with Renderer(vec, 320, 180, camera) as renderer:
        first, again, other = (renderer.frame(env).astype(int) for env in (0, 0, 1))
        for _ in range(25):
            vec.step(np.zeros((2, 4, 4)))
        moved = renderer.frame().astype(int)
    assert np.abs(again - first).max() < 8
    for different in (other, moved):
        assert (np.abs(different - first).max(axis=-1) > 40).sum() > 200


@pytest.mark.slow
@needs_gl
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("shape", ["box", "point"])
def test_the_target_is_seen_where_it_is(camera, shape):
    vec = make(num_envs=1, **{"payload.shape": shape})
    vec.reset(seed=0)
    vec.task.goal.position[0] = vec.world.state.payload_position[0] + [0.6, 0, 0.1]
    with Renderer(vec, 320, 180, camera) as renderer:
        shown = green(renderer.frame().astype(int))
        row, column = (np.argwhere(shown).mean(axis=0) + 0.5) / shown.shape
        x, y = on_screen(renderer, vec.task.goal.position[0])
    assert shown.sum() > (100 if shape == "box" else 15)
    assert abs(2 * column - 1 - x) < 0.08 and abs(1 - 2 * row - y) < 0.08


@needs_gl
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("num_drones", [slow(1), 4, slow(16)])
def test_the_whole_team_is_in_the_picture(camera, num_drones):
    vec = make(num_envs=1, num_drones=num_drones)
    vec.reset(seed=0)
    with Renderer(vec, 320, 180, camera) as renderer:
        for away in ([0, 0, 0], [3, 0, 0], [0, -2, 2]):
            vec.task.goal.position[0] = vec.world.state.payload_position[0] + away
            renderer.frame()
            team = np.vstack([vec.world.state.drone_position[0], vec.world.state.payload_position[0]])
            shown = on_screen(renderer, team)
            assert np.abs(shown).max() < 1
            assert np.ptp(shown, axis=0).max() > (0.35 if num_drones > 1 or camera == "side" else 0)  # and not far away


@needs_gl
def test_drawing_changes_nothing():
    vec, twin = make(num_envs=1), make(num_envs=1)
    for each in (vec, twin):
        each.reset(seed=0)
    with Renderer(vec, 64, 36) as renderer:
        for _ in range(3):
            renderer.frame()
            assert same(vec.step(np.full((1, 4, 4), 0.2)), twin.step(np.full((1, 4, 4), 0.2)))
    assert same(vec.state_dict(), twin.state_dict())


@needs_gl
def test_a_diverged_environment_is_drawn_as_it_last_was():
    vec = make(num_envs=1)
    vec.reset(seed=0)
    with Renderer(vec, 320, 180) as renderer:
        before = renderer.frame().astype(int)
        vec.world.qpos(0)[:] = np.nan
        vec.world.diverged[0] = True
        assert np.abs(renderer.frame().astype(int) - before).max() < 8


@needs_gl
def test_a_closed_renderer_and_a_wrong_name_say_so():
    vec = make(num_envs=2)
    vec.reset(seed=0)
    renderer = Renderer(vec, 64, 36)
    with pytest.raises(IndexError, match="no environment 2, only 0 to 1"):
        renderer.frame(2)
    renderer.close()
    renderer.close()
    with pytest.raises(RenderingError, match="this renderer is closed"):
        renderer.frame()
    with pytest.raises(RenderingError, match="unknown camera 'sid'; did you mean 'side'"):
        Renderer(vec, camera="sid")


@needs_gl
def test_pettingzoo_renders():
    env = ml.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert frame.shape == (540, 960, 3) and frame.dtype == np.uint8 and green(frame.astype(int)).any()
    env.close()
    env.close()
    assert env.render().shape == frame.shape  # opens anew
    env.close()


@pytest.mark.slow
@needs_gl
def test_a_machine_without_display_needs_no_settings_and_exits_quietly():
    code = (
        "import multilift_marl as ml\nfrom multilift_marl.rendering import Renderer\n"
        "vec = ml.make_vec(num_envs=1, num_threads=1)\nvec.reset(seed=0)\nrenderer = Renderer(vec, 64, 36)\n"
        "print(renderer.frame().shape)"  # and never closed
    )
    without_display = {
        key: value for key, value in os.environ.items() if key not in ("DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")
    }
    for _ in range(2):  # the first one may have to compile, and says so
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=without_display)
    assert (done.stdout, done.stderr, done.returncode) == ("(36, 64, 3)\n", "", 0)


def test_without_opengl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(RenderingError, match="run 'apt-get install libegl1 libegl-mesa0 libgl1"):
        Renderer(make(num_envs=1))


@pytest.mark.parametrize(
    "chosen, message",
    [
        (None, r"drawing by egl does not work \(no device\); run 'apt-get install"),
        ("egl", r"drawing by egl does not work \(no device\); unset MUJOCO_GL=egl"),
        ("off", "MUJOCO_GL=off forbids drawing; unset it"),
    ],
)
def test_opengl_that_does_not_work_is_named_with_its_cure(monkeypatch, chosen, message):
    def broken(name):
        assert name == "mujoco.egl"
        raise RuntimeError("no\ndevice")

    vec = make(num_envs=1)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if chosen is not None:
        monkeypatch.setenv("MUJOCO_GL", chosen)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so")
    monkeypatch.setattr(renderer.importlib, "import_module", broken)
    with pytest.raises(RenderingError, match=message):
        Renderer(vec)


@pytest.mark.parametrize("num_drones", [1, 4])
def test_what_is_drawn_has_the_same_physics(num_drones):
    system = make_system(num_drones)
    (plain, layout), (drawn, same_layout) = build_model(system), build_model(system, visuals=True)
    assert layout == same_layout and drawn.nmocap == plain.nmocap + 1
    for field in ("dof_invweight0", "tendon_invweight0", "tendon_solref_lim", "tendon_length0", "qpos0"):
        assert same(getattr(plain, field), getattr(drawn, field)), field
    states = []
    for model in (plain, drawn):
        data = mujoco.MjData(model)
        data.qvel[:] = np.random.default_rng(0).uniform(-1, 1, model.nv)
        for _ in range(250):  # to the ground, where only what may touch does
            mujoco.mj_step(model, data)
        states.append(data.qpos.copy())
    assert same(*states)


@pytest.mark.slow
@pytest.mark.parametrize("size", [pytest.param((90, 160), marks=pytest.mark.slow), (91, 161)])
def test_a_video_holds_the_frames(tmp_path, size):
    iio, av = pytest.importorskip("imageio.v3"), pytest.importorskip("av")
    ramp = np.linspace(0, 200, size[1])[None, :, None] * np.ones((*size, 3))
    frames = [(ramp + 10 * i).astype(np.uint8) for i in range(5)]
    path = tmp_path / "new" / "video.mp4"
    write_video(path, iter(frames), 25)
    read = iio.imread(path, plugin="pyav")
    assert read.shape == (5, 90, 160, 3)
    assert np.abs(read.astype(int) - np.stack(frames)[:, :90, :160]).mean() < 5
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 25)


def test_a_video_that_cannot_be_written_says_why(tmp_path, monkeypatch):
    pytest.importorskip("av")
    with pytest.raises(RenderingError, match="there are no frames"):
        write_video(tmp_path / "none.mp4", [], 25)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RenderingError, match=re.escape(f"needs av: {pip_install('train')}")):
        write_video(tmp_path / "none.mp4", [np.zeros((2, 2, 3), np.uint8)], 25)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_video_that_is_not_finished_leaves_what_was_there(tmp_path, error):
    pytest.importorskip("av")
    path, frame = tmp_path / "episode_0.mp4", np.zeros((90, 160, 3), np.uint8)
    path.write_bytes(b"an older one, whole")

    def frames():
        yield from [frame] * 3
        assert path.read_bytes() == b"an older one, whole"
        raise error

    with pytest.raises(error):
        write_video(path, frames(), 25)
    assert path.read_bytes() == b"an older one, whole" and list(tmp_path.iterdir()) == [path]
    video = VideoWriter(path, 25)
    video.append(frame)
    video.close()
    video.close()
    assert path.stat().st_size > 100 and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("num_drones, steps", [(1, 1), (8, 50)])
def test_plots_are_drawn_without_pyplot(tmp_path, monkeypatch, num_drones, steps):
    image = pytest.importorskip("matplotlib.image")
    from multilift_marl.evaluation import plots
    from multilift_marl.evaluation.rollout import Trace

    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # whoever imports it now fails
    rng = np.random.default_rng(0)
    shapes = ((steps, 3), (steps, 3), (steps, num_drones, 3), (steps,), (steps,), (steps, num_drones))
    trace = Trace(0.02 * np.arange(1, steps + 1), *(rng.uniform(0.1, 1, shape) for shape in shapes))
    rows = [  # as csv.DictReader returns them: evaluations and ended episodes only now and then
        {"frames": "512", "return": "", "success": "", "eval/return": ""},
        {"frames": "1024", "return": "12.5", "success": "0.5", "eval/success_rate": "0.25"},
        {"frames": "1536", "return": "20", "eval/success_rate": "1", "eval/payload_position_error_m": "0.02"},
    ]
    plots.plot_errors(tmp_path / "new" / "errors.png", {"first": trace, "second": trace})
    plots.plot_tensions(tmp_path / "new" / "tensions.png", trace, "title")
    plots.plot_paths(tmp_path / "new" / "paths.png", trace, "title")
    plots.plot_training(tmp_path / "new" / "training.png", rows)
    for name in ("errors", "tensions", "paths", "training"):
        pixels = image.imread(tmp_path / "new" / f"{name}.png")
        assert min(pixels.shape[:2]) > 400 and pixels[..., :3].std() > 0.02


def test_every_line_of_the_training_plot_is_its_column(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    from multilift_marl.evaluation import plots

    drawn = []
    monkeypatch.setattr(plots, "_save", lambda figure, path, pdf: drawn.append(figure))
    rows = [{"frames": "100", "success": "0.5", "return": "7", "eval/payload_position_error_m": ""}]
    rows += [{"frames": 200.0, "eval/success_rate": 1.0, "eval/payload_position_error_m": 0.03, "eval/return": 9.0}]
    plots.plot_training(tmp_path / "training.png", rows)
    success, error, total, paid = drawn[0].axes
    assert [line.get_xydata().tolist() for line in success.lines] == [[[100, 50]], [[200, 100]]]
    assert [line.get_xydata().tolist() for line in error.lines] == [[[200, 3]]]
    assert [line.get_xydata().tolist() for line in total.lines] == [[[200, 9]]]
    assert [line.get_xydata().tolist() for line in paid.lines] == [[[100, 7]]]
    assert error.get_ylabel() == "position error [cm]"
    rows = [row | {"eval/payload_rmse_m": 0.05} for row in rows[1:]]  # as those of every task
    plots.plot_training(tmp_path / "training.png", rows)
    assert drawn[1].axes[1].get_ylabel() == "position error [cm]"
    plots.plot_training(tmp_path / "training.png", rows, metric="payload_rmse_m")
    error = drawn[2].axes[1]  # of `track`, whose policies are compared by the RMSE
    assert [line.get_xydata().tolist() for line in error.lines] == [[[200, 5]]] and error.get_ylabel() == "RMSE [cm]"
