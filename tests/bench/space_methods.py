"""What the table of texture spaces compares: textures of one photograph, made in each of the ways that the paper compares."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from solidgrain.runtime import SolidgrainError, Space, UsageError, load_space, load_texture
from solidgrain.runtime.bundle import MANIFEST
from solidgrain.runtime.texture_file import read_texture, write_texture
from solidgrain.train.cuts import Sample, as_image
from solidgrain.train.exemplar import FloatArray
from solidgrain.train.run import OPTIONS
from solidgrain.train.space_run import open_space_run
from tests.bench import cells

TITLES = {
    "truth": "ground truth",
    "henzler": "Henzler et al.",
    "unadapted": "ours",
    "critic": "ours, adapted (D)",
    "vgg": "ours, adapted (VGG)",
}
ADAPTED = ("critic", "vgg")  # by the features of L_style
SamplesOf = Callable[[FloatArray], Sample]  # the patch that is encoded -> its texture


@dataclass(frozen=True)
class Other:
    """The space of another method."""

    samples_of: SamplesOf
    held_out: frozenset[str]  # file names of photographs that it was never trained on
    iterations: int


@dataclass(frozen=True)
class Methods:
    """Every way to make a texture of a patch."""

    space: Space
    threads: int
    budget: tuple[str, str] | None  # of adapting, as its command takes it; None if there is none
    critic: Path | None  # of adapting, where the bundle does not hold it
    henzler: Other | None
    features: Sequence[str] = ADAPTED  # of L_style, of the columns that are adapted

    @property
    def passes(self) -> list[list[str]]:
        """The columns, those first that take the least time."""
        first = ["truth", "unadapted"] if self.henzler is None else ["truth", "unadapted", "henzler"]
        return [first] if self.budget is None else [first, *([column] for column in self.features)]

    def sample(self, column: str, patch: FloatArray, folder: Path) -> Sample:
        """A column's texture of the patch that lies in the folder as `exemplar.png`, adapted unless it was before."""
        if column == "henzler":
            assert self.henzler is not None
            return self.henzler.samples_of(patch)
        if column == "unadapted":
            texture = self.space.encode(patch, folder.name)
            texture.save(folder / "unadapted.sgt.npz")
            return texture.sample
        file = folder / f"{column}.sgt.npz"
        if not file.exists():
            self.adapt(folder / "exemplar.png", file, column)
        return load_texture(file, bundle=self.space.bundle.folder, threads=self.threads).sample

    def adapt(self, photograph: Path, out: Path, features: str) -> None:
        """`solidgrain adapt` in a process of its own; what it says of itself goes into a JSON file beside the texture.

        Raises SolidgrainError with its last line if it fails. One that was cut short leaves no texture behind.
        """
        part = out.with_name(f"{features}.part.sgt.npz")
        words = ["adapt", photograph, "--bundle", self.space.bundle.folder, "--out", part, "--overwrite", "--json", "--quiet"]
        words += [*(self.budget or ()), "--features", features, "--threads", self.threads]
        words += ["--critic", self.critic] if self.critic and features == "critic" else []
        command = [sys.executable, "-m", "solidgrain.bake.cli", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise SolidgrainError(f"{photograph}: adapting with {features} failed: {said}")
        cells.keep(out.with_name(f"{features}-adapted.json"), {**json.loads(done.stdout), "texture": out.name})
        write_texture(out, replace(read_texture(part), name=out.parent.name))
        part.unlink()


def open_henzler(source: Path, threads: int) -> Other:
    """The space of another method: a bundle, or a run directory, in torch, for what bundles cannot hold.

    Raises UsageError if it is neither, TrainingError for a run without a checkpoint.
    """
    if (source / MANIFEST).is_file():
        space = load_space(source, threads=threads)
        training = space.bundle.manifest["training"]
        names = frozenset(training.get("held_out") or ())
        return Other(lambda patch: space.encode(patch).sample, names, training.get("iterations", 0))
    if not (source / OPTIONS).is_file():
        raise UsageError(f"--henzler {os.fspath(source)}: neither a bundle nor a run directory; give that of a texture space")
    run = open_space_run(source)
    trained = cells.opened(run, torch.device("cpu"))
    return Other(lambda patch: trained.sampling(as_image(patch)), run.held_out, trained.iteration)
