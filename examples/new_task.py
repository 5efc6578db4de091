"""A task of one's own, complete: the team lifts its payload by a metre and holds it there.

In the package, `Lift` would be a file in multilift_marl/tasks/ with a line in its __init__.py, CONFIG one in configs/.
Run: python examples/new_task.py, or python train.py import=examples/new_task.py config=lift
"""

from pydantic import Field

import multilift_marl as ml
from multilift_marl.mdp.initial_states import StartOptions, make_ranges, start_near_target
from multilift_marl.mdp.rewards import Term, action_rate, distance, stillness
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.values import Float
from multilift_marl.tasks.base import Task


class LiftOptions(StartOptions):
    """Options of the task, typed: `task_options.<name>`."""

    rise: Float = Field(1.0, gt=0, description="[m] from start to target")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(10.0, gt=0, description="[deg] ... and of its attitude ...")
    success_seconds: Float = Field(1.0, gt=0, description="[s] ... throughout the last second")


class Lift(Task):
    """Lift the payload and hold it."""

    name = "lift"
    Options = LiftOptions
    options: LiftOptions
    REWARD = {  # noqa: RUF012
        "height": Term(0.7, distance, margin=0.1, unit="m"),
        "still": Term(0.3, stillness, margin=(0.2, 0.3), unit="m/s, rad/s"),
        "action_rate": Term(-0.05, action_rate),
    }

    def start(self, env, rng, mass):
        """Hang the team near a target, then put the target higher."""
        start_near_target(env, rng, self.view_for(start_near_target), make_ranges(self.options), self.equilibrium)
        self.place_goal(env, self.goal.position[env] + [0.0, 0.0, self.options.rise])


CONFIG = {
    "task": "lift",
    "task_options": {"start_radius": 0.1, "start_tilt": 0.0, "start_speed": 0.0},
    "env": {"num_envs": 64, "episode_seconds": 6.0},
    "randomization": {"payload_mass": 0.1},
}
ml.register_task(Lift, CONFIG)

if __name__ == "__main__":
    vec = ml.make_vec("lift")
    script = make_scripted("formation_integral", vec)
    observation, info = vec.reset(seed=0)
    for _ in range(vec.max_steps):
        observation, _, _, _, info = vec.step(script.act(observation))
    print(f"{info['success'].mean():.0%} of {vec.num_envs} teams lifted their payload")
