"""Policy and critics: plain torch modules, the normaliser inside, parameters shared by all drones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.mdp.global_state import DroneNumbers
from multilift_marl.schema.training import TrainConfig

if TYPE_CHECKING:  # policies need torch only
    from torchrl.modules import ValueNorm


class Normalizer(nn.Module):
    """Standardises each number by running statistics that are part of the network (Chan et al. 1979).

    With `asinh` = K it adds a fine scale: beside each number x, asinh(K x / σ) / asinh(K), which changes K / asinh(K)
    times as fast near x = 0 and about as its logarithm far from there. Errors that are metres at the start of an
    episode are millimetres at its end; standardised, these are too small to act on.

    Args:
        size: of what it takes.
        asinh: K; 0: without the fine scale.
        clip: bound of the standardised numbers.
        steps: H, of what it takes: those after the first are replaced by how they differ from that one.

    Attributes:
        copies: how often each number is in what it returns.
        outputs: size of that.
    """

    mean: torch.Tensor
    square: torch.Tensor
    count: torch.Tensor
    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, size: int, asinh: float = 0.0, clip: float = 8.0, steps: int = 1):
        super().__init__()
        self.asinh, self.clip, self.steps = asinh, clip, steps
        self.copies = 2 if asinh else 1
        self.outputs = self.copies * size
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def update(self, batch: torch.Tensor) -> None:
        """Include a batch (..., size) in the statistics."""
        flat = self._differ(batch).reshape(-1, batch.shape[-1]).to(torch.float64, copy=True)
        added, mean = flat.shape[0], flat.mean(0)
        delta, total = mean - self.mean, self.count + added
        # Sums of squares about two means are joined by δ² n m/(n + m), without a second pass over the old ones.
        flat -= mean  # in place, like the square: this is a tenth of an update
        self.square += flat.mul_(flat).sum(0) + delta**2 * self.count * added / total
        self.mean += delta * added / total
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        # The floor of 0.01 leaves a constant number near 0, where 1/σ would blow up its round-off.
        self.scale.copy_(1.0 / (self.square / total).sqrt().clamp(min=1e-2))

    def _differ(self, x: torch.Tensor) -> torch.Tensor:
        if self.steps == 1:
            return x
        steps = x.unflatten(-1, (self.steps, -1))
        return torch.cat([steps[..., :1, :], steps[..., 1:, :] - steps[..., :1, :]], -2).flatten(-2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (..., outputs): zero mean, unit variance, clipped; each followed by the same on the fine scale."""
        x = self._differ(x)
        rows = (x - self.shift).mul_(self.scale).clamp(-self.clip, self.clip)
        if not self.asinh:
            return rows
        # Not shifted by the mean: the fine scale is fine about an error of zero, wherever the mean is.
        fine = (x * (self.asinh * self.scale)).asinh() / math.asinh(self.asinh)
        return torch.stack([rows, fine], -1).flatten(-2)


def fast_tanh(x: torch.Tensor) -> torch.Tensor:
    """Return tanh(x) as 2 / (1 + exp(-2x)) - 1: within 2e-7, several times as fast as torch.tanh is on CPUs."""
    return torch.add(-torch.ones((), dtype=x.dtype), (2 * x).sigmoid_(), alpha=2)


