"""Drones of VMAS in its world, by thrust and torques of a controller of this script: drones=<n> seconds=<s>
threads=<t>.

VMAS has no controller for drones. Worlds of four drones, or drones / 4 of them. Its debug scenario `drone` offers three
torques of at most 1e-5 N m, which cannot turn a drone noticeably; this one takes thrust and torques, up to U_RANGE. One
step of the environment is one step of its world, `world.dt`: the rigid body is integrated once over it, the planar
world in ten substeps. A world is reset where a drone tilts by more than 30 degrees, VMAS's own limit.
"""

from __future__ import annotations

import torch
import vmas
from flight import arguments, grid, measure
from vmas.scenarios.debug import drone
from vmas.simulator.core import Agent
from vmas.simulator.dynamics.drone import Drone

TEAM = 4
U_RANGE = [5.0, 0.05, 0.05, 0.05]  # thrust beyond the weight [N], torques [N m]
TILT, RATE = 6.0, 4.0  # attitude gains [1/s²], [1/s], slow enough for one step of 0.1 s
CLIMB, SINK = 1.0, 1.5  # altitude gains [1/s²], [1/s]
APPROACH = 0.6  # [1/s]; in the plane an agent's velocity follows the drone's acceleration, so tilt commands velocity


class Scenario(drone.Scenario):
    """VMAS's scenario `drone` with thrust as an action, and set-points."""

    def make_world(self, batch_dim: int, device: torch.device, **kwargs):
        """Return worlds of `TEAM` drones that take thrust and torques."""
        world = super().make_world(batch_dim, device, n_agents=0)
        for i in range(TEAM):
            dynamics = Drone(world, integration="rk4")
            agent = Agent(f"drone_{i}", collide=True, u_range=U_RANGE, u_multiplier=[1.0] * 4, dynamics=dynamics)
            world.add_agent(agent)
        self.home = torch.tensor(grid(TEAM))
        return world

    def reset_world_at(self, env_index: int | None = None):
        """Put the drones of one world, or of all, to their places, at rest."""
        for agent, place in zip(self.world.agents, self.home, strict=True):
            agent.set_pos(place[:2].expand(1 if env_index is not None else self.world.batch_dim, 2), env_index)
            agent.dynamics.reset(env_index)
            height = agent.dynamics.drone_state[:, 11]
            height[... if env_index is None else env_index] = place[2]

    def process_action(self, agent: Agent):
        """Leave thrust and torques as they are; Drone adds the weight to the thrust."""


def control(agent: Agent, target: torch.Tensor) -> torch.Tensor:
    """Return thrust beyond the weight and torques (worlds, 4) that take a drone to its target (3,)."""
    body = agent.dynamics
    state = body.drone_state
    tilt = APPROACH * (target[:2] - agent.state.pos) / body.g
    roll = TILT * (-tilt[:, 1] - state[:, 0]) - RATE * state[:, 3]
    pitch = TILT * (tilt[:, 0] - state[:, 1]) - RATE * state[:, 4]
    yaw = -RATE * state[:, 5]
    thrust = agent.mass * (CLIMB * (target[2] - state[:, 11]) - SINK * state[:, 8])
    action = torch.stack([thrust, body.I_xx * roll, body.I_yy * pitch, body.I_zz * yaw], dim=1)
    limit = torch.tensor(U_RANGE)
    return action.clamp(-limit, limit)


@torch.no_grad()
def main() -> None:
    drones, seconds, threads = arguments()
    torch.set_num_threads(threads)
    scenario = Scenario()
    env = vmas.make_env(scenario, num_envs=drones // TEAM, device="cpu", continuous_actions=True, seed=0)
    world = scenario.world

    def step(leap: float) -> tuple[float, int]:
        targets = scenario.home + torch.tensor([leap, 0.0, 0.0])
        actions = [control(agent, target) for agent, target in zip(world.agents, targets, strict=True)]
        _, _, crashed, _ = env.step(actions)
        place = [torch.cat([a.state.pos, a.dynamics.drone_state[:, 11:]], dim=1) for a in world.agents]
        distance = (torch.stack(place, dim=1) - targets).norm(dim=-1).mean().item()
        for index in crashed.nonzero().flatten().tolist():
            env.reset_at(index)
        return distance, int(crashed.sum())

    facts = {
        "worlds": env.num_envs,
        "physics_hz": round(1 / world.dt, 6),
        "control_hz": round(1 / world.dt, 6),
        "substeps": world._substeps,
    }
    measure(step, world.dt, drones, seconds, ("vmas", "torch"), **facts)


if __name__ == "__main__":
    main()
