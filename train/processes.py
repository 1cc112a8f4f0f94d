"""Several processes that train one model: each draws its own batches, and their gradients are averaged.

Gradients are averaged here rather than by torch's DistributedDataParallel: the gradient penalty differentiates the critic
twice, outside any forward that such a wrapper would see.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from solidgrain.runtime.errors import TrainingError

T = TypeVar("T")
PATIENCE = timedelta(hours=1)  # that a process waits for the others: the first alone reads the folder and draws the samples


class ElsewhereError(TrainingError):
    """Another process of the training has failed, and has said why."""


class LostProcessError(TrainingError):
    """Another process of the training has ended without a word."""


@dataclass(frozen=True)
class Processes:
    """This process among those of the training. Alone, everything here does nothing.

    What involves all must be called by all of them, in the same order. It raises LostProcessError if one of them is gone.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is the one that writes files and talks."""
        return self.rank == 0

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Give all processes the first one's, in place: unlike machines do not draw the same numbers, nor turn axes alike."""
        if self.count > 1:
            with self._together():
                for tensor in tensors:
                    dist.broadcast(tensor, 0)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """The mean of all processes' gradients, in place, in one exchange."""
        if self.count == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = self.mean(torch.cat([gradient.flatten() for gradient in gradients]))
        averages = torch.split(flat, [gradient.numel() for gradient in gradients])
        for gradient, average in zip(gradients, averages, strict=True):
            gradient.copy_(average.view_as(gradient))

    def mean(self, values: Tensor) -> Tensor:
        """The mean of a tensor over all processes, the same bits in each of them, so that all decide alike."""
        if self.count == 1:
            return values
        with self._together():
            dist.all_reduce(values)
        return values / self.count

    def any(self, mine: bool) -> bool:
        """Whether it is so for at least one process."""
        return any(self.gathered(mine))

    def gathered(self, value: Any) -> list[Any]:
        """The value of every process, by rank."""
        values = [value]
        if self.count > 1:
            values = [None] * self.count
            with self._together():
                dist.all_gather_object(values, value)
        return values

    def one_after_another(self, make: Callable[[], T]) -> T:
        """What `make` gives, called by the first process before the others.

        Where it fails, all of them end here: those in which it does with its error, the others with `ElsewhereError`.
        """
        made: list[T] = []
        failure: Exception | None = None
        for my_turn in (self.first, not self.first):
            if my_turn:
                try:
                    made.append(make())
                except Exception as error:
                    failure = error
            if self.any(failure is not None):
                raise failure or ElsewhereError("another process of this training has failed")
        return made[0]

    @contextmanager
    def errors_once(self) -> Iterator[None]:
        """Of an error that all processes run into alike, the first keeps the message, the others raise `ElsewhereError`."""
        try:
            yield
        except LostProcessError:
            raise
        except TrainingError as error:
            if self.first:
                raise
            raise ElsewhereError("the first process has failed likewise") from error

    @contextmanager
    def _together(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            reason = f"another one has ended or does not answer ({_first_sentence(error)}); go on with --resume once all can"
            raise LostProcessError(f"process {self.rank} of {self.count}: {reason}") from error


@contextmanager
def joined(device: torch.device) -> Iterator[Processes]:
    """The processes that torchrun started together with this one, or this one alone; those that have met, if they have.

    Raises TrainingError if they do not find each other.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes()
        return
    if dist.is_initialized():
        yield Processes(dist.get_rank(), count)
        return
    try:
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        reason = f"WORLD_SIZE is {count}, but the processes do not meet ({_first_sentence(error)}); start them with torchrun"
        raise TrainingError(reason) from error
    try:
        yield Processes(dist.get_rank(), count)
    finally:
        dist.destroy_process_group()


def processes_here() -> int:
    """How many of them share this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def local_device(device: torch.device) -> torch.device:
    """The device of this process: with torchrun, the GPU of its number on this machine.

    Raises TrainingError if that has fewer.
    """
    if device.type != "cuda" or not (rank := os.environ.get("LOCAL_RANK")):
        return device
    number = int(rank)
    if number >= (gpus := torch.cuda.device_count()):
        raise TrainingError(
            f"process {number} of this machine has no GPU: torch sees {gpus}; start as many, or add --device cpu"
        )
    return torch.device(device.type, number)


def _first_sentence(error: Exception) -> str:
    """What torch says, without its advice."""
    return str(error).strip().split("\n")[0].split(". ")[0] or type(error).__name__
