"""What the long comparisons share: trainings that may be cut short at any moment, and results that are kept as they come.

OUT/plan.json is what was asked for. A finished cell is a JSON file that appears whole or not at all; an unfinished one is a run
directory that goes on where its last sitting ended. Starting again with --resume therefore loses `SITTING` minutes at most.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from torch import Tensor

from solidgrain.bake.arguments import parse_count, parse_minutes, parse_positive
from solidgrain.runtime.errors import SolidgrainError, TrainingError, UsageError
from solidgrain.runtime.files import replacing
from solidgrain.runtime.workers import usable_threads
from solidgrain.train.colors import settle_mean
from solidgrain.train.cuts import Sample
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.inception import Inception
from solidgrain.train.loop import train
from solidgrain.train.noise import Noise, runtime_noise
from solidgrain.train.run import Run, RunFolder, Source, create_run, open_run
from solidgrain.train.settings import Budget, Settings, from_json
from solidgrain.train.slices import UNIT, flat_slice
from solidgrain.train.task import make_task
from solidgrain.train.vgg import find_weights

EXEMPLARS = Path(__file__).resolve().parents[3] / "shared" / "data" / "exemplars"  # photographs do not come with the project
SITTING = 5.0  # minutes of training between checkpoints
CHUNK = 1 << 16  # points at a time
PLAN = "plan.json"


def arguments_of(what: str, out: Path, slices: int) -> argparse.ArgumentParser:
    """The flags of every comparison, but for how long it trains."""
    parser = argparse.ArgumentParser(description=what)
    parser.add_argument(
        "--slices", type=parse_positive, default=slices, metavar="N", help=f"to measure of each kind ({slices})"
    )
    parser.add_argument("--threads", type=parse_count, default=0, metavar="T", help="0: every processor (0)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to train and sample (cpu)")
    parser.add_argument(
        "--inception", type=Path, metavar="FILE", help="InceptionV3 weights (pt_inception-*.pth): SIFID as well"
    )
    parser.add_argument("--out", type=Path, default=out, metavar="FOLDER", help=f"results and runs ({out})")
    parser.add_argument("--resume", action="store_true", help="keep what FOLDER holds of the same comparison and go on")
    return parser


def add_budget(parser: argparse.ArgumentParser) -> None:
    """How long to train each cell."""
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--minutes", type=parse_minutes, metavar="M", help="of training for each cell")
    budget.add_argument("--iterations", type=parse_positive, metavar="N", help="of training for each cell")


def prepare(arguments: argparse.Namespace, **asked: Any) -> tuple[torch.device, Inception | None]:
    """Check all that can be checked before hours of training, and write or compare the plan."""
    find_weights()
    inception = Inception(arguments.inception) if arguments.inception else None
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: torch sees no CUDA device; use --device cpu")
    torch.set_num_threads(arguments.threads or usable_threads())
    plan = {name: vars(arguments)[name] for name in ("minutes", "iterations", "slices", "device") if name in arguments} | asked
    plan["sifid"] = inception is not None
    settle(arguments.out, plan, arguments.resume)
    return torch.device(arguments.device), inception


def settle(out: Path, plan: dict[str, Any], resume: bool) -> None:
    """Write the plan of a new comparison, or compare it with that of the one that goes on."""
    found = kept(out / PLAN)
    if found is not None and not resume:
        raise UsageError(f"--out {out}: holds results already; go on with --resume, or choose another folder")
    if found is not None and found != plan:
        other = sorted(name for name in {*plan, *found} if plan.get(name) != found.get(name))
        raise UsageError(f"--resume {out}: was started with other {', '.join(other)}; choose another --out")
    keep(out / PLAN, plan)


def kept(path: Path) -> dict[str, Any] | None:
    """A finished result, None if there is none."""
    if not path.exists():
        return None
    result: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return result


def keep(path: Path, result: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(json.dumps(result, indent=2, ensure_ascii=False).encode() + b"\n")


@dataclass(frozen=True)
class Trained:
    """A run that has spent its budget, or that diverged before."""

    run: Run
    iterations: int
    minutes: float
    diverged: str  # why it stopped early, or ""

    @property
    def facts(self) -> dict[str, Any]:
        return {"iterations": self.iterations, "minutes": round(self.minutes, 2), "diverged": self.diverged}


def finish(
    result: Path,
    folder: Path,
    settings: Settings,
    exemplar: FloatArray,
    budget: Budget,
    device: torch.device,
    facts: Mapping[str, Any],
    measured: Callable[[Sample], Mapping[str, Any]],
) -> None:
    """Train in a folder and measure what was learned, unless that was done before. `facts` stand in the result as they are.

    Raises UsageError if it was done with other settings.
    """
    if (before := kept(result)) is not None:
        if from_json(before["settings"]) != settings:
            raise UsageError(f"--resume: {result} is of other settings, those of an earlier version; choose another --out")
        return
    title = f"{folder.parent.name}, {folder.name}"
    say(f"{title}: training")
    run = trained(folder, settings, exemplar, budget, device)
    found: dict[str, Any] = {**facts, **run.facts, "settings": asdict(settings)}
    if run.iterations:
        say(f"{title}: {run.iterations} iterations; measuring")
        found |= measured(sampling(run.run, device))
    keep(result, found)


def trained(folder: Path, settings: Settings, exemplar: FloatArray, budget: Budget, device: torch.device) -> Trained:
    """Train in a folder, or go on there. A run that diverges stays at its last checkpoint, which is a result, too."""
    if (folder / "options.json").exists():
        run = open_run(folder)
        if run.settings != settings or not np.array_equal(run.exemplar, exemplar):
            raise UsageError(f"{folder}: a run with other settings or another exemplar; choose another --out")
    else:
        run = create_run(folder, settings, exemplar, Source(folder.parent.name, "", ""), budget)
    diverged = ""
    try:
        for sitting in _sittings(budget, _spent(run)[1]):
            train(run, sitting, device, on_warning=say)
    except TrainingError as error:
        if "diverged" not in str(error):
            raise
        diverged = str(error)
    return Trained(run, *_spent(run), diverged)


def _sittings(budget: Budget, minutes: float) -> list[Budget]:
    """The budget in sittings, each of which ends with a checkpoint."""
    if budget.minutes is None:
        return [budget]
    between = np.arange(minutes + SITTING, budget.minutes, SITTING)
    return [*(Budget(budget.iterations, float(until)) for until in between), budget]


def _spent(run: Run) -> tuple[int, float]:
    """Iterations and minutes of the last checkpoint."""
    state = run.load_checkpoint()
    return (0, 0.0) if state is None else (state["iteration"], state["seconds"] / 60)


@dataclass(frozen=True)
class Opened:
    """A run's averaged model, in torch, since bundles cannot hold every variant."""

    model: Any
    iteration: int
    octaves: int
    device: torch.device

    def sampling(self, *conditions: Tensor) -> Sample:
        """The model as a function of points in exemplar pixels and a seed, with the runtime's noise.

        `conditions` are what a model needs besides points and noise: for a space the patch [1, 3, 128, 128]. Points are moved
        to the origin first, where float32 coordinates are exact enough: a texture is the same everywhere.
        """
        model, device = self.model, self.device
        instance: dict[int, Noise] = {}

        @torch.no_grad()
        def sample(points: np.ndarray[Any, np.dtype[np.float64]], seed: int) -> FloatArray:
            near = torch.from_numpy((points - points.mean(0)) / UNIT).float().to(device)
            if seed not in instance:
                instance.clear()
                instance[seed] = runtime_noise(seed, self.octaves, near)
            rgb = torch.cat([model(instance[seed], chunk[None], *conditions)[0] for chunk in torch.split(near, CHUNK)])
            found: FloatArray = rgb.clamp(0, 1).cpu().numpy()
            return found

        return sample