class _Tanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        y = fast_tanh(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        return torch.ops.aten.tanh_backward(gradient, *ctx.saved_tensors)


class Tanh(nn.Module):
    """`fast_tanh` and its gradient."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return tanh(x)."""
        return _Tanh.apply(x) if x.requires_grad else fast_tanh(x)


def mlp(inputs: int, hidden: Sequence[int], outputs: int, gain: float) -> nn.Sequential:
    """Return a perceptron with tanh layers, initialised orthogonally, its last layer with `gain`."""
    widths, layers = [inputs, *hidden], []
    for fan_in, fan_out in zip(widths[:-1], widths[1:], strict=True):
        layers += [_orthogonal(nn.Linear(fan_in, fan_out), math.sqrt(2)), Tanh()]
    return nn.Sequential(*layers, _orthogonal(nn.Linear(widths[-1], outputs), gain))


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class TeamNet(nn.Module):
    """Perceptron of N rows (..., N, inputs) to (..., N, outputs), the same for each row and for any number of them.

    Args:
        kind: what a row learns of the others before the last layer: nothing ("local"), the mean of what all hold
            ("set"; Zaheer et al. 2017), or what it attends to ("attention", four heads; Vaswani et al. 2017).
        inputs, hidden, outputs, gain: see `mlp`.
    """

    HEADS = 4

    def __init__(self, kind: str, inputs: int, hidden: Sequence[int], outputs: int, gain: float):
        super().__init__()
        *inner, last = hidden
        self.kind = kind
        if kind == "local":
            self.net = mlp(inputs, hidden, outputs, gain)
            return
        self.embed = mlp(inputs, inner, last, gain=math.sqrt(2)).append(Tanh())
        if kind == "attention":
            self.attention = nn.MultiheadAttention(last, self.HEADS, batch_first=True)
        self.net = mlp(2 * last, [last], outputs, gain)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return (..., N, outputs)."""
        if self.kind == "local":
            return self.net(rows)
        held = self.embed(rows)
        if self.kind == "set":
            # Over all, the own row among them: it is the same for each.
            others = held.mean(-2, keepdim=True).expand_as(held)
        else:
            teams = held.reshape(-1, *held.shape[-2:])
            others = self.attention(teams, teams, teams, need_weights=False)[0].reshape(held.shape)
        return self.net(torch.cat([held, others], -1))


class Memory(nn.GRUCell):
    """What each drone remembers of its earlier observations: a gated recurrent unit (Cho et al. 2014)."""

    def remember(self, rows: torch.Tensor, memory: torch.Tensor) -> torch.Tensor:
        """Return the memory (..., N, H) after the rows (..., N, D) of one step, given that before it."""
        return self(rows.flatten(0, -2), memory.flatten(0, -2)).reshape(memory.shape)

    def unroll(self, rows: torch.Tensor, memory: torch.Tensor, started: torch.Tensor) -> torch.Tensor:
        """Return the memories (B, L, N, H) after each step of sequences.

        Args:
            rows: (B, L, N, D).
            memory: (B, N, H) before the first step.
            started: (B, L), steps that are the first of an episode; the first step's memory stands as given.
        """
        # Input gates of all steps at once; only the recurrent ones have to wait for each other.
        reset_in, update_in, new_in = nn.functional.linear(rows, self.weight_ih, self.bias_ih).chunk(3, -1)
        goes_on = (~started).to(rows.dtype)[..., None, None]
        memories = []
        for t in range(rows.shape[1]):
            if t > 0:
                memory = memory * goes_on[:, t]
            reset, update, new = nn.functional.linear(memory, self.weight_hh, self.bias_hh).chunk(3, -1)
            new = torch.tanh(new_in[:, t] + torch.sigmoid(reset_in[:, t] + reset) * new)
            # h' = (1 - z) n + z h, as torch's own cell.
            memory = torch.lerp(new, memory, torch.sigmoid(update_in[:, t] + update))
            memories.append(memory)
        return torch.stack(memories, 1)


class Actor(nn.Module):
    """Gaussian policy of a drone, the same for all: observations (..., N, D) to mean and deviation (..., N, A).

    Its mean is that of a linear base policy, `base` (A, D), plus a network whose last layer starts at zero, so that an
    untrained team acts as the base policy. With a GRU the network takes the drone's memory beside the observation.

    Args:
        kind: what drones know of each other; see `TeamNet`. With "local" each acts on its own observation alone.
        observation_size, action_size: D, A.
        hidden: widths of the hidden layers.
        initial_std: deviation at the start.
        base: matrix of the base policy (A, D).
        gru: H, size of the memory; 0 for a policy without.
        asinh, steps: see `Normalizer`.
        used: bool (D,), which numbers of an observation the network takes; the base policy takes all. None: all.
    """

    base: torch.Tensor
    used: torch.Tensor | None

    def __init__(
        self, kind: str, observation_size: int, action_size: int, hidden: Sequence[int], initial_std: float,
        base: torch.Tensor, gru: int = 0, asinh: float = 0.0, used: torch.Tensor | None = None, steps: int = 1,
    ):  # fmt: skip
        super().__init__()
        self.normalizer = Normalizer(observation_size, asinh, steps=steps)
        factors = None if used is None else used.float().repeat_interleave(self.normalizer.copies)
        self.register_buffer("used", factors, persistent=False)
        inputs = self.normalizer.outputs
        # gain=0: the last layer starts at zero, and with it the network's part of the action.
        self.team = TeamNet(kind, inputs + gru, hidden, action_size, gain=0.0)
        self.memory = Memory(inputs, gru) if gru else None
        self.register_buffer("base", base)
        self.log_std = nn.Parameter(torch.full((action_size,), math.log(initial_std)))

    def forward(
        self, observation: torch.Tensor, memory: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and standard deviation of the action.

        Args:
            observation: (..., N, D).
            memory: (..., N, H) that has taken in this observation, of a policy with a GRU.
        """
        rows = self._take(observation)
        inputs = rows if memory is None else torch.cat([rows, memory], -1)
        # The script reads the raw observation: its gains are in units, not in standard deviations.
        mean = self.team(inputs) + observation @ self.base.T
        return mean, self.log_std.exp().expand_as(mean)

    def remember(self, observation: torch.Tensor, memory: torch.Tensor) -> torch.Tensor:
        """Return the memory (..., N, H) that has taken in one more observation (..., N, D)."""
        assert self.memory is not None
        return self.memory.remember(self._take(observation), memory)

    def unroll(self, observation: torch.Tensor, memory: torch.Tensor, started: torch.Tensor) -> torch.Tensor:
        """Return the memories (B, L, N, H) of sequences of observations (B, L, N, D); see `Memory.unroll`."""
        assert self.memory is not None
        return self.memory.unroll(self._take(observation), memory, started)

    def _take(self, observation: torch.Tensor) -> torch.Tensor:
        """Return what the network takes of observations (..., N, D)."""
        rows: torch.Tensor = self.normalizer(observation)
        return rows if self.used is None else rows * self.used


def build_actor(train: TrainConfig, base: torch.Tensor, names: Sequence[str]) -> Actor:
    """Return an untrained policy.

    Args:
        train: its network.
        base: matrix of the base policy (A, D).
        names: of the numbers of an observation (D,).

    Raises:
        ConfigError: `train.observe` names a component that there is not, or `train.changes` without earlier steps.
    """
    used = None
    if train.observe is not None:
        parts = [name.partition("@")[0].rpartition("_")[0] for name in names]
        for name in train.observe:
            if name not in parts:
                raise ConfigError(f"train.observe names no component '{name}'{nearest(name, dict.fromkeys(parts))}")
        used = torch.tensor([part in train.observe for part in parts])
    action_size, size = base.shape
    steps = len(names) // sum("@" not in name for name in names) if train.changes else 1
    if train.changes and steps == 1:
        raise ConfigError(
            "train.changes=true is about the earlier steps of env.history, and there are none; set env.history=4, or "
            "leave it out"
        )
    return Actor(
        train.actor, size, action_size, train.hidden, train.initial_std, base, train.gru, train.asinh, used, steps
    )  # fmt: skip


@torch.no_grad()
def draw_action(mean: torch.Tensor, deviation: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return actions drawn from a Gaussian and their log-probabilities (..., N).

    Args:
        mean: (..., N, A).
        deviation: (A,), the same for all.
        noise: (..., N, A), standard normal.
    """
    # log N(a; μ, σ) = -½ |noise|² - Σ log σ - ½ A log 2π, as a = μ + σ · noise: no need to look at a again.
    constant = deviation.log().sum() + 0.5 * math.log(2 * math.pi) * len(deviation)
    return torch.addcmul(mean, noise, deviation), noise.square().sum(-1).mul_(-0.5) - constant


class CentralCritic(nn.Module):
    """Value of the team from the global state: (..., S) to (..., N, 1), the same for every drone (MAPPO).

    The network's output is in units of the value normaliser, which the loss keeps up to date.

    Args:
        kind: "flat" takes the state as it is; "set" and "attention" (see `TeamNet`) give the same value in whatever
            order the drones stand in it.
        state_size: S.
        drones: where the numbers of the drones stand in the state.
        hidden: widths of the hidden layers.
        value_norm: running statistics of the returns.
        asinh: see `Normalizer`.
    """

    def __init__(
        self, kind: str, state_size: int, drones: DroneNumbers, hidden: Sequence[int], value_norm: ValueNorm,
        asinh: float = 0.0,
    ):  # fmt: skip
        super().__init__()
        self.normalizer, self.value_norm = Normalizer(state_size, asinh), value_norm
        self.kind, self.drones = kind, drones
        inputs = state_size if kind == "flat" else state_size - (drones.rows - 1) * drones.size
        inputs *= self.normalizer.copies
        self.team = TeamNet("local" if kind == "flat" else kind, inputs, hidden, 1, gain=0.1)

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Return the value for each drone."""
        count, rows = self.drones.rows, self.normalizer(state).unsqueeze(-2)
        if self.kind != "flat":
            first, size = self.normalizer.copies * self.drones.first, self.normalizer.copies * self.drones.size
            shared, own, rest = rows.split([first, count * size, rows.shape[-1] - first - count * size], -1)
            own = own.reshape(*own.shape[:-2], count, size)
            rows = torch.cat([own, torch.cat([shared, rest], -1).expand(*own.shape[:-1], -1)], -1)
        # The mean over the drones: no order of them can change it.
        value = self.value_norm.denormalize(self.team(rows).mean(-2, keepdim=True))
        return value.expand(*value.shape[:-2], count, 1)


class LocalCritic(nn.Module):
    """Value of each drone from its own observation: (..., N, D) to (..., N, 1) (IPPO)."""

    def __init__(self, observation_size: int, hidden: Sequence[int], value_norm: ValueNorm, asinh: float = 0.0):
        super().__init__()
        self.normalizer, self.value_norm = Normalizer(observation_size, asinh), value_norm
        self.net = mlp(self.normalizer.outputs, hidden, 1, gain=0.1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the value for each drone."""
        return self.value_norm.denormalize(self.net(self.normalizer(observation)))


class NoCritic(nn.Module):
    """What learns without values has in their place."""
