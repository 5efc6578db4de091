"""Start and end PX4s, each in a fresh folder, with the parameters of the rig that they are to fly."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from multilift_marl._interrupt import signals_waiting
from multilift_marl.deploy.processes import end_together, end_with_parent
from multilift_marl.errors import ConfigError, FlightError
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.system import System

BUILD = "build/px4_sitl_default"
PX4_PORT = 14580  # of the first PX4, where it hears set-points by UDP; the next ones have the next
_GRACE = 5.0  # [s] for PX4s to end by themselves
_RATE_CROSSOVER = 18.5  # [rad/s] of the rate loop: PX4's gain of 0.15 by its iris' 123 rad/s² at a set-point of 1
_RATE_INTEGRAL, _RATE_DERIVATIVE = 24.6, 0.37  # of the iris alike


def find_px4(folder: str | Path) -> Path:
    """Return the folder of a build of PX4 for software in the loop.

    Raises:
        ConfigError: there is none, or PX4's simulation does not run on this system.
    """
    if not hasattr(os, "killpg"):
        raise ConfigError("PX4's simulation runs on Linux and macOS alone; use one of them, or WSL on Windows")
    for path in (Path(folder).expanduser(), Path(folder).expanduser() / BUILD):
        if (path / "bin" / "px4").is_file() and (path / "etc" / "init.d-posix" / "rcS").is_file():
            return path.resolve()
    raise ConfigError(
        f"px4={folder} holds no PX4 for simulation; clone PX4-Autopilot (v1.15 or later), run `make px4_sitl_default` "
        "there, and give its folder by px4=<folder> or PX4_DIR"
    )


def rig_parameters(system: System, index: int) -> dict[str, float]:
    """Return PX4's parameters for drone `index` of a rig: rotors, thrust at hover, gains of the rate loop.

    PX4's motor k is our rotor k. Its rate controller's gains are those of its iris, scaled by the angular acceleration
    that a set-point of 1 gives, so that the loop crosses over at the same frequency.
    """
    vehicle = system.vehicles[index]
    values: dict[str, float] = {"CA_ROTOR_COUNT": 4, "CA_AIRFRAME": 0}
    for k, (x, y, _) in enumerate(vehicle.rotor_positions):
        # FRD: PX4's y points to the right.
        values[f"CA_ROTOR{k}_PX"], values[f"CA_ROTOR{k}_PY"] = float(x), -float(y)
        # positive for rotors that turn counter-clockwise, whose reaction torque is clockwise
        values[f"CA_ROTOR{k}_KM"] = -float(vehicle.rotor_spin[k]) * vehicle.torque_ratio
    # Without what it carries, which comes as acceleration, see `AutopilotController`.
    values["MPC_THR_HOVER"] = vehicle.mass * GRAVITY / (4 * vehicle.rotor_thrust_max)
    # PX4's mixer is the inverse of thrusts to wrenches, with one factor for roll and pitch.
    mixer = np.linalg.inv(vehicle.allocation)[:, 1:3]
    factor = np.sqrt((mixer**2).sum(axis=0) / (0.5 * (np.abs(mixer) > 1e-3).sum(axis=0))).max()
    for axis, name in enumerate(("ROLL", "PITCH")):
        # Angular acceleration at a set-point of 1 [rad/s²].
        gain = float(vehicle.rotor_thrust_max / factor / vehicle.inertia[axis])
        values[f"MC_{name}RATE_P"] = _RATE_CROSSOVER / gain
        values[f"MC_{name}RATE_I"] = _RATE_INTEGRAL / gain
        values[f"MC_{name}RATE_D"] = _RATE_DERIVATIVE / gain
    return values


USUAL: dict[str, float] = {
    "COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0, "NAV_RCL_ACT": 0,  # neither remote control nor ground station
    "COM_OBL_RC_ACT": 4, "COM_OF_LOSS_T": 1.0,  # no set-points for a second: land
    "COM_DISARM_PRFLT": -1, "COM_DISARM_LAND": -1,  # teams take their time on the ground
    "SDLOG_MODE": -1, "SYS_HAS_NUM_ASPD": 0, "CBRK_SUPPLY_CHK": 894281,
    "EKF2_GPS_DELAY": 100, "SENS_GPS0_DELAY": 100, "EKF2_GPS_P_NOISE": 0.02, "EKF2_GPS_V_NOISE": 0.1, "EKF2_HGT_REF": 1,
    "MPC_USE_HTE": 0, "MPC_ACC_DECOUPLE": 0, "MPC_THR_MIN": 0.03,
    "MPC_SPOOLUP_TIME": 0.5, "MPC_TKO_RAMP_T": 0.3, "MPC_XY_VEL_MAX": 8, "MPC_TILTMAX_AIR": 60, "MPC_YAW_MODE": 0,
    "MPC_XY_P": 1.5, "MPC_XY_VEL_P_ACC": 3.0, "MPC_XY_VEL_I_ACC": 1.0, "MPC_Z_P": 1.5, "MPC_Z_VEL_P_ACC": 5.0,
}  # fmt: skip
"""Parameters of every flight."""


def _check_port(index: int) -> None:
    """Refuse a port that PX4 would not get: it starts without, and hears nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", PX4_PORT + index))
        except OSError as error:
            raise FlightError(
                f"port {PX4_PORT + index} of PX4 {index} is taken ({error.strerror}); end what listens there, or give "
                "another instance=<number>"
            ) from None


