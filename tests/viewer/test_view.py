"""The browser viewer: what its buttons do to the flight, that it is served to this machine alone, what it shows."""

import asyncio
import http.client
import socket
import subprocess
import sys
import threading
import urllib.request

import numpy as np
import pytest

from multilift_marl.errors import CheckpointError, ConfigError, RenderingError, pip_install
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.viewer import inputs
from multilift_marl.viewer.__main__ import main, make_session
from multilift_marl.viewer.page import HOST, Page, _group
from multilift_marl.viewer.session import PUSH_SECONDS

SMALL = {"randomization.payload_force": 0.0, "env.num_threads": 1}


def session(**values):
    return make_session({"task": "hover", "seed": 7} | SMALL | values)[0]


def positions(flight):
    state = flight.vec.world.state
    return np.vstack([state.payload_position[0], state.drone_position[0]])


def test_time_passes_at_the_speed_chosen():
    flight = session()
    for speed in (1.0, 0.5, 4.0):
        before, flight.speed = flight.vec.steps[0], speed
        steps = sum(flight.advance(0.03) for _ in range(10))
        assert abs(steps - 0.3 * speed / flight.vec.task.dt) <= 1
        assert flight.vec.steps[0] - before == steps


def test_a_pause_holds_everything_and_a_step_goes_on_by_one():
    flight = session()
    flight.paused = True
    before = positions(flight)
    assert flight.advance(1.0) == 0 and (positions(flight) == before).all()
    flight.step()
    assert flight.vec.steps[0] == 1 and (positions(flight) != before).any()
    flight.paused = False
    assert flight.advance(0.1) == 5  # the second of the pause is not made up for


def test_a_slow_machine_falls_behind_the_clock():
    flight = session()
    assert flight.advance(60.0) == 20


def test_reset_repeats_the_episode_and_next_starts_another():
    flight = session()
    start = positions(flight)
    flight.advance(0.2)
    steps = positions(flight)
    flight.reset()
    assert (positions(flight) == start).all() and flight.vec.steps[0] == 0 and flight.vec.episodes[0] == 0
    flight.advance(0.2)
    assert (positions(flight) == steps).all()
    flight.skip()
    assert flight.vec.episodes[0] == 1 and (positions(flight) != start).any()


def test_the_episodes_are_those_of_evaluation():
    from multilift_marl.evaluation.rollout import trace_episode

    flight = session(seed=1000, policy="formation_integral")
    config, maker = flight.vec.config, flight._makers["formation_integral"]
    seen = []
    trace_episode(config, maker, 0, 1000, lambda vec: seen.append(vec.world.state.payload_position[0].copy()))
    for place in seen[1:21]:
        flight.step()
        assert (flight.vec.world.state.payload_position[0] == place).all()


def test_the_outcome_of_an_episode_is_shown_and_the_next_one_begins():
    flight = session(**{"env.episode_seconds": 0.1})
    for _ in range(5):
        flight.step()
    assert flight.outcome.startswith("episode 0: no success, ") and flight.outcome in flight.status()
    flight.step()
    assert flight.vec.episodes[0] == 1 and flight.vec.steps[0] == 0


@pytest.mark.parametrize("heading, elevation", [(0.0, 0.0), (90.0, 0.0), (0.0, 90.0), (-135.0, 30.0)])
def test_a_push_moves_the_payload_its_way_for_half_a_second(heading, elevation):
    pushed, calm = session(), session()
    pushed.push(heading, elevation, 3.0)
    h, v = np.deg2rad(heading), np.deg2rad(elevation)
    direction = np.array([np.cos(v) * np.cos(h), np.cos(v) * np.sin(h), np.sin(v)])
    steps = round(PUSH_SECONDS / pushed.vec.task.dt)
    for step in range(steps):
        assert np.allclose(pushed.vec.world.hidden_loads.payload_force[0], 3.0 * direction)
        for flight in (pushed, calm):
            flight.step()
        if step == 2 and elevation == 0:  # while the cables still hang straight: a/2 t² of the hanging mass
            moved = pushed.vec.world.state.payload_velocity[0] - calm.vec.world.state.payload_velocity[0]
            assert moved @ direction > 0.7 * np.linalg.norm(moved) > 0.02
    assert (pushed.vec.world.hidden_loads.payload_force[0] == calm.vec.world.hidden_loads.payload_force[0]).all()
    gap = (positions(pushed) - positions(calm))[0]
    assert gap @ direction > 0.5 * np.linalg.norm(gap) > 0


