"""Beginning a training with what another has learned: as many of its weights as fit, by name and shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from solidgrain.runtime.errors import TrainingError
from solidgrain.train.loop import Trainer
from solidgrain.train.run import CHECKPOINT, RunFolder, read_checkpoint
from solidgrain.train.sampler import COLORS
from solidgrain.train.space_run import open_any


def learned(other: Path) -> dict[str, Any]:
    """The checkpoint of another run, of either kind, or a file that is one. Raises TrainingError if there is none."""
    if other.is_file():
        try:
            return read_checkpoint(other, ("critic", "average"))
        except TrainingError as error:
            raise TrainingError(
                f"--warm-start {other}: no checkpoint, or a damaged one; expected a run, or its {CHECKPOINT}"
            ) from error
    found = open_any(other).load_checkpoint()
    if found is None:
        raise TrainingError(f"--warm-start {other}: no checkpoint yet; expected a run that has been trained")
    return found


def warm_start(run: RunFolder, found: dict[str, Any], device: torch.device) -> tuple[int, int]:
    """Give a new run a checkpoint at iteration 0 with the weights of another one: its critic's and its average's.

    A single exemplar's sampler fits a space's as far as shapes go: all but what depends on the number of octaves. The axes
    of the colours come along from space to space only; else they are those of the new run's exemplars. Returns how many
    parameter tensors were taken over, and how many start afresh. Raises TrainingError if no layer of the sampler fits.
    """
    trainer = Trainer(run, device)
    taken = [
        _take_over(trainer.critic, found["critic"]),
        _take_over(trainer.sampler, found["average"]),
    ]
    trainer.average.load_state_dict(trainer.sampler.state_dict())
    if not any("hidden." in name for name in taken[1]):
        raise TrainingError("--warm-start: no layer of its sampler fits; expected a run of the same width")
    trainer.save()
    wanted = len(trainer.critic.state_dict()) + len(trainer.sampler.state_dict())
    return sum(map(len, taken)), wanted - sum(map(len, taken))


def _take_over(model: nn.Module, state: dict[str, Tensor]) -> set[str]:
    """Copy what has the same name and shape. The names."""
    wanted = model.state_dict()
    to_space, from_space = ("sampler.directions" in names for names in (wanted, state))
    if not (to_space and from_space):  # the axes of the colours are those of the new exemplars
        state = {name: value for name, value in state.items() if not name.endswith(COLORS)}
    if from_space and not to_space:  # a space keeps its sampler under a name of its own
        state = {name.removeprefix("sampler."): value for name, value in state.items()}
    elif to_space and not from_space and "directions" in state:
        state = {f"sampler.{name}": value for name, value in state.items()}
    fitting = {name: value for name, value in state.items() if name in wanted and value.shape == wanted[name].shape}
    model.load_state_dict({**wanted, **fitting})
    return set(fitting)
