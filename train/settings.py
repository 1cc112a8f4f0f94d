"""Every setting of a training run, the two presets, and how they are saved beside the result."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from solidgrain.runtime.errors import TrainingError


@dataclass(frozen=True)
class Settings:
    """What a run depends on besides its exemplar and its budget; saved as `options.json`.

    A default is what runs of earlier versions mean where they do not say, and never changes. What `fast` is today, `FAST` says.

    Rates follow `rate(k) = max(floor, start * 0.5 ** (k / half_life))` at iteration k, and alpha likewise, down to 0; a
    half-life of 0 keeps them constant.
    """

    preset: str = "fast"
    variant: str = "paper"  # the method itself, or one of the paper's comparisons with it (variants.py)
    seed: int = 0

    # Sampler (Sec. 3.1)
    octaves: int = 16  # n
    width: int = 128  # hidden units m of each of the five hidden layers
    resolution: int = 64  # texels along each axis of a noise table
    octave_span: float = 7.0  # octave i scales by 2 ** (span * i / (n - 1))
    orthogonal_start: bool = True  # T_i starts as a random orthogonal matrix, else N(0,1)^{3x3}
    principal_colors: bool = False  # the output is along the principal axes of the exemplar's colours, else red, green, blue
    shared_noise: bool = False  # one set of noise tables, read elsewhere in each iteration, else fresh ones
    noise_at_input: bool = False  # all octaves enter S at its input (Fig. 2 a), none its hidden layers

    # Slices (Sec. 4, implementation details)
    patch: int = 64  # pixels along each side of a patch
    later_patch: int = 0  # the same from iteration `later_from` on; 0: as before
    later_room: int = 2  # times as large as that must be an exemplar that gets larger patches later
    later_from: int = 800
    batch: int = 4
    transposed: bool = True  # real patches of isotropic materials are also transposed by chance, not only flipped
    # uniform on SO(3), the authors' three angles in [0°, 90°], or along the axes only (Henzler et al. 2020)
    rotations: Literal["uniform", "euler", "axis"] = "uniform"
    grain: Literal["none", "x", "y"] = "none"  # the image axis about which slices turn; "none" turns them freely
    upright: bool = False  # patches are never mirrored, and slices turn by a quarter about the grain: none is seen from behind
    grain_ratio: float = 1.0  # length of the structures across the grain over along it, at the start

    # Losses (Eq. 3, Eq. 4)
    alpha: float = 0.1  # weight of the adversarial term in L_G, at the start
    alpha_half_life: float = 0.0  # iterations in which it falls by half; 0: it stays
    beta: float = 1.0  # weight of L_style
    style_features: Literal["critic", "vgg"] = "critic"  # F of L_style: D itself, or a pretrained VGG-16
    penalty: float = 10.0  # lambda, weight of the gradient penalty
    penalty_every: int = 4  # iterations between penalties, each weighted that much more (lazy regularisation, StyleGAN2)
    drift: float = 0.001  # weight of E[D(r)^2] (gramgan/main.py; not in the paper)
    relative_gram: bool = False  # differences of Gram matrices over their size, else as they are
    color_weight: float = 0.0  # of L_color, how colours are distributed in the solid and in its single exemplar
    gram_energy: bool = False  # L_style is an energy distance: slices differ among themselves as the exemplar's patches do

    # Texture space (Sec. 3.2)
    latent: int = 0  # length of z; 0 for a single exemplar
    color_moments: bool = False  # four numbers of z are the patch's mean colour and contrast, else all are learned
    encoded_patch: int = 128  # pixels along each side of the patch that E sees

    # Optimisation
    critic_contrast: float = 0.0  # root mean square to which D sees faint exemplars stretched; 0: as they are
    critic_start: str = ""  # the embedded space whose critic D starts as, else N(0,1)
    sampler_start: str = ""  # the embedded space whose texture of the exemplar S starts as, else N(0,1)
    warm_start: str = ""  # the run or checkpoint file whose weights were taken over instead, for the record
    critic_rate: float = 1e-3
    critic_rate_floor: float = 1e-3
    critic_half_life: float = 0.0
    sampler_rate: float = 2e-3
    sampler_rate_floor: float = 4e-4
    sampler_half_life: float = 400.0
    octave_rate: float = 1.0  # of T_i and of the network Q that makes them, over the sampler's
    average_decay: float = 0.999  # at most, of the exponential moving average whose weights are all output
    precision: Literal["auto", "float32", "bfloat16"] = "auto"

    # Reporting
    checkpoint_every: int = 250  # iterations
    sample_every: int = 500
    report_every: int = 20

    @property
    def trains_critic(self) -> bool:
        """Whether any term of L_G needs D: with alpha = 0 it still learns, since L_style lives on its activations."""
        return self.alpha != 0 or self.style_features == "critic"

    @property
    def compares_relatively(self) -> bool:
        """Whether L_style divides by the size of the real Gram matrix; with VGG's features always, which nobody scales."""
        return self.relative_gram or self.style_features == "vgg"


