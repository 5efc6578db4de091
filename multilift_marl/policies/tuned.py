"""Linear policies by tuned gains, one for a recipe, in YAML files in `gains/`: `train.residual` names them.

`results/search_gains.py` found them. `policy` and `baseline` of `evaluate.py` take one as
`multilift_marl.policies.tuned:HoverRealistic`, since a shipped learned policy may have the same name.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from multilift_marl.policies.formation import (
    Formation,
    FormationFeedback,
    FormationLead,
    FormationNarrow,
    FormationRedistributed,
)
from multilift_marl.policies.hold import HoldAccRates, HoldCtbr
from multilift_marl.schema.training import GAINS
from multilift_marl.schema.yaml_text import read_yaml

_BASES: dict[str, type[Formation]] = {
    "formation": Formation,
    "formation_feedback": FormationFeedback,
    "formation_lead": FormationLead,
    "formation_narrow": FormationNarrow,
    "formation_redistributed": FormationRedistributed,
    "hold_acc_rates": HoldAccRates,
    "hold_ctbr": HoldCtbr,
}
"""What gains are of, by the `base` of their file: its actions, and what it needs to observe."""


@cache
def tuned_policy(name: str) -> type[Formation]:
    """Return the class, named `HoverRealistic`, of the linear policy whose gains are `gains/hover_realistic.yaml`."""
    path = GAINS / f"{name}.yaml"
    content = read_yaml(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.removeprefix("#").strip() for line in lines if line.startswith("#"))
    gains = tuple((str(observed), axis, moved, float(gain)) for observed, axis, moved, gain in content["gains"])
    values = {"GAINS": gains, "__doc__": comment, "__module__": __name__}
    return type("".join(word.title() for word in name.split("_")), (_BASES[content["base"]],), values)


def __getattr__(name: str) -> Any:
    """Return the class of a tuned policy by its own name."""
    tuned = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    if not name.startswith("_") and (GAINS / f"{tuned}.yaml").is_file():
        return tuned_policy(tuned)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
