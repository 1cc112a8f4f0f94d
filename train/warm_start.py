"""Beginning a training with what another has learned: as many of its weights as fit, by name and shape."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from solidgrain.runtime.errors import TrainingError
from solidgrain.train.loop import Trainer
from solidgrain.train.run import RunFolder, is_space, open_run
from solidgrain.train.space_run import open_space_run


def warm_start(run: RunFolder, other: Path, device: torch.device) -> tuple[int, int]:
    """Give a new run a checkpoint at iteration 0 with the weights of another run, its critic's and its average's.

    A single exemplar's sampler fits a space's as far as shapes go: all but what depends on the number of octaves. Returns how
    many parameter tensors were taken over, and how many start afresh. Raises TrainingError if there is nothing to take.
    """
    found = (open_space_run(other) if is_space(other) else open_run(other)).load_checkpoint()
    if found is None:
        raise TrainingError(f"--warm-start {other}: no checkpoint yet; expected a run that has been trained")
    trainer = Trainer(run, device)
    taken, left = _take_over(trainer.critic, found["critic"])
    for model in (trainer.sampler, trainer.average):
        of_model = _take_over(model, found["average"])
    if taken + of_model[0] == 0:
        raise TrainingError(f"--warm-start {other}: none of its weights fits; expected a run of the same width")
    trainer.save()
    return taken + of_model[0], left + of_model[1]


def _take_over(model: nn.Module, state: dict[str, Tensor]) -> tuple[int, int]:
    """Copy what has the same name and shape. How many tensors did, and how many did not."""
    wanted = model.state_dict()
    fitting = {
        name: value for name, value in _renamed(state, wanted).items() if name in wanted and value.shape == wanted[name].shape
    }
    model.load_state_dict({**wanted, **fitting})
    return len(fitting), len(wanted) - len(fitting)


def _renamed(state: dict[str, Tensor], wanted: dict[str, Tensor]) -> dict[str, Tensor]:
    """The state under the names of a model of the other kind: a space keeps its sampler under a name of its own."""
    if "sampler.constant" in wanted and "constant" in state:
        return {f"sampler.{name}": value for name, value in state.items()}
    if "constant" in wanted and "sampler.constant" in state:
        return {name.removeprefix("sampler."): value for name, value in state.items()}
    return state
