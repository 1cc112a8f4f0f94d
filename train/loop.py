"""The training loop (Sec. 3.1): one step of the critic, one of the sampler, and nothing hidden between them."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from solidgrain.runtime.errors import TrainingError
from solidgrain.train.critic import Critic
from solidgrain.train.exemplar import draw_patches
from solidgrain.train.losses import gradient_penalty, make_judge, style_loss
from solidgrain.train.noise import draw_tables
from solidgrain.train.preview import write_preview
from solidgrain.train.run import CHECKPOINT, PARTS, Run
from solidgrain.train.sampler import make_sampler
from solidgrain.train.settings import Budget, Settings, rate
from solidgrain.train.slices import draw_slices
from solidgrain.train.watch import Watch, flaw

MOST_SETBACKS = 2  # times that a diverged run goes back to its last checkpoint, before it gives up


@dataclass(frozen=True)
class Report:
    """One line of `stats.jsonl`."""

    iteration: int
    seconds: float  # of training so far, earlier sittings included
    critic_loss: float  # L_D
    penalty: float | None  # where this iteration had one
    style: float  # L_style
    adversarial: float  # E[D(f)]


class Trainer:
    """The state of a training: networks, optimisers, random streams. `train` drives it."""

    def __init__(self, run: Run, device: torch.device) -> None:
        self.run, self.settings, self.device = run, run.settings, device
        self.generator = torch.Generator(device).manual_seed(self.settings.seed)
        self.exemplar = torch.from_numpy(run.exemplar).permute(2, 0, 1).to(device)  # (3, H, W)
        self.critic = Critic(self.generator).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.judge = make_judge(self.settings, self.critic, device)
        self.sampler = make_sampler(self.settings, self.generator)
        self.average = copy.deepcopy(self.sampler).requires_grad_(False)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), betas=(0.5, 0.999))
        self.sampler_optimiser = torch.optim.Adam(self.sampler.parameters(), betas=(0.5, 0.999))
        self.reduced_precision = use_bfloat16(self.settings, device)
        self.iteration, self.seconds = 0, 0.0
        self.watch, self.setbacks = Watch(), 0

    def step(self) -> Report:
        """One iteration: synthesise slices, improve the critic on them, then the sampler against it."""
        settings, started = self.settings, time.monotonic()
        self._set_rates()
        fake = self.synthesise()  # (B, 3, patch, patch)
        real = draw_patches(self.exemplar, settings, self.generator)

        critic_loss, penalty = torch.zeros(()), None
        if settings.trains_critic:
            critic_loss, penalty = self._critic_loss(real, fake.detach())
            self.critic_optimiser.zero_grad()
            torch.autograd.backward(critic_loss)
            self.critic_optimiser.step()

        self.critic.requires_grad_(False)  # the sampler's step needs its activations, not its gradients
        style, adversarial = self._sampler_losses(real, fake)
        self.sampler_optimiser.zero_grad()
        torch.autograd.backward(settings.beta * style - settings.alpha * adversarial)
        self.sampler_optimiser.step()
        self.critic.requires_grad_(True)

        self._update_average()
        self.iteration += 1
        self.seconds += time.monotonic() - started
        return Report(
            iteration=self.iteration,
            seconds=self.seconds,
            critic_loss=critic_loss.item(),
            penalty=None if penalty is None else penalty.item(),
            style=style.item(),
            adversarial=adversarial.item(),
        )

    def synthesise(self) -> Tensor:
        """A batch of random slices of one fresh noise instance, as images."""
        settings = self.settings
        tables = draw_tables(settings.octaves, settings.resolution, self.generator)
        # Outside autocast: coordinates in bfloat16 are off by a tenth of a pixel.
        points = draw_slices(settings, self.generator)
        with self._autocast():
            rgb: Tensor = self.sampler(tables, points)
        return rgb.float().reshape(-1, settings.patch, settings.patch, 3).permute(0, 3, 1, 2)

    def _critic_loss(self, real: Tensor, fake: Tensor) -> tuple[Tensor, Tensor | None]:
        """L_D of Eq. 3 with the authors' drift term, and its gradient penalty alone when this iteration has one."""
        settings = self.settings
        with self._autocast():
            logits, _ = self.critic(torch.cat([fake, real]))
        on_fake, on_real = logits.float().chunk(2)
        loss = on_fake.mean() - on_real.mean() + settings.drift * (on_real**2).mean()
        if (self.iteration + 1) % settings.penalty_every:
            return loss, None
        penalty = gradient_penalty(self.critic, real, fake, self.generator)
        return loss + settings.penalty * settings.penalty_every * penalty, penalty

    def _sampler_losses(self, real: Tensor, fake: Tensor) -> tuple[Tensor, Tensor]:
        """L_style and E[D(f)] of Eq. 4."""
        with self._autocast():
            on_fake, of_fake = self.judge(fake)
            with torch.no_grad():
                _, of_real = self.judge(real)
        relative = self.settings.style_features == "vgg"
        return style_loss(of_real, of_fake, self.settings.pooled_gram, relative), on_fake.float().mean()

    def _set_rates(self) -> None:
        s, lowered = self.settings, 0.5**self.setbacks
        for group in self.critic_optimiser.param_groups:
            group["lr"] = lowered * rate(s.critic_rate, s.critic_rate_floor, s.critic_half_life, self.iteration)
        for group in self.sampler_optimiser.param_groups:
            group["lr"] = lowered * rate(s.sampler_rate, s.sampler_rate_floor, s.sampler_half_life, self.iteration)

    @torch.no_grad()
    def _update_average(self) -> None:
        """Exponential moving average of the weights; its memory grows to a ninth of the training so far."""
        keep = min(self.settings.average_decay, (1 + self.iteration) / (10 + self.iteration))
        for average, current in zip(self.average.parameters(), self.sampler.parameters(), strict=True):
            average.lerp_(current, 1 - keep)

    def _autocast(self) -> AbstractContextManager[None]:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.reduced_precision)

    def save(self) -> None:
        parts = {name: getattr(self, name).state_dict() for name in PARTS}
        progress = {"iteration": self.iteration, "seconds": self.seconds}
        caution = {"watch": self.watch.state(), "setbacks": self.setbacks}
        self.run.save_checkpoint(parts | progress | caution | {"generator": self.generator.get_state()})

    def load(self) -> None:
        """Take up the run's last checkpoint, if it has one."""
        state = self.run.load_checkpoint()
        if state is None:
            return
        try:
            for name in PARTS:
                getattr(self, name).load_state_dict(state[name])
            self.generator.set_state(state["generator"])
            self.watch = Watch(**state.get("watch", {}))  # runs of earlier versions have none
        except (RuntimeError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0]
            raise TrainingError(f"{self.run.folder}: the checkpoint does not fit the run or --device ({reason})") from error
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self.setbacks = state.get("setbacks", 0)

    def flaw(self) -> str:
        """What makes the weights unfit for a checkpoint, or "" (see `watch.flaw`)."""
        return flaw((self.critic, self.sampler, self.average), self.average, self.settings, self.exemplar)

    def gone_back(self, trouble: str) -> Trainer:
        """A trainer at the last checkpoint, or at the start, with half the rates and another random stream.

        What it draws depends on the settings and on where it went back to, so that a run which is killed on the way does
        the same again. Raises TrainingError once `MOST_SETBACKS` are used up.
        """
        again = Trainer(self.run, self.device)
        again.load()
        if self.setbacks == MOST_SETBACKS:
            path = self.run.folder / CHECKPOINT
            way = (
                f"{path} holds iteration {again.iteration}: export it, or" if again.iteration else "there is no checkpoint yet:"
            )
            raise TrainingError(
                f"{self.run.folder}: the training diverged at iteration {self.iteration} ({trouble}) after {MOST_SETBACKS} "
                f"fresh starts at lower rates; {way} train again with another --seed"
            )
        again.setbacks, again.seconds = self.setbacks + 1, self.seconds
        stream = np.random.SeedSequence([self.settings.seed, again.iteration, again.setbacks])
        again.generator.manual_seed(int(stream.generate_state(1, np.uint64)[0] >> 1))
        self.run.rewind_stats(again.iteration)
        return again