class Autopilots:
    """Running PX4s; a context that ends them.

    Args:
        build: folder of the build, see `find_px4`.
        parameters: of each of them.
        first: instance of the first of them.
        log: whether they write flight logs.

    Attributes:
        folder: of their files, one folder each.
    """

    def __init__(self, build: Path, parameters: Sequence[Mapping[str, float]], first: int = 0, log: bool = False):
        self._temporary = tempfile.TemporaryDirectory(prefix="px4-", ignore_cleanup_errors=True)
        self.folder = Path(self._temporary.name)
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        try:
            for i, own in enumerate(parameters):
                self._start(build, first + i, own, log)
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise FlightError(f"cannot start {build / 'bin' / 'px4'} ({error.strerror})") from None
            raise

    def _start(self, build: Path, index: int, parameters: Mapping[str, float], log: bool) -> None:
        _check_port(index)
        folder = self.folder / str(index)
        folder.mkdir()
        values = {**USUAL, **({"SDLOG_MODE": 0} if log else {}), **parameters}
        environment = {**os.environ, "PX4_SIM_MODEL": "none_iris", "PX4_SIM_HOSTNAME": "127.0.0.1"}
        environment |= {f"PX4_PARAM_{name}": f"{value:.9g}" for name, value in values.items()}
        px4, etc = str(build / "bin" / "px4"), str(build / "etc")
        command = [px4, "-i", str(index), "-d", etc, "-s", "etc/init.d-posix/rcS", "-w", str(folder)]
        with (folder / "px4.log").open("wb") as output:
            process = subprocess.Popen(
                command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=end_with_parent,
            )  # fmt: skip
        self._processes[index] = process

    def check(self, seconds: float = 0.0) -> None:
        """Raise a FlightError that names the first one that has ended, or does so within some seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and all(process.poll() is None for process in self._processes.values()):
            time.sleep(0.02)
        for i, process in self._processes.items():
            if process.poll() is not None:
                raise FlightError(f"PX4 {i} has ended (status {process.returncode}): {self.last_words(i)}")

    def last_words(self, index: int) -> str:
        """Return the last line of the log of one."""
        lines = (self.folder / str(index) / "px4.log").read_text("utf-8", "replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")

    def close(self) -> None:
        """End them all, and remove their files."""
        with signals_waiting():
            end_together(self._processes.values(), (signal.SIGTERM, _GRACE))
            self._processes.clear()
            self._temporary.cleanup()

    def __enter__(self) -> Autopilots:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
