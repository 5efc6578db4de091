"""Keys of `planner` at both of their bounds, ideal and realistic: whatever is flown then, actions are finite."""

from __future__ import annotations

import annotated_types
import numpy as np
import pytest
from test_mpc import BY_RATES, FULL_STATE

import multilift_marl as ml
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.planner import PlannerConfig

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # of full scales that limit what is commanded


def bounds():
    """Return names and values of all keys that have bounds; the most iterations and steps take too long."""
    found = []
    for name, field in PlannerConfig.model_fields.items():
        for limit in field.metadata:
            if isinstance(limit, annotated_types.Ge):
                found.append((name, limit.ge))
            elif hasattr(limit, "low"):
                found += [(name, limit.low), (name, limit.high)]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("limits", "conditions"), [("soft", "hover_realistic"), ("hard", "track")])
@pytest.mark.parametrize(("key", "value"), bounds())
def test_actions_are_finite(key, value, limits, conditions):
    overrides = FULL_STATE if key == "feedback" else BY_RATES
    overrides = overrides | {"env.num_envs": 3, "env.num_threads": 1, "control.disturbance": "none"}
    overrides |= {f"planner.{key}": value, "planner.limits": limits}
    vec = ml.make_vec(conditions, **overrides)
    policy = make_scripted("mpc", vec)
    observation, _ = vec.reset(seed=3)
    policy.reset()
    for _ in range(25):
        action = policy.act(observation)
        assert np.isfinite(action).all()
        observation, _, terminated, truncated, _ = vec.step(action, restart=True)
        policy.reset(terminated | truncated)