def train(
    run: Run,
    budget: Budget,
    device: torch.device,
    on_report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    on_warning: Callable[[str], None] = lambda line: None,
) -> Report | None:
    """Train until the budget is spent or `should_stop` says so, from the run's last checkpoint if there is one.

    Leaves a checkpoint and a sample behind in either case. A training that diverges (`watch`) goes back to its last
    checkpoint, twice at most, and `on_warning` is told; then it raises TrainingError. No checkpoint is ever replaced by a
    state that is in doubt.
    """
    trainer = Trainer(run, device)
    trainer.load()
    run.rewind_stats(trainer.iteration)
    settings, report = run.settings, None

    while not budget.done(trainer.iteration, trainer.seconds) and not should_stop():
        report = trainer.step()
        due = trainer.iteration % settings.checkpoint_every == 0
        style = report.style if settings.beta else 0.0  # where no one minimises it, it may grow as it likes
        trouble = trainer.watch.see(style, report.critic_loss) or (trainer.flaw() if due else "")
        if trouble:
            trainer = trainer.gone_back(trouble)
            on_warning(
                f"iteration {report.iteration}: the training diverged ({trouble}); "
                f"it goes on from iteration {trainer.iteration}, at half the rates"
            )
            continue
        if trainer.iteration % settings.report_every == 0:
            run.append_stats(vars(report))
            on_report(report)
        if trainer.iteration % settings.sample_every == 0:
            _write_sample(trainer)
        if due and not trainer.watch.doubt():
            trainer.save()
    if doubt := trainer.watch.doubt() or trainer.flaw():
        on_warning(f"iteration {trainer.iteration} is not saved ({doubt}); the last checkpoint stays")
    else:
        trainer.save()
    _write_sample(trainer)
    return report


def use_bfloat16(settings: Settings, device: torch.device) -> bool:
    """Whether plain forward passes run in bfloat16: only where the processor multiplies it natively, unless told so."""
    if settings.precision != "auto":
        return settings.precision == "bfloat16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported())


def _write_sample(trainer: Trainer) -> None:
    path = trainer.run.folder / "samples" / f"{trainer.iteration:06d}.png"
    write_preview(path, trainer.average, trainer.settings, trainer.run.exemplar, trainer.device)
