"""Fake autopilots and the team that they fly, for tests of flights by PX4."""

from __future__ import annotations

from fake_px4 import FIRST, FakePX4

import multilift_marl as ml
from multilift_marl.deploy.px4.flight import check_config
from multilift_marl.deploy.px4.launch import rig_parameters
from multilift_marl.deploy.px4.team import AutopilotTeam, Settings
from multilift_marl.sensing.suite import Sensor, SensorSuite
from multilift_marl.sim import World

DT = 0.004
FAST = Sensor(250.0)
EXACT = SensorSuite(FAST, FAST, Sensor(50.0), Sensor(50.0), Sensor(50.0), Sensor(50.0))


def make_fakes(system, first: int = FIRST, **changes) -> list[FakePX4]:
    fakes = []
    for i, vehicle in enumerate(system.vehicles):
        own = {"mass": vehicle.mass, "inertia": vehicle.inertia, "thrust": vehicle.rotor_thrust_max}
        fakes.append(FakePX4(first + i, rig_parameters(system, i) | own, **changes))
        fakes[-1].start()
    return fakes


class Airfield:
    """Fake autopilots and the team that they fly; a context that ends both."""

    def __init__(self, system, timeout: float = 20.0, suite: SensorSuite = EXACT, **changes):
        self.fakes = make_fakes(system, **changes)
        try:
            self.team = AutopilotTeam(system, DT, Settings(first=FIRST, timeout=timeout, suite=suite))
        except Exception:
            self.__exit__()
            raise

    def __enter__(self) -> Airfield:
        return self

    def __exit__(self, *exception) -> None:
        if hasattr(self, "team"):
            self.team.close()
        for fake in self.fakes:
            fake.end()


def idle(team: AutopilotTeam, world: World, ticks: int) -> None:
    for _ in range(ticks):
        team.tick(world, lambda i: None)


def config_of(task: str = "hover", **overrides):
    return check_config(ml.load_config(task, {"env.num_drones": 2, "payload.mass": 0.7, **overrides}))
