"""The viewer's page in a real browser, headless: what is drawn, and that its buttons reach the flight."""

import base64
import json
import shutil
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="no browser: apt-get install chromium"),
    pytest.mark.timeout(240),  # compiling comes on top where nothing is compiled yet
]
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--window-size=1280,800", "--remote-debugging-port=0",
)  # fmt: skip
AT_REST = (
    "task_options.start_radius=0", "task_options.start_tilt=0", "task_options.start_speed=0",
    "randomization.payload_mass=0", "randomization.payload_force=0",
)  # fmt: skip
PANEL, NOTE = 940, 150  # [px] where the controls begin, where the note on software rendering ends
COLOURS = {  # hues [deg] and least pixels
    "payload": (25, 75, 1000), "target": (130, 170, 100), "cables": (210, 240, 100), "the pink drone": (300, 340, 50),
    "the light blue drone": (190, 205, 100),
}  # fmt: skip


class Tab:
    """A page in the browser, spoken to by the DevTools protocol."""

    def __init__(self, address):
        from websockets.sync.client import connect

        self._socket, self._calls = connect(address, max_size=None), 0

    def call(self, method, **parameters):
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while (answer := json.loads(self._socket.recv(timeout=30))).get("id") != self._calls:
            pass  # an event
        return answer["result"]

    def run(self, script):
        return self.call("Runtime.evaluate", expression=script)["result"].get("value")

    def text(self):
        return self.run("document.body ? document.body.innerText : ''")

    def wait(self, *words):
        """Wait until the page holds all words, and return its text."""
        deadline = time.time() + 30
        while not all(word in (text := self.text()) for word in words):
            assert time.time() < deadline, f"{words} not in {text}"
            time.sleep(0.05)
        return text

    def press(self, label):
        find = "[...document.querySelectorAll('button')].find(button => button.innerText.trim() === %s).click()"
        self.run(find % json.dumps(label))

    def picture(self):
        """Return the page as it looks (H, W, 3) uint8."""
        import imageio.v3 as iio

        return iio.imread(base64.b64decode(self.call("Page.captureScreenshot")["data"]))[..., :3]


def first(find, process, seconds):
    """Return what `find` finds, as soon as it does, while a process runs."""
    deadline = time.time() + seconds
    while not (found := find()):
        assert process.poll() is None and time.time() < deadline
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    pytest.importorskip("viser")
    folder, running = tmp_path_factory.mktemp("browser"), []
    try:
        watch = [sys.executable, "-m", "multilift_marl.view", "task=hover", "port=0", *AT_REST]
        with open(folder / "viewer", "w+") as said:
            running.append(subprocess.Popen(watch, stdout=said))
        words = first(lambda: (folder / "viewer").read_text().partition("http://")[2].split(), running[0], 200)
        command = [BROWSER, *FLAGS, f"--user-data-dir={folder}", f"http://{words[0]}"]
        running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        port = first(lambda: _lines(folder / "DevToolsActivePort"), running[1], 30)[0]
        pages = first(lambda: _pages(port), running[1], 30)
        yield Tab(pages[0]["webSocketDebuggerUrl"])
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=30)


def _lines(path):
    return path.read_text().splitlines() if path.is_file() else []


def _pages(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
        return [page for page in json.load(answer) if page["type"] == "page"]


@pytest.mark.slow
def test_the_panel_holds_every_control(tab):
    tab.wait(
        "hover, 4 drones, episode ", "Pause", "One step", "Reset", "Next episode", "Speed", "Policy",
        "Follow the payload", "Push on the payload", "Heading", "Elevation", "Force", "Push for half a second",
    )  # fmt: skip


@pytest.mark.slow
def test_the_scene_shows_payload_target_cables_and_drones(tab):
    tab.wait("of 8 s")
    hold(tab)
    scene = tab.picture()[NOTE:, :PANEL].astype(float)
    shades = len(np.unique(scene.reshape(-1, 3), axis=0))
    assert shades > 500, shades  # light, shadow and distance; a blank page has a few
    strong, hue = np.ptp(scene, axis=2) > 50, hues(scene)
    for name, (low, high, least) in COLOURS.items():
        found = int((strong & (hue > low) & (hue < high)).sum())
        assert found >= least, f"{found} pixels of {name}"


@pytest.mark.slow
def test_a_push_by_its_button_moves_the_payload_in_the_picture(tab):
    tab.wait("of 8 s")
    hold(tab)
    before, text = tab.picture(), tab.text()
    assert "payload 0.0 cm and" in text and "0.0 of 8 s" in text, "the clock stands still"
    tab.press("Push for half a second")
    while "payload 0." in tab.text():  # until it is 1 cm off, some 5 steps
        tab.press("One step")
        time.sleep(0.06)  # the page sends no more than 20 clicks a second
    assert np.ptp([before, tab.picture()], axis=0)[NOTE:, :PANEL].any()
    tab.press("Go on")
    tab.wait("Pause")


def hold(tab):
    """Stop the clock at the start of an episode."""
    if "Pause" in tab.text().splitlines():
        tab.press("Pause")
    tab.wait("Go on")
    tab.press("Reset")
    tab.wait("0.0 of 8 s")


def hues(picture):
    """Return the hue of each pixel [deg]."""
    red, green, blue = np.moveaxis(picture, 2, 0)
    return np.rad2deg(np.arctan2(np.sqrt(3) * (green - blue), 2 * red - green - blue)) % 360
