"""Several processes that train one model: each draws its own batches, and their gradients are averaged.

Gradients are averaged here rather than by torch's DistributedDataParallel: the gradient penalty differentiates the critic
twice, outside any forward that such a wrapper would see.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

T = TypeVar("T")


@dataclass(frozen=True)
class Processes:
    """This process among those of the training. Alone, everything here does nothing."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is the one that writes files and talks."""
        return self.rank == 0

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """The mean of all processes' gradients, in place, in one exchange."""
        if self.count == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        start = 0
        for gradient in gradients:
            gradient.copy_(flat[start : start + gradient.numel()].view_as(gradient))
            start += gradient.numel()

    def mean(self, values: Tensor) -> Tensor:
        """The mean of small tensors, so that all processes decide alike."""
        if self.count > 1:
            dist.all_reduce(values)
        return values / self.count

    def any(self, mine: bool) -> bool:
        """Whether it is so for at least one process."""
        return mine if self.count == 1 else any(self.gathered(mine))

    def one_after_another(self, make: Callable[[], T]) -> T:
        """What `make` gives, called by the first process before the others."""
        made = make() if self.first else None
        self.gathered(None)
        return make() if made is None else made

    def gathered(self, value: Any) -> list[Any]:
        """The value of every process, by rank."""
        values = [value]
        if self.count > 1:
            values = [None] * self.count
            dist.all_gather_object(values, value)
        return values


def join_processes(device: torch.device) -> Processes:
    """The processes that torchrun started together with this one, or this one alone."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        return Processes()
    if not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return Processes(dist.get_rank(), count)


def local_device(device: torch.device) -> torch.device:
    """The device of this process: with torchrun, the GPU of its number on this machine."""
    number = os.environ.get("LOCAL_RANK")
    return torch.device(device.type, int(number)) if device.type == "cuda" and number else device
