"""The training loop (Sec. 3.1, 3.2): one step of the critic, one of the sampler, and nothing hidden between them."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from solidgrain.runtime.errors import TrainingError
from solidgrain.train.average import follow
from solidgrain.train.companion import first_critic
from solidgrain.train.losses import color_loss, gradient_penalty, make_judge, style_loss
from solidgrain.train.plateau import EVERY, Onlooker, Plateau
from solidgrain.train.precision import autocast, use_bfloat16
from solidgrain.train.preview import write_preview
from solidgrain.train.processes import Processes
from solidgrain.train.run import CHECKPOINT, PARTS, RunFolder
from solidgrain.train.settings import Budget, Settings, rate
from solidgrain.train.slices import as_images
from solidgrain.train.streams import narrowed, stream
from solidgrain.train.task import Colors, Inputs, make_task
from solidgrain.train.watch import SETTLING, Watch, flaw

ALONE = Processes()
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
    color: float | None  # L_color, if the settings have it


class Ending(NamedTuple):
    """How far a training has come."""

    iteration: int
    saved: bool  # not if that state is in doubt
    stopped: bool  # before its budget was spent


class Trainer:
    """The state of a training: networks, optimisers, random streams. `train` drives it."""

    def __init__(self, run: RunFolder, device: torch.device, processes: Processes = ALONE) -> None:
        self.run, self.settings, self.device, self.processes = run, run.settings, device, processes
        self.task = make_task(run, device)
        self.generator = stream(device, self.settings.seed)
        critic = first_critic(self.settings, self.generator)
        self.critic = critic.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.judge = make_judge(self.settings, self.critic, device)
        self.sampler = self.task.make_model(self.generator)
        if not (run.folder / CHECKPOINT).exists():  # a checkpoint brings weights of its own
            self.task.begin(self.sampler)
        self.average = copy.deepcopy(self.sampler).requires_grad_(False)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), betas=(0.5, 0.999), fused=True)
        self.sampler_optimiser = torch.optim.Adam(parameter_groups(self.sampler, self.settings), betas=(0.5, 0.999), fused=True)
        self.reduced_precision = use_bfloat16(self.settings, device)
        self.iteration, self.seconds = 0, 0.0
        self.watch = Watch(settles=0 if self.settings.critic_start else SETTLING)
        self.plateau, self.setbacks = Plateau(), 0
        self.onlooker: Onlooker | None = None  # until it is needed
        if processes.rank:
            self._draw_anew(processes.rank)  # the same networks everywhere, batches of one's own

    def step(self) -> Report:
        """One iteration: synthesise slices, improve the critic on them, then the sampler against it.

        Both losses could share one pass through D, before it moves. That is an eighth cheaper, and was seen to learn worse.
        """
        settings, started = self.settings, time.monotonic()
        self._set_rates()
        batch = self.task.draw(self.iteration, self.generator)
        slices = as_images(self.colors_at(batch.inputs), batch.real.shape[-1])
        fake, real = batch.stretch(slices), batch.stretch(batch.real)  # (B, 3, patch, patch)

        critic_loss, penalty = torch.zeros(()), None
        if settings.trains_critic:
            critic_loss, penalty = self._critic_loss(real, fake.detach())
            self._move(self.critic, self.critic_optimiser, critic_loss)
        self.critic.requires_grad_(False)  # the sampler's step needs its activations, not its gradients
        style, adversarial = self._sampler_losses(real, fake)
        color = self._color_loss(batch.colors)
        alpha = rate(settings.alpha, 0.0, settings.alpha_half_life, self.iteration)
        sampler_loss = settings.beta * style - alpha * adversarial + settings.color_weight * color
        self._move(self.sampler, self.sampler_optimiser, sampler_loss)
        self.critic.requires_grad_(True)

        follow(self.average.parameters(), self.sampler.parameters(), self.iteration, settings.average_decay)
        self.iteration += 1
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # or the time would be that of launching kernels
        return self._report(time.monotonic() - started, critic_loss, penalty, style, adversarial, color)

    def _report(
        self, elapsed: float, critic_loss: Tensor, penalty: Tensor | None, style: Tensor, adversarial: Tensor, color: Tensor
    ) -> Report:
        """The losses as numbers, the same in all processes, so that all of them decide alike."""
        found = (critic_loss, torch.zeros(()) if penalty is None else penalty, style, adversarial, color, torch.tensor(elapsed))
        values = torch.stack([value.detach().double().to(self.device) for value in found])
        critic_mean, penalty_mean, style_mean, adversarial_mean, color_mean, taken = self.processes.mean(values).tolist()
        self.seconds += taken
        return Report(
            iteration=self.iteration,
            seconds=self.seconds,
            critic_loss=critic_mean,
            penalty=None if penalty is None else penalty_mean,
            style=style_mean,
            adversarial=adversarial_mean,
            color=color_mean if self.settings.color_weight else None,
        )

    def colors_at(self, inputs: Inputs) -> Tensor:
        """The model's colours [B, P, 3]."""
        # the points are made outside it: in bfloat16 they are off by a tenth of a pixel
        with autocast(self.device, self.reduced_precision):
            rgb: Tensor = self.sampler(*inputs)
        return rgb.float()

    def _move(self, model: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        """One step of a model down its loss."""
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        self.processes.average_gradients(model.parameters())
        optimiser.step()

    def _critic_loss(self, real: Tensor, fake: Tensor) -> tuple[Tensor, Tensor | None]:
        """L_D of Eq. 3 with the authors' drift term, and its gradient penalty alone when this iteration has one."""
        settings = self.settings
        with autocast(self.device, self.reduced_precision):
            logits, _ = self.critic(torch.cat([fake, real]))
        on_fake, on_real = logits.float().chunk(2)
        loss = on_fake.mean() - on_real.mean() + settings.drift * (on_real**2).mean()
        if (self.iteration + 1) % settings.penalty_every:
            return loss, None
        penalty = gradient_penalty(self.critic, real, fake, self.generator)
        return loss + settings.penalty * settings.penalty_every * penalty, penalty

    def _sampler_losses(self, real: Tensor, fake: Tensor) -> tuple[Tensor, Tensor]:
        """L_style and E[D(f)] of Eq. 4."""
        settings = self.settings
        with autocast(self.device, self.reduced_precision):
            on_fake, of_fake = self.judge(fake)
            with torch.no_grad():
                _, of_real = self.judge(real)
        style = style_loss(of_real, of_fake, settings.compares_relatively, settings.gram_energy)
        return style, on_fake.float().mean()

    def _color_loss(self, colors: Colors | None) -> Tensor:
        """L_color, where the batch has colours to compare.

        How colours are distributed does not depend on T_i. So far from the origin their gradients would be nothing but large.
        """
        if colors is None:
            return torch.zeros((), device=self.device)
        octaves = [parameter for name, parameter in self.sampler.named_parameters() if is_octave(name)]
        for parameter in octaves:
            parameter.requires_grad_(False)
        found = self.colors_at(colors.inputs)[0]
        for parameter in octaves:
            parameter.requires_grad_(True)
        return color_loss(colors.wanted, found, self.generator)

    def _set_rates(self) -> None:
        s, lowered = self.settings, 0.5**self.setbacks
        for group in self.critic_optimiser.param_groups:
            group["lr"] = lowered * rate(s.critic_rate, s.critic_rate_floor, s.critic_half_life, self.iteration)
        for group in self.sampler_optimiser.param_groups:
            sampler_rate = rate(s.sampler_rate, s.sampler_rate_floor, s.sampler_half_life, self.iteration)
            group["lr"] = lowered * group.get("share", 1.0) * sampler_rate

    def look(self) -> None:
        """Let the onlooker judge the average. It is training time, too."""
        started = time.monotonic()
        self.onlooker = self.onlooker or self.task.onlooker()
        found = torch.tensor([self.onlooker.distance(self.average), time.monotonic() - started], dtype=torch.float64)
        distance, taken = self.processes.mean(found.to(self.device)).tolist()
        self.seconds += taken
        self.plateau.see(distance, self.iteration)

    def save(self) -> None:
        parts = {name: getattr(self, name).state_dict() for name in PARTS}
        progress = {"iteration": self.iteration, "seconds": self.seconds}
        caution = {"watch": self.watch.state(), "plateau": self.plateau.state(), "setbacks": self.setbacks}
        streams = self.processes.gathered(self.generator.get_state())
        if self.processes.first:
            random = {"generator": streams[0], "other_generators": streams[1:]}
            self.run.save_checkpoint(parts | progress | caution | random)
        self.processes.gathered(None)  # nobody goes on, and perhaps back to it, before it is there

    def load(self) -> None:
        """Take up the run's last checkpoint. Where it has none, all processes begin with the first one's weights."""
        state = self.run.load_checkpoint()
        if state is None:
            models = (self.critic, self.sampler, self.average)
            self.processes.share(tensor for model in models for tensor in model.state_dict().values())
            return
        try:
            for name in PARTS:
                getattr(self, name).load_state_dict(state[name])
            self.generator.set_state(self._stream(state))
            self.watch = Watch(**state.get("watch", {}))  # runs of earlier versions have none
            self.plateau = Plateau(**state.get("plateau", {}))
        except (RuntimeError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[-1].strip()  # of torch's, the first only names the class
            raise TrainingError(f"{self.run.folder}: the checkpoint does not fit the run or --device ({reason})") from error
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self.setbacks = state.get("setbacks", 0)

    def _stream(self, state: dict[str, Any]) -> Tensor:
        """The state of this process's random stream. Raises TrainingError if the run has another number of processes."""
        streams: list[Tensor] = [state["generator"], *state.get("other_generators", [])]
        if len(streams) != self.processes.count and state["iteration"] == 0:  # nothing is drawn yet, as in a warm start
            return self.generator.get_state()
        if len(streams) != self.processes.count:
            raise TrainingError(
                f"{self.run.folder}: {len(streams)} processes when it was saved, {self.processes.count} now; expected as many"
            )
        return streams[self.processes.rank]

    def _draw_anew(self, *numbers: int) -> None:
        """Another random stream, a function of the run's seed and these numbers."""
        self.generator.manual_seed(narrowed(self.settings.seed, *numbers))

    @torch.no_grad()
    def flaw(self) -> str:
        """What makes the weights unfit for a checkpoint, or "" (see `watch.flaw`); in the words of the first process."""
        probe = self.task.probe()
        found = flaw((self.critic, self.sampler, self.average), self.average(*probe.inputs), probe.exemplars)
        return str(self.processes.gathered(found)[0])

    def gone_back(self, trouble: str) -> Trainer:
        """A trainer at the last checkpoint, or at the start, with half the rates and another random stream.

        What it draws depends on the settings and on where it went back to, so that a run which is killed on the way does
        the same again. Raises TrainingError once `MOST_SETBACKS` are used up.
        """
        again = Trainer(self.run, self.device, self.processes)
        again.load()
        if self.setbacks == MOST_SETBACKS:
            path = self.run.folder / CHECKPOINT
            holds = f"{path} holds iteration {again.iteration}: export it, or"
            way = holds if path.exists() else "there is no checkpoint yet:"
            raise TrainingError(
                f"{self.run.folder}: the training diverged at iteration {self.iteration} ({trouble}) after {MOST_SETBACKS} "
                f"fresh starts at lower rates; {way} train again with another --seed"
            )
        again.setbacks, again.seconds = self.setbacks + 1, self.seconds
        rank = (self.processes.rank,) if self.processes.rank else ()
        again._draw_anew(again.iteration, again.setbacks, *rank)
        if self.processes.first:
            self.run.rewind_stats(again.iteration)
        return again


def train(
    run: RunFolder,
    budget: Budget,
    device: torch.device,
    on_report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    on_warning: Callable[[str], None] = lambda line: None,
    processes: Processes = ALONE,
) -> Ending:
    """Train until the budget is spent, a plateau that it asks for is reached, or `should_stop` says so; from the run's last
    checkpoint if there is one.

    Leaves a sample behind, and a checkpoint unless its last state is in doubt; a state in doubt never replaces one. A training
    that diverges (`watch`) goes back to its last checkpoint, twice at most, and `on_warning` is told; then it raises
    TrainingError. Of several `processes`, all call this, and the first alone writes, reports and warns.
    """
    trainer = Trainer(run, device, processes)
    trainer.load()
    if processes.first:
        run.rewind_stats(trainer.iteration)
    settings, stopped = run.settings, False

    while not budget.done(trainer.iteration, trainer.seconds):
        stopped = processes.any(should_stop())
        if stopped or (budget.until_plateau and processes.any(trainer.plateau.reached(trainer.iteration))):
            break
        report = trainer.step()
        due = trainer.iteration % settings.checkpoint_every == 0
        style = report.style if settings.beta else 0.0  # where no one minimises it, it may grow as it likes
        trouble = trainer.watch.see(style, report.critic_loss) or (trainer.flaw() if due else "")
        if trouble:
            trainer = trainer.gone_back(trouble)
            if processes.first:
                on_warning(
                    f"iteration {report.iteration}: the training diverged ({trouble}); "
                    f"it goes on from iteration {trainer.iteration}, at half the rates"
                )
            continue
        if trainer.iteration % settings.report_every == 0 and processes.first:
            run.append_stats(vars(report))
            on_report(report)
        if budget.until_plateau and trainer.iteration % EVERY == 0:
            trainer.look()
        if due and not trainer.watch.doubt():
            trainer.save()
        if trainer.iteration % settings.sample_every == 0 and processes.first:  # what cannot be drawn costs no training
            _write_sample(trainer)
    doubt = trainer.watch.doubt() or trainer.flaw()
    if not doubt:
        trainer.save()
    if processes.first:
        if doubt:
            stays = "; the last checkpoint stays" if (run.folder / CHECKPOINT).exists() else ""
            on_warning(f"iteration {trainer.iteration} is not saved ({doubt}){stays}")
        _write_sample(trainer)
    return Ending(trainer.iteration, not doubt, stopped)


def parameter_groups(model: nn.Module, settings: Settings) -> list[dict[str, Any]]:
    """The sampler's parameters with their shares of its learning rate: T_i and Q, which make streaks when rushed, apart."""
    if settings.octave_rate == 1:  # one group, as in the checkpoints of earlier versions
        return [{"params": list(model.parameters())}]
    octaves: list[nn.Parameter] = []
    others: list[nn.Parameter] = []
    for name, parameter in model.named_parameters():
        (octaves if is_octave(name) else others).append(parameter)
    return [{"params": others, "share": 1.0}, {"params": octaves, "share": settings.octave_rate}]


def is_octave(name: str) -> bool:
    """Whether a parameter of that name is T_i, or of the network Q that makes them."""
    return "directions" in name or ".octaves." in name


def _write_sample(trainer: Trainer) -> None:
    path = trainer.run.folder / "samples" / f"{trainer.iteration:06d}.png"
    write_preview(path, trainer.average, trainer.settings, trainer.task.shown(), trainer.device)
