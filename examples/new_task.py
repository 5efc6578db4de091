"""A complete task of your own: the team lifts its payload by a metre and holds it there.

The package provides everything else: APIs, seeding, failures, observations, training, evaluation. Within it, `Lift`
would be a file in multilift_marl/tasks/ with a line in tasks/__init__.py, and CONFIG a file configs/lift.yaml.

Run: python examples/new_task.py
     python train.py import=examples/new_task.py config=lift
"""

import numpy as np
from pydantic import Field

import multilift_marl as ml
from multilift_marl._jit import bind, kernel
from multilift_marl.config.values import Float, Section
from multilift_marl.control.scripted import make_scripted
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.rewards import action_rate, tolerance
from multilift_marl.tasks.starts import StartRanges, start_near_target


class LiftOptions(Section):
    """Options of the task, typed: `task_options.<name>`."""

    rise: Float = Field(1.0, gt=0, description="[m] from start to target")
    near: Float = Field(0.05, gt=0, description="[m] payload within this of its target at the end")


class Lift(Task):
    """Lift the payload and hold it."""

    name = "lift"
    Options = LiftOptions
    options: LiftOptions
    REWARD = {"height": 0.7, "still": 0.3, "action_rate": -0.05}  # noqa: RUF012

    def start(self, env, rng, mass):
        """Hang the team at rest near a target, then put the target higher."""
        ranges = StartRanges(xy=1.0, low=1.0, high=1.2, yaw=0.5, radius=0.0, tilt=0.0, speed=0.0)
        goal, rise = self.goal, self.options.rise
        start_near_target(env, rng, self.world.state, goal, self.rig, ranges, self.hanging, mass)
        goal.position[env, 2] += rise
        goal.slots[env, :, 2] += rise

    def reward(self, lo, hi, action, previous):
        """Return the call that writes the rewards of environments lo to hi after every step."""
        state, near = self.world.state, self.options.near
        return bind(
            score, lo, hi, state, self.errors, action, previous, self.weights, near, self.dt, self.terms, self.good_time
        )

    def succeeded(self):
        """Near the target for the last second."""
        return self.good_time >= 1.0


@kernel
def score(lo, hi, state, errors, action, previous, weights, near, dt, terms, good_time):
    """Write the reward's terms; loops over environments are compiled."""
    for e in range(lo, hi):
        speed = np.sqrt((state.payload_velocity[e] ** 2).sum())
        terms[e, 0] = weights[0] * tolerance(errors.distance[e], 0.1)
        terms[e, 1] = weights[1] * tolerance(speed, 0.2)
        terms[e, 2] = weights[2] * action_rate(e, action, previous)
        good_time[e] = good_time[e] + dt if errors.distance[e] <= near else 0.0


CONFIG = {"task": "lift", "env": {"num_envs": 64, "episode_seconds": 6.0}, "randomization": {"payload_mass": 0.1}}
ml.register_task(Lift, CONFIG)


def main() -> float:
    """Evaluate a script on the new task and return its success."""
    vec = ml.make_vec("lift")
    script = make_scripted("formation_integral", vec)
    observation, info = vec.reset(seed=0)
    for _ in range(vec.max_steps):
        observation, _, _, _, info = vec.step(script.act(observation))
    print(f"{info['success'].mean():.0%} of {vec.num_envs} teams lifted their payload")
    return float(info["success"].mean())


if __name__ == "__main__":
    main()
