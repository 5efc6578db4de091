"""Connections to Ray: a cluster of this machine alone, on its loopback address, or one that runs already.

Two private parts of Ray are used, since it has no public ones. `ray.init`, and `ray start` likewise, replace a loopback
address by that of a network card, so that the ports of a local cluster would be open to the network (`_start_local`).
When this process is ended at once, its threads may be inside Ray: the local cluster's processes are then ended without
a call of Ray's shutdown (`_kill_local`).
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from multilift_marl._interrupt import last_acts
from multilift_marl._platform import STOPPING, cpu_count, handles_signals
from multilift_marl._versions import find_versions
from multilift_marl.errors import ConfigError, pip_install, reason

_LOOPBACK = "127.0.0.1"
_CORE = "ray._raylet"  # its module
_WAIT = 5.0  # [s] for a head node to answer
SILENCE = 60.0  # [s] in which a worker says that it is alive, however long its work takes
START = 300.0  # [s] for its process to start
TRIES = 3  # workers that may die in a row for the same work
ACTOR: dict[str, Any] = {"num_cpus": 1, "max_restarts": 0, "concurrency_groups": {"pulse": 1}}  # options of workers
_ROOM = 10.0  # [s] for CPUs to become free, which those that were used a moment ago are only after a while
_MISSED = 3  # answers of a head node that may fail to come, one a second
_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # of HTTP/2: preface, no settings
_SETTINGS = 4  # kind of the frame that a server of HTTP/2 sends first


def connect(address: str, workers: int, key: str) -> bool:
    """Connect this process to Ray, where it is not connected already.

    Args:
        address: "local" starts a cluster on this machine, whose ports answer on the loopback address alone;
            "host:port" is that of a cluster's head node; "auto" is the cluster that `RAY_ADDRESS` names, else local.
        workers: processes that will be asked for.
        key: of the address, for messages.

    Returns:
        Whether this call connected, so that its caller should disconnect.

    Raises:
        ConfigError: Ray is missing, the address is no head node's, or the cluster has fewer free CPUs than workers.
    """
    address = resolve(address)
    late = address != "local" and not use_token()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read by Ray when it is imported
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_worker_niceness", "0")  # of a local cluster; else 15: the caller waits for its workers
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ConfigError(f"workers need Ray; {pip_install('ray')}") from error
    if ray.is_initialized():
        _check_size(ray, workers, "that is connected")
        return False
    quiet: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    if address == "local":
        _start_local(ray, max(workers, cpu_count()), quiet)
        return True
    _check_address(address, key)
    if late:
        raise ConfigError(
            f"{key}={address} would not get this machine's token, as Ray was loaded before; start Python with "
            "RAY_AUTH_MODE=token in its environment, or disabled where the head node asks for none (docs/ray.md)"
        )
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray raises many kinds
        raise ConfigError(
            f"{key}={address} cannot be joined ({reason(error)}); if its head node asks for a token, set "
            f"RAY_AUTH_MODE=token and give it as RAY_AUTH_TOKEN, else set {key}=local (docs/ray.md)"
        ) from error
    try:
        _check_size(ray, workers, f"{key}={address}")
    except ConfigError:
        ray.shutdown()
        raise
    return True


def resolve(address: str) -> str:
    """Return the address that "auto" stands for, others as they are."""
    return os.environ.get("RAY_ADDRESS") or "local" if address == "auto" else address


def _check_size(ray: Any, workers: int, cluster: str) -> None:
    """Refuse more workers than a cluster has CPUs that nobody uses: they would wait for ever."""
    there = int(ray.cluster_resources().get("CPU", 0))
    if there < workers:
        raise ConfigError(f"the cluster {cluster} has {there} CPUs for {workers} workers; ask for fewer workers")
    if ray.util.get_current_placement_group() is not None:  # what is reserved for this process counts as used
        return
    deadline = time.monotonic() + _ROOM
    while (free := int(ray.available_resources().get("CPU", 0))) < workers:
        if time.monotonic() > deadline:
            raise ConfigError(
                f"the cluster {cluster} has {free} of its {there} CPUs free for {workers} workers; wait for what uses "
                "them, ask for fewer workers, or use another cluster"
            )
        time.sleep(0.2)


class Head:
    """The head node of the cluster that this process is connected to."""

    def __init__(self) -> None:
        import ray

        self.address: str = ray.get_runtime_context().gcs_address
        self._missed, self._next = 0, 0.0

    def check(self) -> None:
        """Refuse, by a ConfigError, a head node that does not answer any more; ask it at most once a second.

        Ray itself waits for a minute, and then ends this process.
        """
        if time.monotonic() < self._next:
            return
        self._missed = 0 if _say_hello(self.address) == "" else self._missed + 1
        self._next = time.monotonic() + 1.0
        if self._missed >= _MISSED:
            raise ConfigError(
                f"the head node {self.address} of the cluster of Ray is lost; go on with another cluster, or without "
                "workers"
            )


class Silent(Exception):
    """An actor does not say that it is alive: its process was stopped, say, or its machine is gone."""


class Pulse:
    """Whether an actor is alive: its method `pulse`, in the concurrency group of that name, answers in time.

    Args:
        key: of the number of workers, for messages.
    """

    def __init__(self, key: str):
        self._key, self._starts, self._deadline = key, True, 0.0
        self._answer: Any = None

    def check(self, actor: Any) -> None:
        """Ask an actor, or look for its answer; to be called again and again while its work is waited for.

        Raises:
            ConfigError: its process has not started in time.
            Silent: it runs no more.
        """
        import ray

        now = time.monotonic()
        if self._answer is None:
            self._answer = actor.pulse.options(concurrency_group="pulse").remote()
            self._deadline = now + (START if self._starts else SILENCE)
        elif ray.wait([self._answer], timeout=0)[0]:  # also where it has died, which its work tells
            self._starts, self._answer = False, None
        elif now > self._deadline:
            if self._starts:
                raise ConfigError(
                    f"a worker of Ray has not started within {START:.0f} s: the cluster is full, or its nodes are too "
                    f"busy; ask for fewer workers ({self._key}), or use another cluster"
                )
            raise Silent


def enter_worker(folder: str, path: list[str]) -> None:
    """Take over working folder and Python's path of the caller, in a process of Ray, for modules of one's own."""
    for number in STOPPING:
        if number != signal.SIGTERM:  # Ctrl-C reaches all processes of a terminal; the caller ends its workers
            signal.signal(number, signal.SIG_IGN)
    if os.path.isdir(folder):
        os.chdir(folder)
    sys.path += [each for each in path if each not in sys.path]


def check_versions(caller: dict[str, str]) -> None:
    """Refuse, by a ConfigError in a process of Ray, versions that are not its caller's: results would differ."""
    here = find_versions()
    if here != caller:
        own, others = (", ".join(" ".join(each) for each in found.items()) for found in (here, caller))
        raise ConfigError(
            f"the node {socket.gethostname()} of the cluster of Ray has {own}, but its caller has {others}; install "
            "the same on every node (docs/ray.md)"
        )