def opened(run: RunFolder, device: torch.device) -> Opened:
    """A run as of its last checkpoint. Raises TrainingError if there is none."""
    state = run.load_checkpoint()
    if state is None:
        raise TrainingError(f"{run.folder}: no checkpoint to measure")
    model = make_task(run, device).make_model(torch.Generator(device))
    model.load_state_dict(state["average"])
    if isinstance(run, Run):
        settle_mean(model, run.exemplar)  # as an export does
    return Opened(model, state["iteration"], run.settings.octaves, device)


def sampling(run: RunFolder, device: torch.device, *conditions: Tensor) -> Sample:
    """The run's averaged model, opened for one texture."""
    return opened(run, device).sampling(*conditions)


def plane(size: int, rotation: Tensor, middle: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The points [size², 3] of a square turned about its middle, in exemplar pixels."""
    flat = flat_slice(size, torch.device("cpu")).double() * UNIT - torch.tensor([size / 2, size / 2, 0.0])
    return np.asarray((flat @ rotation.double().T).numpy() + middle)


def write_png(path: Path, image: FloatArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    oiio.ImageBuf(np.ascontiguousarray(image, np.float32)).write(os.fspath(path), oiio.UINT8)


def say(text: str) -> None:
    """Progress: to stderr, at once."""
    print(text, file=sys.stderr, flush=True)


def reported(main: Callable[[], None]) -> int:
    """Run a comparison; what a user can mend is one line, and everything finished stays finished."""
    try:
        main()
    except SolidgrainError as error:
        say(f"error: {error}")
        return 2 if isinstance(error, UsageError) else 1
    except KeyboardInterrupt:
        say("stopped; the same command with --resume goes on")
        return 130
    return 0
