"""The page in the browser: the scene of `rendering.Stage` and the controls of a `Session`, on the loopback alone."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import time
from typing import Any

import mujoco
import numpy as np

from multilift_marl.errors import RenderingError, pip_install
from multilift_marl.rendering import Stage
from multilift_marl.viewer.draft import DraftSession
from multilift_marl.viewer.guard import Guard, guarded_servers
from multilift_marl.viewer.inputs import filter_inputs
from multilift_marl.viewer.live import LiveSession
from multilift_marl.viewer.session import Session

HOST = "127.0.0.1"
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_FRAME = 1 / 25  # [s]
_TRAIL = 2.0  # [s]
_GAMMA = 2.2  # browsers take the colours of batched meshes for linear light, not for sRGB
_AMBIENT = 1.5  # light from all around
_GEOM = mujoco.mjtGeom
_SLOTS = 64  # geoms of one shape that are sent at first; doubled as needed


class Page:
    """Serves a session on 127.0.0.1, to those who have its address.

    Args:
        session: the simulation to watch, a flight elsewhere, or a rig that is refused, which has no controls.
        port: on which; 0 for any free one.

    Attributes:
        port: on which it is served.
        address: to be opened in a browser, with a token that is printed only here.
        controls: buttons and fields by name, viser's handles.

    Raises:
        RenderingError: viser is not installed, or the port is taken.
    """

    def __init__(self, session: Session | LiveSession | DraftSession, port: int = 8080):
        try:
            import trimesh
            import viser
        except ImportError as error:
            raise RenderingError(f"the browser viewer needs {error.name}: {pip_install('view')}") from error
        self._session = session
        self._shapes = trimesh.creation
        self._stage = Stage(session.vec, trail=_TRAIL)
        _check_port(port)
        guard = Guard()
        # Browsers open connections that they do not use, each of which would be a traceback.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        with contextlib.redirect_stdout(io.StringIO()), guarded_servers(guard):  # stdout: viser's own greeting
            self._server = viser.ViserServer(HOST, port, label="multilift_marl", verbose=False)
        filter_inputs(self._server)
        self.port = self._server.get_port()
        self.address = f"http://{HOST}:{self.port}/?token={guard.token}"
        if port not in (0, self.port):  # taken in the meantime: viser goes on to the next one
            self.close()
            raise _taken(port)
        self._batches: dict[tuple[int, int, bool], _Batch] = {}
        self._follow = True
        self._middle = session.vec.world.state.payload_position[0].copy()
        self._stage.update(0)
        self._build()
        self.draw()
        self.controls = self._add_controls()

    def run(self) -> None:
        """Simulate and show until interrupted."""
        last = time.perf_counter()
        while True:
            now = time.perf_counter()
            self._session.advance(now - last)
            last = now
            self.draw()
            time.sleep(max(0.0, _FRAME - (time.perf_counter() - now)))

    def draw(self) -> None:
        """Send what has changed to all browsers."""
        # Under the lock only what reads the simulation; to send takes as long as browsers do.
        with self._session.locked():
            self._stage.update(0)
            if self._follow:
                self._middle = self._session.vec.world.state.payload_position[0].copy()
            groups = _group(self._stage.scene)
        with self._server.atomic():
            # Shapes of which there is none any more count, too, or the last ones would stay in the picture.
            for key in self._batches.keys() | groups.keys():
                if key not in self._batches:
                    kind, mesh, clear = key
                    name = f"/world/{kind}_{mesh}_{'clear' if clear else 'solid'}"
                    self._batches[key] = _Batch(self._server, name, self._mesh(kind, mesh), clear)
                self._batches[key].show(groups.get(key))
            self._world.position = tuple(-self._middle)
        # The first picture comes before the controls, which are added last.
        if hasattr(self, "controls"):
            text = self._session.status()
            if text != self.controls["status"].content:
                self.controls["status"].content = text

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _build(self) -> None:
        server = self._server
        camera = self._stage.camera.view
        server.gui.configure_theme(show_share_button=False, show_logo=False)
        server.scene.configure_environment_map(None)  # its reflections wash the colours out
        server.scene.add_light_ambient("/light", intensity=_AMBIENT)
        self._world = server.scene.add_frame("/world", show_axes=False)  # moves against the payload that is followed
        server.scene.add_grid(
            "/world/floor", 60.0, 60.0, cell_size=1.0, cell_color=(205, 210, 216), section_size=5.0,
            section_color=(165, 172, 180), plane_color=(226, 229, 233), plane_opacity=1.0, fade_distance=60.0,
        )  # fmt: skip
        lift = camera.lookat - self._session.vec.task.goal.position[0]
        server.initial_camera.look_at = (0.0, 0.0, lift[2])
        server.initial_camera.position = (*(camera.distance * np.array([-0.6, -1.0])), lift[2] + 0.45 * camera.distance)
        server.initial_camera.fov = np.deg2rad(45.0)

    def _add_controls(self) -> dict[str, Any]:
        """Add buttons and fields, and tie them to the session."""
        gui = self._server.gui
        session = self._session
        made: dict[str, Any] = {"status": gui.add_markdown(session.status())}
        if isinstance(session, DraftSession):
            return made
        if isinstance(session, LiveSession):
            made["follow"] = self._add_follow()
            return made
        weight = session.vec.world.system.payload_mass * 9.81
        made["pause"] = gui.add_button("Pause")
        made["step"] = gui.add_button("One step")
        made["reset"] = gui.add_button("Reset", hint="the same episode from its start")
        made["next"] = gui.add_button("Next episode")
        made["speed"] = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
        made["policy"] = gui.add_dropdown("Policy", session.policies, initial_value=session.policy)
        made["follow"] = self._add_follow()
        with gui.add_folder("Push on the payload"):
            made["heading"] = gui.add_slider("Heading [°]", -180, 180, 5, 0)
            made["elevation"] = gui.add_slider("Elevation [°]", -90, 90, 5, 0)
            made["force"] = gui.add_slider(
                "Force [N]", 0.0, _round(2 * weight), _round(weight / 50), _round(weight / 4)
            )
            made["push"] = gui.add_button("Push for half a second")
        for name in ("pause", "step", "reset", "next", "push"):
            # `name=name` keeps each button's own; a name looked up later would be the loop's last for all.
            made[name].on_click(lambda _, name=name: self.press(name))
        for name in ("speed", "policy"):
            made[name].on_update(lambda _, name=name: self.press(name))
        return made

    def _add_follow(self) -> Any:
        box = self._server.gui.add_checkbox("Follow the payload", initial_value=True)
        box.on_update(lambda _: self.press("follow"))
        return box

    def press(self, name: str) -> None:
        """Execute the control `name` with the present values of the fields."""
        session = self._session
        if name == "follow":
            self._follow = self._value("follow")
            return
        assert isinstance(session, Session)  # others have no more controls
        if name == "pause":
            session.paused = not session.paused
            self.controls["pause"].label = "Go on" if session.paused else "Pause"
        elif name == "step":
            session.step()
        elif name == "reset":
            session.reset()
        elif name == "next":
            session.skip()
        elif name == "push":
            session.push(self._value("heading"), self._value("elevation"), self._value("force"))
        elif name == "speed":
            session.speed = float(self._value("speed"))
        else:
            session.choose(self._value("policy"))

    def _value(self, field: str) -> Any:
        return self.controls[field].value

    def _mesh(self, kind: int, dataid: int) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices and faces of a geom of unit size; `dataid` says which mesh."""
        if kind == _GEOM.mjGEOM_MESH:
            # MuJoCo numbers each mesh and its hull
            model = self._stage.model
            mesh = dataid // 2
            points = int(model.mesh_vertadr[mesh])
            faces = int(model.mesh_faceadr[mesh])
            ends = points + int(model.mesh_vertnum[mesh]), faces + int(model.mesh_facenum[mesh])
            return model.mesh_vert[points : ends[0]], model.mesh_face[faces : ends[1]]
        if kind == _GEOM.mjGEOM_BOX:
            mesh = self._shapes.box(extents=(2, 2, 2))
        elif kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
            mesh = self._shapes.icosphere(subdivisions=2)
        else:
            mesh = self._shapes.cylinder(radius=1.0, height=2.0, sections=16)
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)


