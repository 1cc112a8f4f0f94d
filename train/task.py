"""What a training is about: the model, what a batch is drawn from, and what its progress is judged by.

The loop is the same for a single exemplar (Sec. 3.1) and for a texture space (Sec. 3.2); this is where they differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from solidgrain.runtime.errors import TrainingError
from solidgrain.train import collection, exemplar
from solidgrain.train.collection import Member
from solidgrain.train.contrast import Stretch, stretch_to, together, unstretched
from solidgrain.train.first_sampler import begin_as
from solidgrain.train.noise import Noise, draw_noise
from solidgrain.train.plateau import Onlooker
from solidgrain.train.run import Run, RunFolder
from solidgrain.train.sampler import Sampler, make_sampler
from solidgrain.train.settings import Settings
from solidgrain.train.slices import draw_slices, scatter
from solidgrain.train.space import Space
from solidgrain.train.space_run import SpaceRun
from solidgrain.train.streams import TABLES, stream

PLACES = 4096  # at which an average is looked at
COLOR_PLACES = 1024  # places whose colours are compared: costlier than in a slice, for no two share a texel
SHOWN = 4  # exemplars of a space in a sample, half of them held out

Inputs = tuple[Noise, *tuple[Tensor, ...]]  # of a model: noise, points [B, P, 3], and for a space the patches that E sees


class Colors(NamedTuple):
    """Colours from all over the solid, and from all over its exemplar."""

    inputs: Inputs
    wanted: Tensor  # [P, 3]


class Batch(NamedTuple):
    """Slices for the model to make, P = patch², and what they are compared with."""

    inputs: Inputs
    real: Tensor  # [B, 3, patch, patch]
    stretch: Stretch  # what D sees of either
    colors: Colors | None = None  # where L_color compares them


class Probe(NamedTuple):
    """A fixed question to a model, and the exemplars [3, H, W] whose colours its answers [K, P, 3] should have."""

    inputs: Inputs
    exemplars: Sequence[Tensor]


class Task(Protocol):
    def make_model(self, generator: torch.Generator) -> nn.Module: ...

    def begin(self, model: nn.Module) -> None:
        """What is to be done to a new model before it is trained."""

    def draw(self, iteration: int, generator: torch.Generator) -> Batch: ...

    def probe(self) -> Probe: ...

    def onlooker(self) -> Onlooker:
        """Who tells when it gets no better. Raises TrainingError if nobody can."""

    def shown(self) -> Sequence[tuple[Tensor, tuple[Tensor, ...]]]:
        """What a sample shows: exemplars [3, H, W], with what the model needs besides noise and points for each."""


def make_task(run: RunFolder, device: torch.device) -> Task:
    if isinstance(run, SpaceRun):
        return TextureSpace(run, device)
    assert isinstance(run, Run)
    return SingleExemplar(run, device)


class Instances:
    """Where a batch's noise comes from; its slices share an instance."""

    def __init__(self, settings: Settings, device: torch.device) -> None:
        self.settings = settings
        self.shared = self._fresh(stream(device, settings.seed, TABLES)) if settings.shared_noise else None

    def draw(self, generator: torch.Generator) -> Noise:
        return self._fresh(generator) if self.shared is None else self.shared.moved(generator)

    def _fresh(self, generator: torch.Generator) -> Noise:
        return draw_noise(self.settings.octaves, self.settings.resolution, generator)