@dataclass(frozen=True)
class Budget:
    """When to stop: after that many iterations or minutes of training in all, whichever comes first.

    Or before, when it gets no better (plateau.py).
    """

    iterations: int | None = None
    minutes: float | None = None
    until_plateau: bool = False

    def done(self, iteration: int, seconds: float) -> bool:
        return self.progress(iteration, seconds) >= 1.0

    def progress(self, iteration: int, seconds: float) -> float:
        """The share of the budget that is spent."""
        by_iteration = iteration / self.iterations if self.iterations else 0.0
        by_time = seconds / (60 * self.minutes) if self.minutes else 0.0
        return max(by_iteration, by_time)


FAST = Settings(
    alpha=0.03,
    alpha_half_life=400.0,
    critic_contrast=0.15,
    critic_start="stone",
    octaves=32,
    sampler_start="stone",
    later_patch=128,
    later_room=4,
    principal_colors=True,
    shared_noise=True,
    relative_gram=True,
    gram_energy=True,
    color_weight=1.0,
    sampler_rate=4e-3,
)
"""Tuned for few CPU minutes. How it departs from the paper, and why, is in docs/training.md."""

PAPER = Settings(
    preset="paper",
    octave_span=15.0,
    orthogonal_start=False,
    patch=128,
    batch=16,
    transposed=False,
    rotations="euler",
    penalty_every=1,
    critic_rate=2e-3,
    critic_rate_floor=2e-3,
    sampler_rate=5e-4,
    sampler_rate_floor=5e-4,
    sampler_half_life=0.0,
    average_decay=0.999,
)
"""The settings of the paper and of the authors' code: 128² patches, batch 16, T ~ N(0,1) 2^i, constant rates."""

SPACE: dict[str, Any] = {"octaves": 32, "latent": 32}
"""What makes any settings those of a texture space (Sec. 4: "our conditional models use n = 32")."""

PRESETS = {
    "fast": FAST,
    "paper": PAPER,
    # Rates fall more slowly than for one exemplar: hours of training, over many.
    "fast space": replace(
        FAST,
        **SPACE,
        alpha=0.1,
        alpha_half_life=0.0,
        sampler_start="",
        later_patch=0,
        color_weight=0.0,
        color_moments=True,
        gram_energy=False,
        sampler_rate=1e-3,
        sampler_half_life=6000.0,
        octave_rate=0.1,
        critic_rate=2e-3,
        critic_half_life=6000.0,
    ),
    "paper space": replace(PAPER, **SPACE, octave_span=15.5),  # 2^(i/2)
}
RETIRED = {"keep_best", "pooled_gram", "group", "noise_weight_start"}  # settings of earlier versions
PRESET_ITERATIONS = {"fast": 1200, "paper": 100_000, "fast space": 30_000, "paper space": 300_000}


def preset(name: str, **changes: Any) -> Settings:
    """The named preset with some of its settings replaced."""
    return replace(PRESETS[name], **changes)


def rate(start: float, floor: float, half_life: float, iteration: int) -> float:
    """The learning rate, or alpha, at an iteration (see `Settings`)."""
    return start if half_life == 0 else max(floor, start * 0.5 ** (iteration / half_life))


def to_json(settings: Settings) -> dict[str, Any]:
    return asdict(settings)


def from_json(values: dict[str, Any]) -> Settings:
    """Settings back from `options.json`. Raises TrainingError if it names a setting that does not exist."""
    if values.get("group", 1) != 1 or (values.get("pooled_gram") and not values.get("latent")):
        raise TrainingError(
            "options.json: written by an earlier version, with patches in groups or Gram matrices pooled; train anew"
        )
    values = {name: value for name, value in values.items() if name not in RETIRED}
    unknown = set(values) - {field.name for field in fields(Settings)}
    if unknown:
        raise TrainingError(f"options.json: unknown settings {json.dumps(sorted(unknown))}; written by another version?")
    return Settings(**values)
