"""How fast a policy node answers: from odometry of a live simulation to the last set-point, over DDS on the loopback.

    python bench/policy_node.py policy=hover seconds=20

The simulation runs in this process at the speed of real time, the node in another, as it would beside hardware.
Latency is from when the last odometry message of a step has been sent to the arrival of the last drone's set-point.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from multilift_marl.agents.policy import find_policy
from multilift_marl.config.load import build_config, load_config, parse_overrides
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.messages import NAMES, setpoint_topics
from multilift_marl.deploy.ros.types import px4_namespace, stamp_ns
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.realtime import QUANTILES, RealTime

DOMAIN = 91


def main() -> int:
    """Measure, and print a line for each figure."""
    values = parse_overrides(sys.argv[1:], ["policy", "names"])
    policy, names = values.pop("policy", "hover"), values.pop("names", "multilift")
    seconds = float(values.pop("seconds", 20.0))
    trained = find_policy(policy).config
    values |= {"env.num_envs": 1, "env.num_threads": 1, "env.episode_seconds": seconds + 60}
    config = build_config(trained.model_dump(), values) if trained else load_config("hover", values)
    vec, node = MultiliftVec(config, EVALUATION), Node(domain=DOMAIN)
    flight = LiveFlight(vec, node, names)
    answers = Node(domain=DOMAIN)
    topics = [setpoint_topics(NAMES[names], i)[-1] for i in range(vec.num_drones)]
    takes = [answers.subscription(topic._replace(reliable=False)) for topic in topics]
    command = [sys.executable, "-m", "multilift_marl.ros", "role=policy", f"policy={policy}", f"names={names}"]
    own = [f"{key}={value}" for key, value in values.items()]
    process = subprocess.Popen(
        [*command, f"domain={DOMAIN}", *own], stdout=subprocess.PIPE, text=True, stderr=subprocess.STDOUT
    )
    try:
        assert process.stdout is not None
        while not process.stdout.readline().startswith("listening"):
            assert process.poll() is None, "the node has ended"
        time.sleep(1.0)
        sent, clock, trips, lost = _stamp_last_odometry(flight, names, vec.num_drones), RealTime(1.0), [], 0
        flight.begin(1000)
        while flight.time_ns < seconds * 1e9:
            clock.wait(flight.time_ns * 1e-9)
            deadline, missing = time.perf_counter() + 0.8 * vec.task.dt, set(range(vec.num_drones))
            flight.step()
            while missing and answers.wait(max(deadline - time.perf_counter(), 0.0)):
                for i in tuple(missing):
                    missing -= {i} if any(_time(m) == flight.time_ns for m in takes[i]()) else set()
            lost += bool(missing)
            trips += [time.perf_counter() - sent[0]] * (not missing)
    finally:
        process.send_signal(2)
        output = process.communicate(timeout=10)[0]
    trips_ms = " / ".join(f"{1e3 * trip:.2f}" for trip in np.percentile(trips, QUANTILES))
    print(f"{policy}, {vec.num_drones} drones, {config.env.policy_hz} Hz, {len(trips)} steps, {lost} without an answer")
    print(f"from the last odometry to the last set-point: {trips_ms} ms (50 / 99 / 99.9 %)")
    print("the node: " + output.strip().splitlines()[-1])
    return 0


def _stamp_last_odometry(flight: LiveFlight, names: str, num_drones: int) -> list[float]:
    """Return a list whose number is the time at which the last drone's odometry was sent last."""
    last, own = num_drones - 1, NAMES[names]
    px4 = f"{px4_namespace(last)}/out/vehicle_odometry"
    topic = px4 if names == "report" else own.drone.format(own.first + last)
    publish, sent = flight._publish[topic], [0.0]

    def stamped(message: object) -> None:
        publish(message)
        sent[0] = time.perf_counter()

    flight._publish[topic] = stamped
    return sent


def _time(message: object) -> int:
    """Return the time of a set-point [ns]."""
    if hasattr(message, "header"):
        return stamp_ns(message.header.stamp)
    return 1000 * message.timestamp  # type: ignore[attr-defined, no-any-return]


if __name__ == "__main__":
    sys.exit(main())
