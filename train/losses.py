"""The losses: WGAN-GP for the critic (Eq. 3), WGAN plus the Gram loss of the critic itself for the sampler (Eq. 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from solidgrain.train.critic import Critic
from solidgrain.train.settings import Settings
from solidgrain.train.vgg import STYLE_LAYERS, Vgg

Judge = Callable[[Tensor], tuple[Tensor, list[Tensor]]]  # images -> D's logits [B, 1], activations of F per layer


def make_judge(settings: Settings, critic: Critic, device: torch.device) -> Judge:
    """What L_G asks of a slice: the verdict of D, and the activations of F, which is D itself but in some comparisons."""
    if settings.style_features == "critic":
        return critic
    vgg = Vgg(device)

    def judge(images: Tensor) -> tuple[Tensor, list[Tensor]]:
        logits = critic(images)[0] if settings.trains_critic else torch.zeros(len(images), 1, device=device)
        activations = vgg.features(images, padding=1)
        return logits, [activations[layer] for layer in STYLE_LAYERS]

    return judge


def gradient_penalty(critic: Critic, real: Tensor, fake: Tensor, generator: torch.Generator) -> Tensor:
    """E[(|grad_u D(u)| - 1)²], u uniform on the line between a real and a generated patch (Eq. 3).

    Call it outside autocast: a penalty in bfloat16 lets the critic's activations grow without bound, and L_style with
    them.
    """
    along = torch.rand(len(real), 1, 1, 1, generator=generator, device=generator.device)
    between = (real + along * (fake - real)).requires_grad_(True)
    (gradient,) = torch.autograd.grad(critic(between)[0].sum(), between, create_graph=True)
    penalty: Tensor = ((gradient.flatten(1).norm(dim=1) - 1) ** 2).mean()
    return penalty


def style_loss(real: Sequence[Tensor], fake: Sequence[Tensor], groups: int, relative: bool = False) -> Tensor:
    """L_style of Eq. 4: the mean over layers of the mean absolute difference of Gram matrices.

    The Gram matrix is F F^T / pixels, the normalisation of the authors' code; the equation's 1 / (4 N² M²) differs from it
    by a factor per layer. The batch is so many groups of consecutive patches, each of one exemplar: matrices are averaged
    within a group before they are compared, for a mean is a less noisy target than any one patch. `relative` divides each
    layer's and group's term by the mean absolute entry of its real matrix: the scale of the features then does not matter.
    """
    terms = []
    for of_real, of_fake in zip(real, fake, strict=True):
        terms.append(gram_difference(gram_matrices(of_real, groups), gram_matrices(of_fake, groups), relative).mean())
    return torch.stack(terms).mean()


def gram_difference(wanted: Tensor, found: Tensor, relative: bool) -> Tensor:
    """Mean absolute differences [groups] of Gram matrices [groups, C, C], over those wanted if `relative`."""
    difference = (wanted - found).abs().mean((1, 2))
    return difference / wanted.abs().mean((1, 2)) if relative else difference


def mean_grams(batches: Iterable[Sequence[Tensor]]) -> list[Tensor]:
    """The activations of several batches, by layer -> each layer's mean Gram matrix [1, C, C]."""
    of_batches = [[gram_matrices(of_layer, 1) for of_layer in activations] for activations in batches]
    return [torch.stack(of_layer).mean(0) for of_layer in zip(*of_batches, strict=True)]


def gram_matrices(activations: Tensor, groups: int) -> Tensor:
    """Activations [B, C, H, W] -> the mean Gram matrix of each group [groups, C, C]; float32 whatever came in."""
    flat = activations.float().flatten(2)
    gram: Tensor = flat @ flat.transpose(1, 2) / flat.shape[2]
    return gram.reshape(groups, -1, *gram.shape[1:]).mean(1)