def test_a_push_adds_to_the_hidden_force_and_a_reset_ends_it():
    flight = session(**{"randomization.payload_force": 1.5})
    hidden = flight.vec.world.hidden_loads.payload_force[0].copy()
    for _ in range(2):  # the second push takes the place of the first
        flight.push(0.0, 0.0, 2.0)
        assert np.allclose(flight.vec.world.hidden_loads.payload_force[0], hidden + [2, 0, 0])
        flight.step()
    flight.reset()
    for _ in range(30):
        assert (flight.vec.world.hidden_loads.payload_force[0] == hidden).all()
        flight.step()


def test_policies_change_in_flight():
    flight, other = session(policy="formation"), session(policy="formation_integral")
    assert flight.policies == other.policies
    for each in (flight, other):
        each.advance(0.2)
    assert (positions(flight) != positions(other)).any()
    flight.choose("formation_integral")
    assert flight.policy == "formation_integral"
    with pytest.raises(ConfigError, match="unknown policy 'formatio'; did you mean 'formation'"):
        flight.choose("formatio")
    flight.advance(0.2)


def test_the_team_flies_on_while_a_policy_that_is_chosen_compiles():
    flight, asked, go_on = session(policy="formation"), threading.Event(), threading.Event()

    class Slow:
        def __init__(self, vec):
            self.policy = make_scripted("formation_integral", vec)

        def act(self, observation):
            asked.set()
            assert go_on.wait(30)
            return self.policy.act(observation)

        def reset(self, mask=None):
            self.policy.reset(mask)

    flight._makers["slow"] = Slow
    choosing = threading.Thread(target=flight.choose, args=("slow",))
    choosing.start()
    assert asked.wait(30)
    begun = flight.vec.steps[0]
    flight.step()
    assert flight.policy == "formation" and flight.vec.steps[0] == begun + 1 and flight.status()
    go_on.set()
    choosing.join(30)
    assert flight.policy == "slow"