class _Batch:
    """All geoms of one shape, solid or translucent, as one batch of viser."""

    def __init__(self, server: Any, name: str, mesh: tuple[np.ndarray, np.ndarray], clear: bool):
        self._server = server
        self._name = name
        self._mesh = mesh
        self._clear = clear
        self._slots = 0
        self._handle: Any = None
        self._shown: dict[str, np.ndarray] | None = None

    def show(self, geoms: tuple[np.ndarray, ...] | None) -> None:
        """Show geoms: positions (K, 3), quaternions (K, 4), sizes (K, 3), colours (K, 4); None for none."""
        if geoms is None:
            geoms = tuple(np.zeros((0, width), np.float32) for width in (3, 4, 3, 4))
        count = len(geoms[0])
        if self._handle is None or count > self._slots:
            # A batch keeps its number of geoms: one with twice as many takes its place, so that this is seldom done.
            self._slots = max(self._slots, _SLOTS)
            while self._slots < count:
                self._slots *= 2
            self._shown = None
            if self._handle is not None:
                self._handle.remove()
        spare = self._slots - count  # of no size
        place, turn, size, colour = (np.pad(array, ((0, spare), (0, 0))) for array in geoms)
        # No turn: a quaternion of zeros is no rotation.
        turn[count:, 0] = 1.0
        colours = np.rint(255 * np.clip(colour[:, :3], 0, 1) ** _GAMMA).astype(np.uint8)
        opacity = colour[:, 3]
        values = {"positions": place, "wxyzs": turn, "scales": size, "colors": colours}
        if self._clear:
            values["opacities"] = opacity
        if self._shown is None:
            self._handle = self._server.scene.add_batched_meshes_simple(
                f"{self._name}_{self._slots}", *self._mesh, turn, place, batched_scales=size, batched_colors=colours,
                batched_opacities=values.get("opacities"), lod="off", flat_shading=True, cast_shadow=not self._clear,
            )  # fmt: skip
        else:
            for key, value in values.items():
                if not np.array_equal(value, self._shown[key]):
                    setattr(self._handle, f"batched_{key}", value)
        self._shown = values


