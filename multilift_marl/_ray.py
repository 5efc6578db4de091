"""Connections to Ray: a cluster of this machine alone, on its loopback address, or one that runs already."""

from __future__ import annotations

import logging
import os
import socket
from typing import Any

from multilift_marl._platform import cpu_count
from multilift_marl.errors import ConfigError, pip_install, reason

_LOOPBACK = "127.0.0.1"
_WAIT = 5.0  # [s] for a head node to answer


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
        ConfigError: Ray is missing, the address does not answer, or the cluster has fewer CPUs than workers.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read by Ray when it is imported
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ConfigError(f"workers need Ray; {pip_install('ray')}") from error
    if ray.is_initialized():
        _check_size(ray, workers, "that is connected")
        return False
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS") or "local"
    quiet: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    if address == "local":
        _start_local(ray, max(workers, cpu_count()), quiet)
        return True
    _check_address(address, key)
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray raises many kinds
        raise ConfigError(f"{key}={address} cannot be joined ({reason(error)}); set {key}=local") from error
    try:
        _check_size(ray, workers, f"{key}={address}")
    except ConfigError:
        ray.shutdown()
        raise
    return True


def _check_size(ray: Any, workers: int, cluster: str) -> None:
    """Refuse more workers than a cluster has CPUs: they would wait for ever."""
    there = int(ray.cluster_resources().get("CPU", 0))
    if there < workers:
        raise ConfigError(f"the cluster {cluster} has {there} CPUs for {workers} workers; ask for fewer workers")


def disconnect() -> None:
    """Leave Ray; a local cluster ends with all of its processes."""
    import ray

    ray.shutdown()


def _start_local(ray: Any, cpus: int, quiet: dict[str, Any]) -> None:
    """Start a cluster on the loopback address.

    Ray replaces a loopback address by that of a network card, for the sake of nodes elsewhere, of which there are none.
    """
    from ray._private import services

    replaced = services.resolve_ip_for_localhost
    services.resolve_ip_for_localhost = lambda host: host
    try:
        ray.init("local", num_cpus=cpus, _node_ip_address=_LOOPBACK, **quiet)
    finally:
        services.resolve_ip_for_localhost = replaced


def _check_address(address: str, key: str) -> None:
    """Refuse an address where nothing answers: Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"{key}={address} is no host:port of a Ray cluster's head node; give one, local or auto")
    try:
        socket.create_connection((host, int(port)), _WAIT).close()
    except OSError as error:
        raise ConfigError(
            f"{key}={address} does not answer ({reason(error)}); start a head node there by ray start --head, or set "
            f"{key}=local"
        ) from error
