"""What is drawn of a flight: MuJoCo's geoms as markers in the frames of their bodies, scenery, and cables."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from rosbags.typesys.store import Typestore

from multilift_marl.deploy.ros.types import WORLD, make_header
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.math3d import mat_to_quat
from multilift_marl.rig import obstacles as kinds
from multilift_marl.sim.obstacle_bodies import hull_name
from multilift_marl.sim.scene import build_model

MARKER, MARKERS = "visualization_msgs/msg/Marker", "visualization_msgs/msg/MarkerArray"
CUBE, SPHERE, CYLINDER, LINES, TRIANGLES = 1, 2, 3, 5, 11  # kinds of markers
_ADD, _DELETE_ALL = 0, 3  # what becomes of them
_CABLE = 0.01  # [m] width
_CABLE_COLOUR = (0.1, 0.1, 0.1, 1.0)
_EVERY = 1_000_000_000  # [ns] after which a scene is due again, for those who came late
_HEAVY = 10_000  # points of a scene that is sent but once an episode
_GEOM = mujoco.mjtGeom


class Scene:
    """Markers of environment 0.

    Bodies are drawn in their own frames, to which viewers lock them (`frame_locked`): they need be sent but seldom.
    The ground is not drawn; viewers have grids.

    Args:
        vec: the environments.
        store: types of a ROS distribution.
        frames: of the drones.
    """

    def __init__(self, vec: MultiliftVec, store: Typestore, frames: list[str]):
        self._vec, self._store = vec, store
        bodies = {"payload": "payload"} | {f"drone_{n}": frame for n, frame in enumerate(frames)}
        self._model, _ = build_model(vec.world.system, visuals=True)
        model = self._model
        self._bodies = [
            marker
            for geom in range(model.ngeom)
            if (name := model.body(model.geom_bodyid[geom]).name) in bodies and model.geom_rgba[geom, 3] > 0
            for marker in self._draw(model, geom, bodies[name])
        ]
        self._number_markers(self._bodies)
        self._is_heavy = sum(len(marker.points) for marker in self._bodies) > _HEAVY
        self._sent: tuple[int, int, int] | None = None  # seed and episode, and when [ns]

    def is_due(self, time_ns: int) -> bool:
        """Whether the scene is to be sent at a time [ns]: at the start of an episode, and each second of it."""
        vec = self._vec
        episode = int(vec.seeds[0]), int(vec.episodes[0])
        if self._sent is None or episode != self._sent[:2]:
            return True
        return not self._is_heavy and not 0 <= time_ns - self._sent[2] < _EVERY

    def bodies(self, time_ns: int) -> Any:
        """Return the MarkerArray of payload, drones and scenery, in place of all that was drawn."""
        self._sent = int(self._vec.seeds[0]), int(self._vec.episodes[0]), time_ns
        scenery = self._scenery()
        clear = self._marker(WORLD, CUBE, np.ones(3), (0, 0, 0, 0))
        clear.action = _DELETE_ALL
        markers = [clear, *self._bodies, *scenery]
        for marker in markers:
            marker.header.stamp = make_header(self._store, time_ns).stamp
        return self._store.types[MARKERS](markers=markers)

    def cables(self, time_ns: int) -> Any:
        """Return the MarkerArray of cables and moving obstacles as they are, in the world."""
        world = self._vec.world
        ends = []
        for n in range(self._vec.num_drones):
            points = world.cable_points(0, n)
            ends.append(np.stack([points[:-1], points[1:]], axis=1).reshape(-1, 3))
        lines = self._marker(WORLD, LINES, np.array([_CABLE, 0.0, 0.0]), _CABLE_COLOUR, ns="cables")
        lines.points = self._points(np.concatenate(ends))
        moving = self._scenery() if self._vec.world.obstacles.travel[0].any() else []
        for marker in (lines, *moving):
            marker.header.stamp = make_header(self._store, time_ns).stamp
        return self._store.types[MARKERS](markers=[lines, *moving])

    def _scenery(self) -> list[Any]:
        """Return the markers of all that stands around, as it is now."""
        forms, model, markers = {kinds.BOX: CUBE, kinds.CYLINDER: CYLINDER, kinds.SPHERE: SPHERE}, self._model, []
        for box in self._vec.task.scenery(0):
            turned = mat_to_quat(box.rotation)
            if box.kind != kinds.HULL:
                kind, scale = forms[box.kind], 2 * np.array(box.size)
                markers.append(self._marker(WORLD, kind, scale, box.rgba, box.position, turned, ns="scenery"))
                continue
            marker = self._marker(WORLD, TRIANGLES, np.ones(3), box.rgba, box.position, turned, ns="scenery")
            mesh = model.mesh(hull_name(box.hull)).id
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, model.mesh_quat[mesh])  # back from the principal axes
            marker.points = self._points(_triangles(model, mesh) @ own.reshape(3, 3).T + model.mesh_pos[mesh])
            markers.append(marker)
        self._number_markers(markers)
        return markers

    def _draw(self, model: mujoco.MjModel, geom: int, frame: str) -> list[Any]:
        """Return the markers of a geom in the frame of its body."""
        kind, size, colour = model.geom_type[geom], model.geom_size[geom], model.geom_rgba[geom]
        place: tuple[np.ndarray, np.ndarray] = model.geom_pos[geom], model.geom_quat[geom]
        if kind == _GEOM.mjGEOM_MESH:
            marker = self._marker(frame, TRIANGLES, np.ones(3), colour, *place)
            marker.points = self._points(_triangles(model, model.geom_dataid[geom]))
            return [marker]
        if kind == _GEOM.mjGEOM_CAPSULE:
            axis = np.zeros(3)
            # MuJoCo's capsule lies along its z axis, half its length to either side, and ends in balls.
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, size[1]]), place[1])
            ball = np.full(3, 2 * size[0])
            ends = [self._marker(frame, SPHERE, ball, colour, place[0] + end) for end in (axis, -axis)]
            return [self._marker(frame, CYLINDER, 2 * size[[0, 0, 1]], colour, *place), *ends]
        shapes = {
            _GEOM.mjGEOM_BOX: (CUBE, size), _GEOM.mjGEOM_ELLIPSOID: (SPHERE, size),
            _GEOM.mjGEOM_SPHERE: (SPHERE, size[[0, 0, 0]]), _GEOM.mjGEOM_CYLINDER: (CYLINDER, size[[0, 0, 1]]),
        }  # fmt: skip
        # MuJoCo has half edges and radii, markers edges and diameters.
        shape, half = shapes[_GEOM(kind)]
        return [self._marker(frame, shape, 2 * half, colour, *place)]

    @staticmethod
    def _number_markers(markers: list[Any]) -> None:
        for number, marker in enumerate(markers):
            marker.id = number

    def _points(self, points: np.ndarray) -> list[Any]:
        point = self._store.types["geometry_msgs/msg/Point"]
        return [point(x=x, y=y, z=z) for x, y, z in points.tolist()]

    def _marker(
        self, frame: str, kind: int, scale: np.ndarray, colour: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0), ns: str = "team",
    ) -> Any:  # fmt: skip
        """Return a marker of edges, diameters or a width `scale` [m] in a frame, to which it stays locked."""
        types, header = self._store.types, make_header(self._store, 0)
        header.frame_id = frame
        red, green, blue, alpha = np.asarray(colour, float).tolist()
        w, x, y, z = np.asarray(quaternion, float).tolist()
        vector, place = (dict(zip("xyz", np.asarray(each, float).tolist(), strict=True)) for each in (scale, position))
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](**place),
            orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )
        nothing = np.zeros(0, np.uint8)
        return types[MARKER](
            header=header, ns=ns, id=0, type=kind, action=_ADD, pose=pose, frame_locked=True,
            scale=types["geometry_msgs/msg/Vector3"](**vector),
            color=types["std_msgs/msg/ColorRGBA"](r=red, g=green, b=blue, a=alpha),
            lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0), points=[], colors=[],
            texture_resource="", uv_coordinates=[], text="", mesh_resource="", mesh_use_embedded_materials=False,
            texture=types["sensor_msgs/msg/CompressedImage"](header=header, format="", data=nothing),
            mesh_file=types["visualization_msgs/msg/MeshFile"](filename="", data=nothing),
        )  # fmt: skip


def _triangles(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Return the corners (3 F, 3) [m] of a mesh's F triangles, in the frame of its geom."""
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    return np.asarray(vertices[faces.ravel()], float)
