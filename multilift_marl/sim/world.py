"""Many simulations of one system: MuJoCo's batched stepping, one shard of environments for each thread."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from multilift_marl._platform import cpu_count
from multilift_marl.kernels.jit import bind
from multilift_marl.rig.constants import make_rig
from multilift_marl.rig.system import System
from multilift_marl.sim.air import make_air
from multilift_marl.sim.cables import CABLE_MODELS
from multilift_marl.sim.cables.chain_arrays import Nodes
from multilift_marl.sim.contact import NEAR, body_radii, find_close, search_contacts
from multilift_marl.sim.dynamics import apply_loads
from multilift_marl.sim.gusts import start_turbulence
from multilift_marl.sim.obstacle_bodies import ShardObstacles
from multilift_marl.sim.obstacles import check_obstacles, make_obstacles
from multilift_marl.sim.parameters import (
    Parameters,
    make_inertias,
    make_rotor_variation,
    nominal_parameters,
    update_inertias,
    update_parameters,
    write_lags,
    write_masses,
)
from multilift_marl.sim.pushes import Pushes, apply_pushes, make_pushes, start_pushes
from multilift_marl.sim.saved import check_saved, fingerprint
from multilift_marl.sim.scene import build_model
from multilift_marl.sim.state import Air, EpisodeStats, HiddenLoads, SimData, SystemState, hover_drone
from multilift_marl.sim.state_io import Rows, find_warnings, make_rows
from multilift_marl.sim.threads import Threads

_log = logging.getLogger("multilift_marl.mujoco")
REST_HEIGHT = 1.5  # [m] of the payload after World.reset


@dataclass
class Shard:
    """Environments lo to hi, stepped by one thread."""

    lo: int
    hi: int
    batch: Batch
    rows: Rows
    apply: Callable[[], None]
    """`apply_loads` of these environments, with the thrusts in `World.thrust`."""
    push: Callable[[], None] | None
    """`apply_pushes` of these environments, where there are any."""
    advance_cables: Callable[[], None]
    """What the cable model does before MuJoCo's step."""
    read: Callable[[], None]
    """`read_state` of the cable model."""
    broken: np.ndarray
    """(hi - lo, N) bool, broken cables that the batch's models have."""
    find_close: Callable[[], Any]
    """`contact.find_close` of these environments."""
    proximity: np.ndarray
    """(hi - lo,) int8, whether bodies might touch."""
    find_warnings: Callable[[], None]
    """`find_warnings` of these environments."""
    obstacles: ShardObstacles | None
    """Of these environments, where there are any."""