class SingleExemplar:
    """Sec. 3.1."""

    def __init__(self, run: Run, device: torch.device) -> None:
        self.run, self.settings, self.device = run, run.settings, device
        self.exemplar = torch.from_numpy(run.exemplar).permute(2, 0, 1).to(device)  # (3, H, W)
        self.stretch = stretch_to(run.settings.critic_contrast, run.exemplar, device)
        self.instances = Instances(run.settings, device)

    def make_model(self, generator: torch.Generator) -> nn.Module:
        sampler = make_sampler(self.settings, generator)
        if self.settings.principal_colors:  # not only in `begin`: checkpoints of earlier versions do not hold these axes
            pixels = self.exemplar.flatten(1).double()
            sampler.take_colors(pixels.mean(1), torch.cov(pixels))
        return sampler

    def begin(self, model: nn.Module) -> None:
        if self.settings.sampler_start:
            assert isinstance(model, Sampler)
            begin_as(model, self.settings.sampler_start, self.run.exemplar)

    def draw(self, iteration: int, generator: torch.Generator) -> Batch:
        settings = self.run.settings_at(iteration)
        noise, points = self.instances.draw(generator), draw_slices(settings, generator)
        real = exemplar.draw_patches(self.exemplar, settings, generator)
        colors = self._draw_colors(noise, generator) if settings.color_weight else None
        return Batch((noise, points), real, self.stretch, colors)

    def _draw_colors(self, noise: Noise, generator: torch.Generator) -> Colors:
        """At scattered places, for those of a few slices depend on each other."""
        pixels = self.exemplar.flatten(1).T
        chosen = torch.randint(len(pixels), (COLOR_PLACES,), generator=generator, device=self.device)
        return Colors((noise, scatter(1, COLOR_PLACES, generator)), pixels[chosen])

    def probe(self) -> Probe:
        return Probe(_probe_inputs(self.settings, 1, self.device), [self.exemplar])

    def onlooker(self) -> Onlooker:
        return Onlooker(self.settings, self.run.exemplar, self.device)

    def shown(self) -> Sequence[tuple[Tensor, tuple[Tensor, ...]]]:
        return [(self.exemplar, ())]


class TextureSpace:
    """Sec. 3.2: a batch is a few exemplars, E sees one patch of each, and D sees other patches of the same."""

    def __init__(self, run: SpaceRun, device: torch.device) -> None:
        self.settings, self.device, self.run = run.settings, device, run
        self.members = run.trained_on
        contrast = run.settings.critic_contrast  # without one, no photograph is read for it: collections may be large
        self.stretches = [
            stretch_to(contrast, one.exemplar, device) if contrast else unstretched(device) for one in self.members
        ]
        self.instances = Instances(run.settings, device)

    def make_model(self, generator: torch.Generator) -> nn.Module:
        return Space(self.settings, generator)

    def begin(self, model: nn.Module) -> None:
        """Give it the axes that all colours have in common; mean and contrast are each texture's own."""
        if self.settings.principal_colors:
            assert isinstance(model, Space)
            mean = torch.zeros(3, device=self.device)
            model.sampler.take_colors(mean, collection.mean_covariance(self.members).to(self.device))

    def draw(self, iteration: int, generator: torch.Generator) -> Batch:
        settings, device = self.settings, self.device
        noise, points = self.instances.draw(generator), draw_slices(settings, generator)
        order = torch.randperm(len(self.members), generator=generator, device=device).tolist()
        places = [order[k % len(order)] for k in range(settings.batch)]
        chosen = [self.members[place] for place in places]
        seen = [collection.draw_patches(one, settings.encoded_patch, 1, settings, generator) for one in chosen]
        real = [collection.draw_patches(one, settings.patch, 1, settings, generator) for one in chosen]
        stretch = together([self.stretches[place] for place in places])
        return Batch((noise, points, torch.cat(seen)), torch.cat(real).contiguous(memory_format=torch.channels_last), stretch)

    def probe(self) -> Probe:
        generator = torch.Generator(self.device).manual_seed(7)
        seen = [member.crop(self.settings.encoded_patch, generator) for member in self.members[:SHOWN]]
        return Probe((*_probe_inputs(self.settings, len(seen), self.device), torch.stack(seen)), seen)

    def onlooker(self) -> Onlooker:
        raise TrainingError(f"{self.run.folder}: a plateau is told of a single exemplar; give a space iterations or minutes")

    def shown(self) -> Sequence[tuple[Tensor, tuple[Tensor, ...]]]:
        generator = torch.Generator(self.device).manual_seed(7)
        unseen = _spread([member for member in self.run.members if member.name in self.run.held_out], SHOWN // 2)
        shown = [*_spread(self.members, SHOWN - len(unseen)), *unseen]
        patches = [one.crop(self.settings.encoded_patch, generator) for one in shown]
        return [(patch, (patch[None],)) for patch in patches]


def _spread(members: Sequence[Member], count: int) -> list[Member]:
    """So many of them, or all, far apart in the order of their names: neighbours often show the same material."""
    count = min(count, len(members))
    return [members[k * len(members) // count] for k in range(count)]


def _probe_inputs(settings: Settings, images: int, device: torch.device) -> tuple[Noise, Tensor]:
    """One instance at far-apart places, which are as independent as instances."""
    generator = torch.Generator(device).manual_seed(7)
    noise = draw_noise(settings.octaves, settings.resolution, generator)
    return noise, scatter(images, PLACES, generator)
