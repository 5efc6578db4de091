"""The scene of a picture: bodies, target, cables coloured by tension, trails, the target's path, scenery."""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np

from multilift_marl.math3d import mat_to_quat
from multilift_marl.rendering.cameras import Camera, Environments
from multilift_marl.rendering.draft import Draft
from multilift_marl.rendering.overlays import Trail, add_box, add_lines, dashes, tension_colours
from multilift_marl.sim.scene import DRONE_COLOURS, PAYLOAD_COLOUR, build_model

_MAX_GEOMS = 20_000
_CABLE, _LINE, _DASH = 0.0013, 0.0011, 0.016  # radii and length, over the camera's distance: visible from anywhere
_GLOW = 0.5  # of cables, so that light and shade change their colour less
_PATH_COLOUR = (0.0, 0.60, 0.25, 0.9)
_TRAIL_STRENGTH = 0.75


class Stage:
    """One environment as MuJoCo's abstract scene, for which no OpenGL is needed.

    Args:
        vec: the environments; they are only read.
        camera: one of `cameras.CAMERAS`.
        aspect: width over height of the picture.
        trail: seconds of flight that payload and drones draw behind them; 0 for none.

    Attributes:
        model, data: the same system with `visuals`, in the state last shown.
        scene: what there is to draw.
        camera: from where.

    Raises:
        RenderingError: an unknown camera.
    """

    def __init__(self, vec: Environments, camera: str = "side", aspect: float = 16 / 9, trail: float = 0.0):
        self._vec = vec
        system = vec.world.system
        self.model, _ = build_model(system, visuals=True)
        if isinstance(vec, Draft):
            vec.mark(self.model)
        self.data = mujoco.MjData(self.model)
        self.camera = Camera(vec, self.model, camera, aspect)
        self.scene = mujoco.MjvScene(self.model, maxgeom=_MAX_GEOMS)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = camera != "top"
        self._option = mujoco.MjvOption()
        self._target = self.model.body("target").id
        self._trail = Trail(trail)
        self._episode = (-1, -1, -1)
        self._time = 0.0
        colours = [DRONE_COLOURS[n % len(DRONE_COLOURS)] for n in range(vec.num_drones)]
        self._trail_colours = np.array([PAYLOAD_COLOUR, *colours]) * [1, 1, 1, _TRAIL_STRENGTH]
        self._colours = np.zeros((vec.num_drones, 4), np.float32)
        fog = self.model.vis.map  # as far away as the camera may be
        far = max(1.0, self.camera.view.distance / 6.0)
        fog.fogstart *= far
        fog.fogend *= far

    def update(self, env: int, move_camera: Callable[[mujoco.MjvCamera], None] | None = None) -> None:
        """Show environment `env` as it is now; one that has diverged stays as last shown.

        Args:
            env: which.
            move_camera: called with a copy of the camera, to take the picture from elsewhere.
        """
        vec = self._vec
        time = float(vec.steps[env]) * vec.task.dt
        episode = (env, int(vec.seeds[env]), int(vec.episodes[env]))
        if episode != self._episode or time < self._time:
            self._trail.clear()
            self.camera.start(env)
        self._episode = episode
        self._time = time
        path = vec.task.target_path(env)
        self._pose(env)
        self.camera.aim(env, path)
        view = self.camera.view
        if move_camera is not None:
            view = copy.copy(view)
            move_camera(view)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, view, everything, self.scene)
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_TENDON:
                geom.emission = _GLOW
            elif geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                if self.model.geom_bodyid[geom.objid] in (0, self._target):
                    geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
        self._add_overlays(env, time, path)

    def _pose(self, env: int) -> None:
        world = self._vec.world
        goal = self._vec.task.goal
        if not world.diverged[env]:
            self.data.qpos[:] = world.qpos(env)
        colours = tension_colours(world.state.cable_tension[env], world.system.resting_tension)
        self._colours[:, :3] = colours
        self._colours[:, 3] = 1.0
        if self.model.ntendon:
            self.model.tendon_width[:] = _CABLE * self.camera.view.distance
            self.model.tendon_rgba[:, :3] = colours
            self.model.tendon_rgba[:, 3] = ~world.state.cable_broken[env]
        self.data.mocap_pos[0] = goal.position[env]
        self.data.mocap_quat[0] = mat_to_quat(tuple(goal.rotation[env].ravel()))
        mujoco.mj_fwdPosition(self.model, self.data)

    def _add_overlays(self, env: int, time: float, path: np.ndarray) -> None:
        task = self._vec.task
        state = self._vec.world.state
        scene = self.scene
        line = _LINE * self.camera.view.distance
        dash = _DASH * self.camera.view.distance
        if self._vec.world.nodes is not None and not self._vec.world.diverged[env]:
            radius = _CABLE * self.camera.view.distance
            for n, colour in enumerate(self._colours):
                points = self._vec.world.cable_points(env, n)
                add_lines(scene, points[:-1], points[1:], radius, np.tile(colour, (len(points) - 1, 1)), _GLOW)
        for box in task.scenery(env):
            add_box(scene, box, self.model)
        if len(path):
            starts, ends = dashes(path, dash)
            add_lines(scene, starts, ends, line, np.tile(np.array(_PATH_COLOUR, np.float32), (len(starts), 1)))
        if self._trail.seconds > 0 and not self._vec.world.diverged[env]:
            bodies = np.vstack([state.payload_position[env], state.drone_position[env]])
            self._trail.add(time, bodies)
            self._trail.draw(scene, time, bodies, line, self._trail_colours.astype(np.float32))