def _group(scene: mujoco.MjvScene) -> dict[tuple[int, int, bool], tuple[np.ndarray, ...]]:
    """Return the geoms of `scene` by shape, (type, mesh, clear): positions, quaternions, sizes, colours (K, …)."""
    rows: dict[tuple[int, int, bool], list[np.ndarray]] = {}
    quat = np.zeros(4)
    for geom in scene.geoms[: scene.ngeom]:
        kind = int(geom.type)
        if kind == _GEOM.mjGEOM_PLANE or geom.rgba[3] == 0.0:
            continue
        clear = bool(geom.rgba[3] < 1.0)
        # Capsules are shown without their caps. A geom that is no mesh has no number of one, hence -1.
        key = (int(_GEOM.mjGEOM_CYLINDER) if kind == _GEOM.mjGEOM_CAPSULE else kind, -1, clear)
        size = geom.size
        if kind == _GEOM.mjGEOM_MESH:
            key = (kind, geom.dataid, clear)
            size = np.ones(3)
        mujoco.mju_mat2Quat(quat, np.asarray(geom.mat, float).ravel())
        rows.setdefault(key, []).append(np.concatenate([geom.pos, quat, size, geom.rgba]))
    tables = {key: np.array(lines, np.float32) for key, lines in rows.items()}
    return {key: tuple(np.split(table, (3, 7, 10), axis=1)) for key, table in tables.items()}


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise _taken(port) from error


def _taken(port: int) -> RenderingError:
    return RenderingError(f"port {port} of {HOST} is taken or not allowed; give another by port=, or port=0 for any")


def _round(number: float) -> float:
    """Return a number with two digits, as a slider's step."""
    return float(f"{number:.1e}")
