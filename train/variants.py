"""The variants that the paper compares its method with (Sec. 4, "Single exemplar", Table 1), each a few changed settings.

    paper           the method itself
    noise-at-input  NI: all octaves enter S at its input layer (Fig. 2 a), and S learns five times slower
    gan+vgg         L_style on VGG's Gram matrices instead of D's
    a1b0            α:1, β:0: a plain WGAN, no L_style
    a0b1            α:0, β:1: L_style only. D learns as ever: its features are what L_style compares
    henzler         after Henzler et al. (CVPR 2020): noise at the input, slices along the axes only, VGG's L_style, no D

The paper ran Henzler et al.'s own model; `henzler` is what the paper says sets it apart, in a sampler of our size, with our
optimiser and the L1 distance of Eq. 4. For GAN+VGG the paper "chose the hyperparameters to approximately result in the same
weighting as ours": here α and β stay, and VGG's L_style is taken relative to the exemplar's Gram matrices. Between batches of
the exemplar's own patches it is then 0.09 to 0.12, where D's, compared likewise, ended near 0.13 in a good run. The VGG is
VGG-16 (the paper names VGG-19), up to conv4_1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from solidgrain.train.settings import Settings

CHANGES: dict[str, dict[str, Any]] = {
    "paper": {},
    "noise-at-input": {"noise_at_input": True, "sampler_start": ""},  # the embedded space has the method's
    "gan+vgg": {"style_features": "vgg"},
    "a1b0": {"alpha": 1.0, "alpha_half_life": 0.0, "beta": 0.0, "color_weight": 0.0},
    "a0b1": {"alpha": 0.0, "beta": 1.0, "color_weight": 0.0},
    "henzler": {
        "noise_at_input": True,
        "sampler_start": "",
        "rotations": "axis",
        "style_features": "vgg",
        "alpha": 0.0,
        "color_weight": 0.0,
    },
}
SLOWER = {"noise-at-input": 5.0}  # "we had to lower the learning rate by a factor of 5 [...] to achieve convergence"


def canonical(name: str) -> str:
    """A variant's name as this module spells it: the paper's α and β are a and b."""
    return name.lower().replace("α", "a").replace("β", "b").replace(":", "").replace(",", "").replace(" ", "")


def vary(settings: Settings, name: str) -> Settings:
    """The settings of a variant, everything that it does not change as it was."""
    slower = SLOWER.get(name, 1.0)
    return replace(
        settings,
        variant=name,
        sampler_rate=settings.sampler_rate / slower,
        sampler_rate_floor=settings.sampler_rate_floor / slower,
        **CHANGES[name],
    )