def test_a_trained_policy_is_the_first_and_one_that_does_not_fit_is_refused():
    pytest.importorskip("torch")
    flight = make_session({"run": "hover"} | SMALL)[0]
    assert flight.policy == "run" and flight.vec.task.name == "hover" and "formation" in flight.policies
    flight.advance(0.1)
    with pytest.raises(ConfigError, match="the policy run was trained in task hover and cannot fly this track: "):
        make_session({"run": "hover", "task": "track"} | SMALL)
    with pytest.raises(
        ConfigError,
        match=r"the policy run was trained .* and cannot fly velocity; set control\.action=reference",
    ):
        make_session({"run": "hover", "control.action": "velocity"} | SMALL)
    with pytest.raises(CheckpointError, match="no run folder nowhere"):
        make_session({"run": "nowhere"})


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["task=hove"], "no configuration named 'hove'; did you mean 'hover'?"),
        (["policy=formatio"], "unknown policy 'formatio'; did you mean 'formation'?"),
        (["policy=formation_balanced"], "policy=formation_balanced is for task regroup; take formation_integral"),
        (["policy=mpc"], "the baseline 'mpc' acts by control.action=acc_rates and cannot fly control.action=reference"),
        (["task=hove", "config=rigs/falcon3"], "no configuration named 'hove'; did you mean 'hover'?"),
        (["policy=run"], "unknown policy 'run'; known: formation"),
        (["port=70000"], "port must be from 0 to 65535, but is 70000"),
        (["seed=-1"], "seed must be greater than or equal to 0, but is -1"),
        (["env.num_drone=3"], "env.num_drone"),
        (["prot=0"], "unknown key 'prot'; did you mean 'port'?"),
    ],
)
def test_what_cannot_be_watched_is_said_in_one_sentence(capsys, arguments, message):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}") or message in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_without_viser_the_error_names_the_extra():
    code = (
        "import sys; sys.modules['viser'] = None\nfrom multilift_marl.viewer.__main__ import main; sys.exit(main([]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"error: the browser viewer needs viser: {pip_install('view')}\n"


@pytest.fixture
def page():
    pytest.importorskip("viser")
    page = Page(session(), port=0)
    yield page
    page.close()


def listeners(port):
    """Return the local addresses, as the kernel has them, that listen on a port."""
    found = []
    for table in ("tcp", "tcp6"):
        with open(f"/proc/net/{table}") as lines:
            for line in list(lines)[1:]:
                local, state = line.split()[1], line.split()[3]
                if state == "0A" and int(local.rpartition(":")[2], 16) == port:
                    found.append(local.rpartition(":")[0])
    return found


def test_the_page_is_served_to_this_machine_alone(page):
    with urllib.request.urlopen(page.address, timeout=30) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
    assert listeners(page.port) == ["0100007F"]  # 127.0.0.1, and no other address


@pytest.mark.parametrize("upgrade", [False, True], ids=["page", "websocket"])
def test_only_who_has_the_address_may_open_the_page(page, upgrade):
    own, token = f"{HOST}:{page.port}", page.address.partition("=")[2]
    cookie, wrong = f"multilift_{page.port}={token}", f"multilift_{page.port}={token[:-1]}"
    websocket = {
        "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }  # fmt: skip

    def ask(path="/", host=own, **headers):
        connection = http.client.HTTPConnection(own, timeout=30)
        connection.request("GET", path, headers={"Host": host} | headers | (websocket if upgrade else {}))
        answer = connection.getresponse()
        connection.close()
        return answer.status, answer.getheader("Set-Cookie", "")

    opened = 101 if upgrade else 200
    assert ask(f"/?token={token}")[0] == opened
    assert ask(Cookie=f"theirs={{}}; {cookie}", Origin=f"http://{own}")[0] == opened
    assert ask(f"/?token={token}", host="localhost:9000", Origin="http://localhost:9000")[0] == opened  # a tunnel
    if not upgrade:
        given = ask(f"/?token={token}")[1]
        assert given.startswith(f"{cookie}; ") and "HttpOnly" in given and "SameSite=Strict" in given
    for refused in (
        ask(), ask(f"/?token={token[:-1]}"), ask("/?token="), ask(Cookie=wrong),
        ask(f"/?token={token}", host="evil.com"),
        ask(f"/?token={token}", host=f"{HOST}.evil.com:{page.port}"), ask(f"/?token={token}", host="["),
        ask(f"/?token={token}", host=f"evil@{own}"), ask(f"/?token={token}", host=f"{own}/a"), ask("//[?token=a"),
        ask("/?token=%ff%c3%28"), ask(Cookie=f"{wrong}\u00fc"),
        ask(Cookie=cookie, Origin="http://evil.com"), ask(Cookie=cookie, Origin="null"),
        ask(Cookie=cookie, Origin="http://127.0.0.1:1"), ask(Cookie=cookie, Origin=f"https://{own}"),
    ):  # fmt: skip
        assert refused == (403, "")


def send(page, name, **updates):
    """Have the page get a message of a browser that changes attributes of a control."""
    from viser import _messages

    [handle] = page._server.gui._websock_interface._incoming_handlers[_messages.GuiUpdateMessage]
    asyncio.run(handle(0, _messages.GuiUpdateMessage(page.controls[name]._impl.uuid, updates)))


def test_browsers_change_values_of_fields_alone_and_to_possible_ones(page):
    controls = page.controls
    for name, value in (("heading", 90), ("force", 1), ("speed", "4"), ("follow", False)):
        send(page, name, value=value)
        assert controls[name].value == value
    for name, updates in (
        ("pause", {"__class__": str}), ("pause", {"label": "mine"}), ("heading", {"value": 5, "max": 1e9}),
        ("pause", {"update_cb": []}), ("speed", {"removed": True}), ("pause", {}), ("status", {"content": "mine"}),
        ("heading", {"value": float("nan")}), ("heading", {"value": 1e9}), ("heading", {"value": "5"}),
        ("heading", {"value": True}), ("heading", {"value": [5]}), ("heading", {"value": None}),
        ("speed", {"value": "9"}), ("speed", {"value": 1}), ("policy", {"value": "os:system"}),
        ("follow", {"value": "no"}), ("follow", {"value": 1}),
    ):  # fmt: skip
        before = {key: repr(value) for key, value in vars(controls[name]._impl).items()}
        send(page, name, **updates)
        assert {key: repr(value) for key, value in vars(controls[name]._impl).items()} == before, (name, updates)


def test_presses_that_nobody_waits_for_are_dropped(page, monkeypatch):
    monkeypatch.setattr(inputs, "_MOST_WAITING", 0)
    send(page, "speed", value="4")
    send(page, "heading", value=45)
    assert (page.controls["speed"].value, page.controls["heading"].value) == ("1", 45)


def test_a_port_that_is_taken_is_named(page):
    with pytest.raises(RenderingError, match=f"port {page.port} of 127.0.0.1 is taken"):
        Page(page._session, page.port)
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        with pytest.raises(RenderingError, match="give another by port="):
            Page(page._session, other.getsockname()[1])


def test_controls_act_on_the_flight(page):
    flight, controls = page._session, page.controls
    page.press("pause")
    assert flight.paused and controls["pause"].label == "Go on"
    page.press("step")
    assert flight.vec.steps[0] == 1
    controls["heading"].value, controls["force"].value = 90, 5.0
    page.press("push")
    assert np.allclose(flight.vec.world.hidden_loads.payload_force[0], [0, 5, 0])
    page.press("reset")
    assert flight.vec.steps[0] == 0 and not flight.vec.world.hidden_loads.payload_force.any()
    page.press("next")
    assert flight.vec.episodes[0] == 1
    controls["speed"].value = "4"
    controls["policy"].value = "formation_integral"
    for name in ("speed", "policy", "pause"):
        page.press(name)
    assert (flight.speed, flight.policy, flight.paused) == (4.0, "formation_integral", False)
    flight.advance(0.1)
    page.draw()
    assert controls["status"].content == flight.status()


@pytest.mark.parametrize("cable", ["massless", "chain"])
def test_the_page_shows_every_body_where_it_is(cable):
    pytest.importorskip("viser")
    flight = session(**{"cable.model": cable, "env.num_drones": 3})
    flight.advance(0.2)
    page = Page(flight, port=0)
    shapes = _group(page._stage.scene)
    assert page._batches.keys() == shapes.keys()
    drawn = np.vstack([place for place, *_ in shapes.values()])
    for place in positions(flight):
        assert np.linalg.norm(drawn - place, axis=1).min() < 1e-5
    page.close()


def test_the_page_shows_trail_and_path_of_a_track():
    pytest.importorskip("viser")
    page = Page(make_session({"task": "track"} | SMALL)[0], port=0)
    before = page._stage.scene.ngeom
    for _ in range(6):
        page._session.advance(0.1)
        page.draw()
    assert page._stage.scene.ngeom > before + 4 * 5  # of four drones and the payload
    page.close()


def test_watching_changes_nothing():
    pytest.importorskip("viser")
    watched, twin = session(), session()
    page = Page(watched, port=0)
    for _ in range(5):
        watched.step()
        page.draw()
        twin.step()
    page.close()
    assert (positions(watched) == positions(twin)).all()
