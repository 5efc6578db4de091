"""The window of render_mode="human": its error without a display, and the states that it shows."""

import os
import shutil
import subprocess
import sys

import pytest
from conftest import slow

from multilift_marl.envs import multilift_v0
from multilift_marl.envs.gymnasium_env import MultiliftGymnasiumEnv

WATCH = """
import sys, time, warnings
import numpy as np
from multilift_marl.envs import multilift_v0

env = multilift_v0.parallel_env(render_mode="human", **{"env.num_threads": 1})
env.reset(seed=0)
window = env._pictures._window
start = time.perf_counter()
for _ in range(10):
    env.step({agent: np.zeros(4) for agent in env.agents})
print("in step with the clock", time.perf_counter() - start >= 8 * env.vec.task.dt)
print("drawn", window.stage.scene.ngeom > 50, env.render() is None)
middle = window.stage.camera.view.azimuth
window._turned[0], window._zoom = 90.0, 0.5
window.show()
seen = window.stage.scene.camera[0]
print("turned", abs(seen.forward[1]) < 0.2 and window.stage.camera.view.azimuth == middle)
window._glfw.set_window_should_close(window._window, True)
env.step({agent: np.zeros(4) for agent in env.agents})
env.step({agent: np.zeros(4) for agent in env.agents})
print("closed", not window.is_open, env.agents != [])
env.close()
"""


# Pictures by EGL and a window by GLX, in turn in one thread, the first of either kind.
BOTH = """
import numpy as np
from multilift_marl.envs import multilift_v0

def make(mode):
    env = multilift_v0.parallel_env(render_mode=mode, **{"env.num_threads": 1})
    env.reset(seed=0)
    return env

pictures = make("rgb_array") if "pictures" == %r else None
first = None if pictures is None else pictures.render()
shown = make("human")
shown.step({agent: np.zeros(4) for agent in shown.agents})
pictures = pictures or make("rgb_array")
first = pictures.render() if first is None else first
shown.step({agent: np.zeros(4) for agent in shown.agents})
print("the same", np.abs(pictures.render().astype(int) - first).max() < 4, first.std() > 5)
shown.close()
print("afterwards", np.abs(pictures.render().astype(int) - first).max() < 4)
pictures.close()
"""


def without_display(**more):
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR")
    return {key: value for key, value in os.environ.items() if key not in hidden} | more


@pytest.mark.parametrize("api", ["multilift_v0.parallel_env", slow("MultiliftGymnasiumEnv")])
def test_without_a_display_one_sentence_names_the_alternatives(api):
    code = (
        "from multilift_marl.envs import multilift_v0\n"
        "from multilift_marl.envs.gymnasium_env import MultiliftGymnasiumEnv\n"
        "from multilift_marl.errors import RenderingError\n"
        f"env = {api}(render_mode='human')\n"
        "try:\n    env.reset(seed=0)\nexcept RenderingError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=without_display())
    assert done.stdout.startswith("there is no display to open a window on; use render_mode"), done.stderr
    assert "python -m multilift_marl.view" in done.stdout and done.stdout.count("\n") == 1 and not done.stderr


def test_both_single_team_apis_offer_it():
    for api in (multilift_v0.MultiliftParallelEnv, MultiliftGymnasiumEnv):
        assert api.metadata["render_modes"] == ["rgb_array", "human"]


def on_screen(code, screen="1280x720x24"):
    command = ["xvfb-run", "-a", "-s", f"-screen 0 {screen}", sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env=without_display())


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("xvfb-run"), reason="no virtual display on this machine")
@pytest.mark.parametrize("first", ["pictures", "window"])
def test_a_window_and_pictures_can_be_drawn_in_turn(first):
    done = on_screen(BOTH % first)
    assert done.stdout.splitlines() == ["the same True True", "afterwards True"], done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("xvfb-run"), reason="no virtual display on this machine")
def test_a_display_without_opengl_is_refused_in_a_sentence():
    code = (
        "from multilift_marl.envs import multilift_v0\n"
        "from multilift_marl.errors import RenderingError\n"
        "try:\n    multilift_v0.parallel_env(render_mode='human').reset(seed=0)\n"
        "except RenderingError as error:\n    print(error)\n"
    )
    done = on_screen(code, "1280x720x24 -extension GLX")
    assert "; use render_mode" in done.stdout and done.stdout.count("\n") == 1, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("xvfb-run"), reason="no virtual display on this machine")
def test_a_window_shows_every_step():
    done = on_screen(WATCH)
    expected = ["in step with the clock True", "drawn True True", "turned True", "closed True True"]
    assert done.stdout.splitlines() == expected, done.stderr