class World:
    """Physics alone: E simulations of a system, rotor thrusts in, physical state out.

    Args:
        system: what to simulate, such as `load_config("hover").system`.
        num_envs: E.
        num_threads: threads; 0 for one on each available CPU. Results do not depend on it, bit for bit.
        seed: of the turbulence and pushes that each `reset` starts with; `seed_turbulence`, `seed_pushes` give others.

    Attributes:
        system, num_envs, num_drones, model, layout: as given, E, N, MuJoCo's model and where bodies are in it.
        state: SystemState of all environments; live arrays, E first.
        thrust: commanded thrust of each rotor (E, N, 4) [N].
        parameters: true parameters; changed by `set_parameters` alone.
        hidden_loads: true loads; write `wind` and `payload_force` freely.
        rig: RigArrays, nominal numbers of the team.
        air: turbulence, gusts and downwash.
        pushes: when bodies are pushed next; None where they are not.
        obstacles: live; rows from `len(system.scenery.obstacles)` on are the task's, placed before `load`.
        stats: statistics since the reset.
        diverged: (E,) bool, until reset.
        cable_model, cables: module of the cable model and its numbers.
        nodes: Nodes of the chains; None with massless cables.
        breakable: whether `state.cable_broken` is read after every physics step.

    Raises:
        ValueError: fewer than one environment, or a negative number of threads or seed.
    """

    def __init__(self, system: System, num_envs: int, num_threads: int = 0, seed: int = 0):
        for name, value, least in (("num_envs", num_envs, 1), ("num_threads", num_threads, 0), ("seed", seed, 0)):
            if value < least:
                raise ValueError(f"{name}={value} must be at least {least}")
        _quiet_mujoco()
        self.system = system
        self.num_envs = num_envs
        self.num_drones = system.num_drones
        self.seed = seed
        self.model, self.layout = build_model(system)
        self.rig = make_rig(system)
        self.thrust = np.zeros((num_envs, self.num_drones, 4))
        self.state = SystemState.zeros(num_envs, self.num_drones)
        self.parameters = nominal_parameters(system, num_envs)
        # `payload_mass` is the parameters' own array: what `set_parameters` writes counts here, too.
        self.hidden_loads = HiddenLoads(
            payload_mass=self.parameters.payload_mass, payload_force=np.zeros((num_envs, 3)),
            wind=np.tile(system.wind, (num_envs, 1)), motors_off=np.zeros((num_envs, self.num_drones), bool),
        )  # fmt: skip
        self.air = Air.zeros(num_envs, self.num_drones)
        self._pushing = make_pushes(system, num_envs)
        self.pushes: Pushes | None = None if self._pushing is None else self._pushing[0]
        self.obstacles = make_obstacles(system, num_envs)
        self.stats = EpisodeStats.zeros(num_envs)
        self.diverged = np.zeros(num_envs, bool)
        self.breakable = bool(np.isfinite(system.breaking_load).any())
        self.cable_model = CABLE_MODELS[system.cable_model]
        self._varied = make_rotor_variation(system, self.parameters)
        self._inertias = make_inertias(system, self.parameters)
        self.cables = self.cable_model.make_cables(system, self.parameters, self._inertias)
        self.nodes: Nodes | None = self.cables.nodes
        self._data = SimData(self.state, self.stats, self.diverged)
        self.shards = self._make_shards(num_threads or cpu_count())
        self._threads = Threads()
        self.reset()

    def reset(self, mask: np.ndarray | None = None) -> SystemState:
        """Put the environments in `mask` (E,) (None: all) at rest in formation, payload at 1.5 m; return the state."""
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask, bool)
        system = self.system
        state = self.state
        state.payload_position[mask] = [0, 0, REST_HEIGHT]
        state.payload_rotation[mask] = np.eye(3)
        state.payload_velocity[mask] = state.payload_body_rates[mask] = 0
        state.drone_position[mask] = system.slots + [0, 0, REST_HEIGHT]
        state.drone_velocity[mask] = state.drone_body_rates[mask] = 0
        for e in np.flatnonzero(mask).tolist():
            for n, force in enumerate(system.hook_force):
                hover_drone(e, n, state, tuple(force), float(self.rig.heading[n]), self.rig)
        self.set_parameters(mask, **nominal_parameters(system, self.num_envs)._asdict())
        self.hidden_loads.payload_force[mask] = 0
        self.hidden_loads.wind[mask] = system.wind
        if system.air.turbulence:
            for e in np.flatnonzero(mask).tolist():
                self.seed_turbulence(e, np.random.SeedSequence(self.seed, spawn_key=(e,)))
        if self._pushing is not None:
            for e in np.flatnonzero(mask).tolist():
                self.seed_pushes(e, np.random.SeedSequence(self.seed, spawn_key=(e, 1)))
        # Last: it writes the state into simulations, whose parameters have to be set by then.
        self.load(mask)
        return state

    def step(self, thrust: np.ndarray, nstep: int = 1) -> SystemState:
        """Advance all environments by `nstep` physics steps.

        Args:
            thrust: commanded thrust of each rotor (E, N, 4) [N]; the rotors follow with their lag and limits.
            nstep: physics steps.

        Returns:
            The live state. Tensions are those of the last step, of chains of its last substep; all else is current.

        Raises:
            ValueError: wrong shape, or a thrust that is not finite.
        """
        thrust = np.asarray(thrust, np.float64)
        if thrust.shape != (self.num_envs, self.num_drones, 4):
            raise ValueError(f"thrust has shape {thrust.shape}, expected {(self.num_envs, self.num_drones, 4)}")
        if not np.isfinite(thrust).all():
            raise ValueError("thrust holds NaN or infinite values; give each rotor's thrust in newtons")
        self.thrust[:] = thrust
        self.run(lambda shard: self.advance(shard, nstep))
        self.check_warnings()
        return self.state

    def advance(self, shard: Shard, nstep: int) -> None:
        """Advance one shard with the thrusts in `thrust`; see `step`."""
        for _ in range(nstep):
            # In this order: `apply` writes the loads of the step, pushes and cables add to them, and `read` takes over
            # what MuJoCo has made of them.
            shard.apply()
            if shard.push is not None:
                shard.push()
            if shard.obstacles is not None:
                shard.obstacles.step()
            # Few steps change a flag: only those write to the models.
            if shard.find_close():
                search_contacts(shard.batch, shard.proximity)
            shard.advance_cables()
            try:
                shard.batch.step()
            except SimulationError as error:
                # Those named kept their state, the others were stepped: the shard goes on.
                self.diverged[shard.lo + np.asarray(error.ids, int)] = True
            shard.read()
            if self.breakable:
                self._sync_broken(shard)

    def run(self, work: Callable[[Shard], None]) -> None:
        """Call `work` for every shard, each on a thread of its own; see `Threads.run`."""
        self._threads.run(work, self.shards)

    def set_parameters(self, mask: np.ndarray, **values: np.ndarray) -> None:
        """Give the environments in `mask` (E,) their own true parameters.

        Args:
            mask: bool (E,).
            **values: fields of `Parameters` by name, each (E, ...), rows outside the mask not used; others stay.

        Raises:
            ValueError: a value that cannot be, or of what the configuration does not vary at a cost.
        """
        changed, names = update_parameters(self.system, self.parameters, mask, values)
        if not names:
            return
        if self._varied is not None and "vehicle_rotor_time_constant" in names:
            write_lags(self._varied, self.system, self.parameters, changed)
        update_inertias(self._inertias, self.system, self.parameters, changed, names)
        self.cable_model.update_cables(self.cables, self.system, self.parameters)
        for shard in self.shards:
            mask = changed[shard.lo : shard.hi]
            if mask.any():
                own = self._shard_parameters(shard)
                # Masses first: from them follow MuJoCo's weights, and from these the law of the cables.
                write_masses(shard.batch, self.layout, self.system, own, mask, names)
                self.cable_model.update_models(shard.batch, self.system, own, mask, names, shard.broken)

    def seed_turbulence(self, env: int, seed: np.random.SeedSequence) -> None:
        """Start the turbulence of environment `env` anew from its stationary distribution, drawn from `seed`."""
        self.air.generator[env] = seed.generate_state(1, np.uint64)[0]
        start_turbulence(env, self.air)

    def seed_pushes(self, env: int, seed: np.random.SeedSequence) -> None:
        """Draw the times and sizes of the pushes of environment `env` from `seed` on, where there are any."""
        if self._pushing is not None:
            pushes, constants = self._pushing
            pushes.generator[env] = seed.generate_state(1, np.uint64)[0]
            start_pushes(env, pushes, constants.interval)

    def break_cables(self, mask: np.ndarray) -> None:
        """Let the cables in `mask` (E, N) bool break; `reset` and `load` make them whole again."""
        self.state.cable_broken[mask] = True
        for shard in self.shards:
            self._sync_broken(shard)

    def load(self, mask: np.ndarray) -> None:
        """Make `state` of the environments in `mask` (E,) the simulations' own.

        Records and gusts start anew, cables are whole, motors run.
        """
        self.state.cable_broken[mask] = self.hidden_loads.motors_off[mask] = False
        self.air.gust[mask] = self.air.downwash[mask] = self.air.steps[mask] = 0
        self.obstacles.clock[mask] = 0.0
        for shard in self.shards:
            local = mask[shard.lo : shard.hi]
            if local.any():
                # Cables are whole again in the models, too, before a state is written that takes them to be.
                self._sync_broken(shard)
                shard.batch.reset(local, stage=mujoco.mjtStage.mjSTAGE_NONE)
                self.cable_model.write_state(shard.rows, mask, self._data, self.cables)
                if shard.obstacles is not None:
                    shard.obstacles.load(local)
        self.diverged[mask] = False

    def check_warnings(self) -> None:
        """Mark environments for which MuJoCo has counted a warning as diverged."""
        for shard in self.shards:
            shard.find_warnings()

    def qpos(self, env: int) -> np.ndarray:
        """Return MuJoCo's generalised coordinates (nq,) of one environment; ValueError if there is none such."""
        if not 0 <= env < self.num_envs:
            raise ValueError(f"there is no environment {env}; give one from 0 to {self.num_envs - 1}")
        shard = next(shard for shard in self.shards if shard.lo <= env < shard.hi)
        return shard.batch.bind("qpos")[env - shard.lo]

    def cable_points(self, env: int, cable: int) -> np.ndarray:
        """Return the points of a cable from its anchor to its hook (S + 1, 3) [m]; of a broken one without the hook."""
        state = self.state
        system = self.system
        anchor = state.payload_position[env] + state.payload_rotation[env] @ system.anchors[cable]
        hook = state.drone_position[env, cable] + state.drone_rotation[env, cable] @ system.hooks[cable]
        count = system.cable_segments[cable] - 1
        between = np.zeros((0, 3)) if self.nodes is None else self.nodes.position[env, cable, :count]
        return np.vstack([anchor, between] if state.cable_broken[env, cable] else [anchor, between, hook])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of all that the future of the simulations depends on, by dotted name, environment first."""
        saved = {
            f"{prefix}.{name}": array.copy()
            for prefix, group in self._groups().items()
            for name, array in group.items()
        }
        saved["rows"] = np.concatenate([shard.batch.state for shard in self.shards])
        saved["warning"] = np.concatenate([shard.batch.warning for shard in self.shards])
        saved["diverged"] = self.diverged.copy()
        saved["system"] = fingerprint(self.system, self.num_envs)
        return saved

    def load_state_dict(self, saved: dict[str, np.ndarray]) -> None:
        """Continue bit for bit from what `state_dict` returned, at any number of threads.

        Raises:
            ValueError: it is of another system, or not what `state_dict` returned; nothing is changed then.
        """
        check_saved(saved, self.state_dict(), "diverged", "system")
        check_obstacles(saved, self.obstacles, self.system.scenery)
        # By `set_parameters` first, which brings the models into line; the arrays alone would leave them as they are.
        parameters = {name: saved[f"parameters.{name}"] for name in Parameters._fields}
        self.set_parameters(np.ones(self.num_envs, bool), **parameters)
        for prefix, group in self._groups().items():
            for name, array in group.items():
                array[:] = saved[f"{prefix}.{name}"]
        for shard in self.shards:
            shard.batch.state[:] = saved["rows"][shard.lo : shard.hi]
            shard.batch.warning[:] = saved["warning"][shard.lo : shard.hi]
            self._sync_broken(shard)
            if shard.obstacles is not None:
                shard.obstacles.load(np.ones(shard.hi - shard.lo, bool))
        self.diverged[:] = saved["diverged"]

    def _groups(self) -> dict[str, dict[str, np.ndarray]]:
        names = ("state", "hidden_loads", "parameters", "air", "stats", "nodes", "pushes")
        groups = {name: group._asdict() for name in names if (group := getattr(self, name)) is not None}
        if self.system.scenery.count:
            groups["obstacles"] = self.obstacles._asdict()
            del groups["obstacles"]["vertices"]  # of the configuration, and of no environment
        return groups

    def _sync_broken(self, shard: Shard) -> None:
        """Bring the shard's models into line with `state.cable_broken`."""
        broken = self.state.cable_broken[shard.lo : shard.hi]
        if (broken != shard.broken).any():
            own = self._shard_parameters(shard)
            mask = np.ones(len(broken), bool)
            self.cable_model.update_models(shard.batch, self.system, own, mask, {"cable_broken"}, broken)
            shard.broken[:] = broken

    def _shard_parameters(self, shard: Shard) -> Parameters:
        """Return the parameters of a shard's environments."""
        return Parameters(*(array[shard.lo : shard.hi] for array in self.parameters))

    def _make_shards(self, num_threads: int) -> list[Shard]:
        # Shares that differ by one environment at most.
        edges = np.linspace(0, self.num_envs, min(num_threads, self.num_envs) + 1).astype(int).tolist()
        shards = []
        radii = body_radii(self.system)
        air_constants = make_air(self.system)
        air = None if air_constants.still else (self.air, air_constants)
        for lo, hi in zip(edges[:-1], edges[1:], strict=True):
            # One thread each: the thread that runs a shard is all that it has.
            batch = Batch(self.model, hi - lo, nthread=1)
            rows = make_rows(self.layout, batch, lo)
            loads = self.thrust, self.hidden_loads
            apply = bind(apply_loads, rows, *loads, self._data, air_constants.drones, air, self._varied)
            push = None if self._pushing is None else bind(apply_pushes, rows, *self._pushing)
            advance, read = self.cable_model.bind_steps(batch, rows, self._data, self.cables)
            # As the compiled model is: contacts are searched. Flags are only written where this changes.
            proximity = np.full(hi - lo, NEAR, np.int8)
            find = bind(find_close, lo, self.state, proximity, radii, self.system.timestep, self.obstacles)
            broken = np.zeros((hi - lo, self.num_drones), bool)
            warnings = bind(find_warnings, lo, batch.warning, self.diverged)
            obstacles = None
            if self.system.scenery.count:
                obstacles = ShardObstacles(batch, self.model, lo, self.system, self.obstacles)
            shards.append(
                Shard(lo, hi, batch, rows, apply, push, advance, read, broken, find, proximity, warnings, obstacles)
            )
        return shards


def _quiet_mujoco() -> None:
    """Send MuJoCo's warnings to the log "multilift_marl.mujoco" in place of a file in the working directory."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.debug)
