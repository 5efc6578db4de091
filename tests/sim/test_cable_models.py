"""Cable models are modules with the same functions; what the world and the configuration know of them is a name."""

from __future__ import annotations

import inspect
from typing import get_args

import numpy as np
import pytest
from conftest import hover_thrust, make_system

from multilift_marl.schema.sections import CableConfig
from multilift_marl.sim import World
from multilift_marl.sim.cables import CABLE_MODELS, CableModel

FUNCTIONS = [name for name, value in vars(CableModel).items() if inspect.isfunction(value) and name[0] != "_"]


def parameters(function) -> list[str]:
    """Return the names of a function's parameters, compiled or not."""
    return [name for name in inspect.signature(getattr(function, "py_func", function)).parameters if name != "self"]


def test_the_configuration_names_every_model():
    assert set(get_args(CableConfig.model_fields["model"].annotation)) == set(CABLE_MODELS)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("model", CABLE_MODELS.values(), ids=CABLE_MODELS)
def test_every_model_has_the_same_functions(model, function):
    assert parameters(getattr(model, function)) == parameters(getattr(CableModel, function))


@pytest.mark.parametrize("model", CABLE_MODELS)
def test_a_slack_start_has_no_tension_in_any_model(model):
    world = World(make_system(2, **{"cable.model": model}), 1, 1)
    assert 0 < world.cable_model.SLACK <= 1
    world.state.drone_position[..., 2] -= 0.1
    world.load(np.ones(1, bool))
    assert (world.state.cable_tension == 0).all()


def test_a_third_model_is_a_module_and_a_line(monkeypatch):
    monkeypatch.setitem(CABLE_MODELS, "third", CABLE_MODELS["chain"])
    system = make_system(2, **{"cable.model": "chain"})
    worlds = [World(system, 1, 1)]
    object.__setattr__(system, "cable_model", "third")
    worlds.append(World(system, 1, 1))
    for world in worlds:
        world.step(hover_thrust(world), 5)
    np.testing.assert_array_equal(worlds[0].state.drone_position, worlds[1].state.drone_position)
