"""Evaluate an exported policy with NumPy and onnxruntime alone, without torch.

First: python -m multilift_marl.export run=hover
Run:   python examples/fly_exported.py runs/shipped-hover/export      (a number behind it: how many episodes)

The episodes are those of `python evaluate.py`. On a robot, code that fills `observation` from sensors and executes the
actions replaces the simulation; `check` and `Team` stay.
"""

import json
import sys
from itertools import zip_longest
from pathlib import Path

import numpy as np
import onnxruntime

from multilift_marl.config.load import build_config
from multilift_marl.evaluation.metrics import summarize
from multilift_marl.evaluation.rollout import run_episodes


class Team:
    """The policy of a folder that `python -m multilift_marl.export` wrote; the network serves any number of drones."""

    def __init__(self, folder):
        self.contract = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # for networks this small, more of them only wait for each other
        path = folder / self.contract["network"]["file"]
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._gru = self.contract["network"].get("memory")  # None for a policy without one
        self._memory = None

    def act(self, observation):
        """Return actions (batch, drones, A) in [-1, 1] for observations (batch, drones, D)."""
        inputs = {"observation": np.asarray(observation, np.float32)}
        if self._gru is not None:
            if self._memory is None:
                self._memory = np.zeros((*inputs["observation"].shape[:2], self._gru["size"]), np.float32)
            inputs[self._gru["input"]] = self._memory
        action, *after = self._session.run(None, inputs)
        if after:
            self._memory = after[0]
        return action

    def reset(self, mask=None):
        """Forget what was observed in the environments of the mask (None: all); only a GRU remembers anything."""
        if mask is None:
            self._memory = None
        elif self._memory is not None:
            self._memory[mask] = 0.0


def check(contract, vec):
    """Refuse environments whose observations or actions differ from the contract, number by number."""
    for what, agreed, found in (
        ("observation", contract["observation"]["names"], vec.observation_names),
        ("action", [number["name"] for number in contract["action"]["numbers"]], vec.action_names),
    ):
        for i, (expected, given) in enumerate(zip_longest(agreed, found, fillvalue="nothing")):
            if expected != given:
                raise SystemExit(f"error: {what} {i} is {given}, but {expected} in the contract; export anew")


def main(folder, episodes=20):
    """Simulate episodes, and print success and error."""
    team = Team(Path(folder))
    config = build_config(team.contract["config"])

    def make_policy(vec):
        check(team.contract, vec)
        return team

    metrics = summarize(run_episodes(config, make_policy, int(episodes), seed=1000))
    success = metrics["success_rate"]["mean"]
    error = metrics["payload_position_error_m"]["mean"]
    print(f"{team.contract['task']}: {episodes} episodes, success {success:.0%}, position error {100 * error:.2f} cm")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("error: give the folder of an exported policy, such as runs/shipped-hover/export")
    main(*sys.argv[1:])