def get(result: Any) -> Any:
    """Return a result of Ray; what its process raised is raised as it would be here."""
    import ray

    try:
        return ray.get(result)
    except ray.exceptions.RayTaskError as error:
        # Its own text is a traceback.
        raise error.cause from error


def wait(result: Any, check: Callable[[], None]) -> None:
    """Wait for a result of Ray, and call `check`, which may raise, again and again meanwhile."""
    import ray

    while not ray.wait([result], timeout=1.0)[0]:
        check()


def disconnect() -> None:
    """Leave Ray; a local cluster ends with all of its processes."""
    import ray

    try:
        ray.shutdown()
    finally:
        if handles_signals():  # Ray's core has put the system's own handlers in their place
            for number in STOPPING:
                signal.signal(number, signal.getsignal(number) or signal.SIG_DFL)


def _start_local(ray: Any, cpus: int, quiet: dict[str, Any]) -> None:
    """Start a cluster on the loopback address."""
    from ray._private import services

    replaced = services.resolve_ip_for_localhost
    services.resolve_ip_for_localhost = lambda host: host
    try:
        ray.init("local", num_cpus=cpus, _node_ip_address=_LOOPBACK, **quiet)
    finally:
        services.resolve_ip_for_localhost = replaced
    last_acts.add(_kill_local)


def _kill_local() -> None:
    """End the processes of the local cluster, if there still is one, without a word to Ray in this process."""
    from ray._private import worker

    node: Any = worker._global_node
    if node is not None:
        node.kill_all_processes(check_alive=False, allow_graceful=True)


def _check_address(address: str, key: str) -> None:
    """Refuse an address where nothing answers: Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"{key}={address} is no host:port of a Ray cluster's head node; give one, local or auto")
    if why := _say_hello(f"{host}:{port}"):
        raise ConfigError(f"{key}={address} {why}; start a head node there by ray start --head, or set {key}=local")


def _say_hello(address: str) -> str:
    """Return why an address is no head node's, as the rest of a sentence; "" if it may be: it speaks HTTP/2 at once."""
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), _WAIT) as connection:
            connection.sendall(_HELLO)
            answer = connection.recv(9)  # the head of a frame
    except TimeoutError:
        return "does not answer as a head node of Ray does"
    except ConnectionResetError:
        return "does not answer as a head node of Ray does"
    except OSError as error:
        return f"does not answer ({reason(error)})"
    return "" if len(answer) > 3 and answer[3] == _SETTINGS else "is the port of another program"


def use_token() -> bool:
    """Give the token of this machine where there is one and nobody says otherwise, as `ray start` itself does.

    Returns:
        False where it is too late: Ray's core, which torchrl loads, too, reads the mode when it is loaded.
    """
    file = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or os.path.expanduser("~/.ray/auth_token"))
    if "RAY_AUTH_MODE" not in os.environ and ("RAY_AUTH_TOKEN" in os.environ or os.path.isfile(file)):
        if _CORE in sys.modules:
            return False
        os.environ["RAY_AUTH_MODE"] = "token"
    return True
