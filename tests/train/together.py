"""What two processes do for test_processes.py, under torchrun: `python -m torch.distributed.run ... together.py FOLDER`.

Each writes what it found to FOLDER/found.RANK.pt.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import torch

from solidgrain.bake import cli
from solidgrain.runtime import SolidgrainError
from solidgrain.train import critic, loop, run, settings, space_run
from solidgrain.train.critic import Critic
from solidgrain.train.loop import Trainer, train
from solidgrain.train.processes import Processes, joined
from solidgrain.train.settings import Budget, preset
from solidgrain.train.space_run import open_space_run
from tests.train.spaces import TINY_SPACE

CPU = torch.device("cpu")


def small() -> None:
    """No pictures, a critic of three layers, the presets of a toy: what is tested here does not depend on them."""
    loop._write_sample = lambda trainer: None
    critic.CONVOLUTIONS = ((3, 16, 3, True), (16, 32, 3, True), (32, 256, 3, True))
    settings.PRESETS = {"fast space": preset("fast space", **TINY_SPACE)}


def forbid_writing() -> None:
    """What the first process alone may do."""

    def refuse(*arguments):
        raise AssertionError("only the first process writes")

    run.replacing = space_run.replacing = loop._write_sample = refuse
    run.RunFolder.append_stats = run.RunFolder.rewind_stats = refuse


def images(rank):
    return torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(rank))


def gradients_of(batch, processes: Processes):
    """Of the mean verdict over a batch, averaged over the processes."""
    network = Critic(torch.Generator().manual_seed(0))
    network(batch)[0].square().mean().backward()
    processes.average_gradients(network.parameters())
    return [parameter.grad for parameter in network.parameters()]


def weights(trainer):
    return {name: getattr(trainer, name).state_dict() for name in ("critic", "sampler", "average")}


def trained(folder: Path, processes: Processes, *sittings: int):
    for until in sittings:
        train(open_space_run(folder), Budget(iterations=until), CPU, processes=processes)
    trainer = Trainer(open_space_run(folder), CPU, processes)
    trainer.load()
    return {"weights": weights(trainer), "stream": trainer.generator.get_state(), "seconds": trainer.seconds}


def interrupt_itself(after: int) -> None:
    """Ctrl-C reaches this process alone, once a trainer has come to that iteration."""
    step = Trainer.step

    def interrupted(trainer):
        report = step(trainer)
        if trainer.iteration == after:
            os.kill(os.getpid(), signal.SIGINT)
        return report

    Trainer.step = interrupted


def shared(processes):
    """What the first process has, given to all."""
    mine = [torch.full((2, 3), float(processes.rank)), torch.full((1, 4, 2, 2), float(processes.rank))]
    mine[1] = mine[1].contiguous(memory_format=torch.channels_last)
    processes.share(mine)
    return mine


def failing_in(rank, processes):
    """What comes of a beginning that fails in one process."""

    def make():
        if processes.rank == rank:
            raise SolidgrainError(f"process {rank} fails")
        return "made"

    try:
        return processes.one_after_another(make)
    except SolidgrainError as error:
        return f"{type(error).__name__}: {error}"


def main() -> None:
    torch.set_num_threads(1)
    small()
    folder = Path(sys.argv[1])
    with joined(CPU) as processes:
        if not processes.first:
            forbid_writing()
        found = {
            "alone": gradients_of(torch.cat([images(0), images(1)]), Processes()),
            "together": gradients_of(images(processes.rank), processes),
            "shared": shared(processes),
            "fails in 0": failing_in(0, processes),
            "fails in 1": failing_in(1, processes),
            "fails nowhere": failing_in(None, processes),
            "any": [processes.any(False), processes.any(processes.rank == 1)],
            "whole": trained(folder / "whole", processes, 4),
            "parts": trained(folder / "parts", processes, 2, 4),
        }
        flags = ["--space", folder / "stones", "--out", folder / "run", "--warm-start", folder / "whole", "--hold-out", 1]
        found["exit code"] = cli.main(["train", *map(str, flags), "--iterations", "2", "--threads", "1", "--quiet"])
        if not processes.first:
            interrupt_itself(after=3)
        found["interrupted"] = cli.main(["train", "--resume", str(folder / "run"), "--iterations", "1000", "--quiet"])
        torch.save(found, folder / f"found.{processes.rank}.pt")


if __name__ == "__main__":
    main()
