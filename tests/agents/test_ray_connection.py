"""Connecting to a cluster of Ray: ports, heads and tokens; what cannot be joined is refused in a sentence."""

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from conftest import make_trainer

from multilift_marl import _ray
from multilift_marl.errors import ConfigError

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "is the port of another program"),
        (b"", "is the port of another program"),
        (None, "does not answer as a head node of Ray does"),
        (bytes([0, 0, 6, 4, 0, 0, 0, 0, 0]), ""),
    ],
    ids=["http", "closed", "silent", "http2"],
)
def test_the_port_of_another_program_is_told_at_once(monkeypatch, answer, words):
    if answer is None:
        monkeypatch.setattr(_ray, "_WAIT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"

        def serve():
            connection, _ = server.accept()
            if answer is not None:
                connection.recv(100)
                connection.sendall(answer)
                connection.close()
            else:
                time.sleep(3.0)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        if words:
            with pytest.raises(ConfigError, match=f"train.ray={address} {words}; start a head node"):
                _ray._check_address(address, "train.ray")
        else:
            _ray._check_address(address, "train.ray")


def test_a_head_node_that_is_lost_is_told_after_a_few_seconds(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"  # nobody listens there afterwards
    head = _ray.Head.__new__(_ray.Head)
    head.address, head._missed, head._next = address, 0, 0.0
    clock = iter(range(0, 100, 2))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    for _ in range(_ray._MISSED - 1):
        head.check()
    with pytest.raises(ConfigError, match=f"the head node {address} of the cluster of Ray is lost"):
        head.check()


def forget_tokens(monkeypatch):
    """Remove what tells Ray of tokens until the test ends, and then what the test has made of it."""
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(name, "")  # `delenv` alone remembers nothing of a name that is not there
        monkeypatch.delenv(name)


def test_a_token_is_given_where_there_is_one_and_nobody_says_otherwise(tmp_path, monkeypatch):
    forget_tokens(monkeypatch)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "ray._raylet", None)
    assert _ray.use_token() and "RAY_AUTH_MODE" not in os.environ
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("a")
    assert not _ray.use_token() and "RAY_AUTH_MODE" not in os.environ  # too late
    monkeypatch.delitem(sys.modules, "ray._raylet")
    assert _ray.use_token() and os.environ["RAY_AUTH_MODE"] == "token"
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    assert _ray.use_token() and os.environ["RAY_AUTH_MODE"] == "disabled"


SPY = """
import os, sys
class Spy:
    def find_spec(self, name, path=None, target=None):
        if name == "ray._raylet":
            print("mode", os.environ.get("RAY_AUTH_MODE"), flush=True)
            os._exit(0)
sys.meta_path.insert(0, Spy())
from multilift_marl.cli.train import main
sys.exit(main())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "address", "mode"),
    [
        (["config=hover", "train.ray=127.0.0.1:1"], "", "token"),
        (["resume=latest", "train.ray=127.0.0.1:1"], "", "token"),
        (["config=hover"], "127.0.0.1:1", "token"),
        (["config=hover"], "", None),
    ],
    ids=["typed", "resumed", "environment", "local"],
)
def test_training_on_a_cluster_gives_the_token_before_the_core_of_ray_is_loaded(tmp_path, arguments, address, mode):
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("a")
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, "-c", SPY, *arguments, "train.workers=1"], capture_output=True, text=True, cwd=tmp_path,
        env=kept | {"HOME": str(tmp_path), "RAY_ADDRESS": address},
    )  # fmt: skip
    assert done.stdout == f"mode {mode}\n", done.stderr


def test_a_token_that_would_not_be_given_is_told(tmp_path, monkeypatch):
    import ray

    if ray.is_initialized():
        ray.shutdown()
    forget_tokens(monkeypatch)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    monkeypatch.setattr(_ray, "_check_address", lambda address, key: None)
    with pytest.raises(
        ConfigError, match=r"train.ray=127.0.0.1:1 would not get .*; start Python with RAY_AUTH_MODE=token"
    ):
        make_trainer(tmp_path, **{"train.workers": 1, "train.ray": "127.0.0.1:1"})


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"train.ray": "127.0.0.1:1"}, "does not answer"),
        ({"train.ray": "nowhere"}, "host:port"),
        ({"train.workers": 9}, "env.num_envs=8"),
    ],
)
def test_what_cannot_be_joined_is_refused_in_a_sentence(tmp_path, settings, word):
    import ray

    if ray.is_initialized():
        ray.shutdown()
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=word):
        make_trainer(tmp_path, **{"train.workers": 2} | settings)
    assert time.perf_counter() - start < 60 and not list(tmp_path.iterdir())


def test_without_ray_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install .*ray"):
        make_trainer(tmp_path, **{"train.workers": 2})
