"""Networks over drones: what they must not depend on, the order and the number of drones, holds exactly."""

import pytest
import torch
from torchrl.modules import PopArtValueNorm

from multilift_marl.agents.networks import Actor, CentralCritic, Tanh, build_actor, draw_action
from multilift_marl.errors import ConfigError
from multilift_marl.mdp.global_state import DroneNumbers
from multilift_marl.schema.training import TrainConfig

KINDS = ("local", "set", "attention")
SHARED, SIZE, REST = 5, 7, 3


def make_actor(kind: str, asinh: float = 0.0) -> Actor:
    torch.manual_seed(0)
    actor = Actor(kind, 11, 4, (16, 16), 0.3, torch.zeros(4, 11), asinh=asinh)
    actor.normalizer.update(torch.randn(100, 11))
    with torch.no_grad():
        torch.nn.init.orthogonal_(actor.team.net[-1].weight)  # as after training
    return actor


def make_critic(kind: str, num_drones: int, asinh: float = 0.0) -> CentralCritic:
    torch.manual_seed(0)
    drones = DroneNumbers(SHARED, num_drones, SIZE)
    size = SHARED + num_drones * SIZE + REST
    return CentralCritic(kind, size, drones, (16, 16), PopArtValueNorm(shape=1), asinh)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_actors_give_each_drone_its_action_in_any_order(kind, asinh):
    actor, observation = make_actor(kind, asinh), torch.randn(6, 5, 11)
    order = torch.randperm(5)
    torch.testing.assert_close(actor(observation[:, order])[0], actor(observation)[0][:, order])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_an_untrained_actor_acts_as_its_base(kind, asinh):
    base, observation = torch.randn(4, 11), torch.randn(6, 5, 11)
    actor = Actor(kind, 11, 4, (16, 16), 0.3, base, asinh=asinh)
    torch.testing.assert_close(actor(observation)[0], torch.einsum("ak,enk->ena", base, observation))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num_drones", [1, 3, 8])
def test_actors_fly_any_number_of_drones(kind, num_drones):
    mean, deviation = make_actor(kind)(torch.randn(2, num_drones, 11))
    assert mean.shape == deviation.shape == (2, num_drones, 4)


@pytest.mark.parametrize(("kind", "told"), [("local", False), ("set", True), ("attention", True)])
def test_what_others_observe_matters_to_team_networks_alone(kind, told):
    actor, observation = make_actor(kind), torch.randn(3, 4, 11)
    changed = observation.clone()
    changed[:, 1:] += 1.0
    assert torch.equal(actor(observation)[0][:, 0], actor(changed)[0][:, 0]) != told


@pytest.mark.parametrize("kind", ["set", "attention"])
@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_critics_of_sets_value_a_team_in_any_order(kind, asinh):
    critic, state = make_critic(kind, 4, asinh), torch.randn(6, SHARED + 4 * SIZE + REST)
    rows = state[:, SHARED : SHARED + 4 * SIZE].reshape(6, 4, SIZE)[:, torch.randperm(4)]
    permuted = torch.cat([state[:, :SHARED], rows.reshape(6, -1), state[:, -REST:]], -1)
    torch.testing.assert_close(critic(permuted), critic(state))
    assert critic(state).shape == (6, 4, 1)


@pytest.mark.parametrize("kind", ["set", "attention"])
def test_weights_of_such_critics_fit_any_team(kind):
    shapes = [{name: p.shape for name, p in make_critic(kind, n).team.named_parameters()} for n in (2, 6)]
    assert shapes[0] == shapes[1]


def test_actions_are_drawn_from_the_gaussian_that_their_probability_says():
    torch.manual_seed(0)
    mean, deviation = torch.full((20000, 2, 3), 2.0), torch.tensor([0.5, 1.0, 0.1])
    action, log_prob = draw_action(mean, deviation, torch.randn_like(mean))
    torch.testing.assert_close(log_prob, torch.distributions.Normal(mean, deviation).log_prob(action).sum(-1))
    torch.testing.assert_close(action.std((0, 1)), deviation, rtol=0.02, atol=0)
    torch.testing.assert_close(action.mean((0, 1)), mean[0, 0], rtol=0.01, atol=0)


def test_the_fast_tanh_is_tanh_and_its_gradient_too():
    x, tanh = torch.linspace(-20, 20, 100_001), Tanh()
    assert (tanh(x).double() - torch.tanh(x.double())).abs().max() < 2e-7
    wide = torch.linspace(-4, 4, 20, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(tanh, wide)
    with torch.no_grad():
        assert torch.equal(tanh(wide), tanh(wide.detach()))
    assert torch.equal(tanh(wide).detach(), tanh(wide.detach()))


@pytest.mark.parametrize("gru", [0, 8])
@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_networks_take_the_components_that_are_named_alone(gru, asinh):
    """Neither action nor memory changes with another number, whereas the base policy takes all."""
    torch.manual_seed(0)
    names = ["slot_error_0", "slot_error_1", "velocity_0", "slot_error_0@-1"]
    train = TrainConfig(hidden=(16,), gru=gru, asinh=asinh, observe=("slot_error",))
    actor = build_actor(train, torch.zeros(2, 4), names)
    actor.normalizer.update(torch.randn(100, 4))
    with torch.no_grad():
        torch.nn.init.orthogonal_(actor.team.net[-1].weight)

    def act(observation):
        memory = actor.remember(observation, torch.zeros(1, gru)) if gru else None
        return actor(observation, memory)[0]

    first = torch.randn(1, 4)
    for number, counts in enumerate((True, True, False, True)):
        other = first.clone()
        other[0, number] += 0.5
        assert bool((act(other) != act(first)).any()) == counts, names[number]
    actor.base[0, 2] = 1.0
    other = first + torch.tensor([0.0, 0.0, 0.5, 0.0])
    torch.testing.assert_close(act(other)[0, 0] - act(first)[0, 0], torch.tensor(0.5))


@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_a_network_may_take_how_much_earlier_steps_differ(asinh):
    """It acts as one that is given the differences."""
    names = [f"{name}{age}" for age in ("", "@-2", "@-9") for name in ("a_0", "b_0")]
    told, given = (
        build_actor(TrainConfig(hidden=(16,), asinh=asinh, changes=changes), torch.zeros(2, 6), names)
        for changes in (True, False)
    )
    rng = torch.manual_seed(0)
    torch.nn.init.orthogonal_(given.team.net[-1].weight)
    told.load_state_dict(given.state_dict())
    seen = torch.randn(100, 3, 6, generator=rng) + torch.tensor([5.0, -3.0] * 3)
    differ = torch.cat([seen[..., :2], seen[..., 2:4] - seen[..., :2], seen[..., 4:] - seen[..., :2]], -1)
    told.normalizer.update(seen)
    given.normalizer.update(differ)
    assert torch.equal(told(seen)[0], given(differ)[0])
    assert not torch.equal(told(seen)[0], given(seen)[0])
    with pytest.raises(ConfigError, match=r"train.changes=true .* env.history"):
        build_actor(TrainConfig(changes=True), torch.zeros(2, 2), ["a_0", "b_0"])


def test_a_component_that_is_not_observed_is_refused_by_name():
    with pytest.raises(ConfigError, match="no component 'slot_eror'; did you mean 'slot_error'"):
        build_actor(TrainConfig(observe=("slot_eror",)), torch.zeros(1, 1), ["slot_error_0"])
