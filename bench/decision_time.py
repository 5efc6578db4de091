"""How long a decision takes: of an exported network for one drone, and of baselines for a team, on one core.

    python bench/decision_time.py policy=navigate_senses others=formation_route seconds=20

The network runs by ONNX Runtime as a drone would run it, one observation at a time. A baseline's time is that of a
step of its team over the number of drones; both along the same episodes, which the learned team flies.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from multilift_marl.agents.export import export_policy
from multilift_marl.agents.policy import load_policy
from multilift_marl.config.load import build_config, parse_overrides
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted


def open_network(folder: Path) -> onnxruntime.InferenceSession:
    """Return an exported network that runs on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(folder / "policy.onnx"), options, providers=["CPUExecutionProvider"])


def main(arguments: list[str]) -> None:
    """Measure, and print a line for each."""
    values = parse_overrides(arguments, ["policy", "others", "seconds"])
    name, seconds = values.pop("policy", "hover"), float(values.pop("seconds", 20.0))
    others = [each for each in str(values.pop("others", "")).split(",") if each]
    torch.set_num_threads(1)
    policy = load_policy(name)
    if policy.config.train.gru:
        raise ConfigError(f"{name} has a memory, which this measurement does not pass on; give a policy without one")
    config = build_config(policy.config.model_dump(), values | {"env.num_envs": 1, "env.num_threads": 1})
    vec = MultiliftVec(config, EVALUATION)
    flying, scripts = policy.bind(vec), {each: make_scripted(each, vec) for each in others}
    times: dict[str, list[float]] = {each: [] for each in ("network", *others)}
    with tempfile.TemporaryDirectory() as folder:
        export_policy(policy, Path(folder))
        network = open_network(Path(folder))
        observation, _ = vec.reset(seed=0)
        for each in (flying, *scripts.values()):
            each.reset(None)
        for _ in range(round(seconds / vec.task.dt)):
            begin = time.perf_counter()
            network.run(None, {"observation": observation[:1, :1].astype(np.float32)})
            times["network"].append(time.perf_counter() - begin)
            for script, act in scripts.items():
                begin = time.perf_counter()
                act.act(observation)
                times[script].append((time.perf_counter() - begin) / vec.num_drones)
            began, action = vec.ended, flying.act(observation)
            observation = vec.step(action, restart=True)[0]
            if began.any():
                for each in (flying, *scripts.values()):
                    each.reset(began)
    for label, taken in times.items():
        half, most, longest = np.percentile(1e3 * np.array(taken[len(taken) // 20 :]), [50, 99, 100])
        print(f"{label}: median {half:.3f} ms per drone and step, 99 % below {most:.3f} ms, longest {longest:.1f} ms")


if __name__ == "__main__":
    main(sys.argv[1:])
