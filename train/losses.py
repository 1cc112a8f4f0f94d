"""The losses: WGAN-GP for the critic (Eq. 3), WGAN plus the Gram loss of the critic itself for the sampler (Eq. 4).

And one that the paper does not have, of colours alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from solidgrain.train.contrast import FAINTEST
from solidgrain.train.critic import Critic
from solidgrain.train.settings import Settings
from solidgrain.train.vgg import Vgg

PROJECTIONS = 16  # of colours, in each iteration others

Judge = Callable[[Tensor], tuple[Tensor, list[Tensor]]]  # images -> D's logits [B, 1], activations of F per layer


def make_judge(settings: Settings, critic: Critic, device: torch.device) -> Judge:
    """What L_G asks of a slice: the verdict of D, and the activations of F, which is D itself but in some comparisons."""
    if settings.style_features == "critic":
        return critic
    vgg = Vgg(device)

    def judge(images: Tensor) -> tuple[Tensor, list[Tensor]]:
        logits = critic(images)[0] if settings.trains_critic else torch.zeros(len(images), 1, device=device)
        return logits, vgg.style(images)

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


def style_loss(real: Sequence[Tensor], fake: Sequence[Tensor], relative: bool = False, energy: bool = False) -> Tensor:
    """L_style of Eq. 4: the mean over layers of the mean absolute difference of Gram matrices.

    The Gram matrix is F F^T / pixels, the normalisation of the authors' code; the equation's 1 / (4 N² M²) differs from it
    by a factor per layer. Each slice is compared with the patch in its place: of the same exemplar, or for `energy` all are of
    one (`gram_energy`). `relative` differences are those over the mean absolute entry of the real matrix: the scale of the
    features then does not matter.
    """
    terms = []
    for of_real, of_fake in zip(real, fake, strict=True):
        wanted, found = (gram_matrices(activations) for activations in (of_real, of_fake))
        if energy:
            terms.append(gram_energy(wanted, found, relative))
        else:
            terms.append(gram_difference(wanted, found, relative).mean())
    return torch.stack(terms).mean()


def gram_energy(wanted: Tensor, found: Tensor, relative: bool) -> Tensor:
    """How far apart two sets of Gram matrices [B, C, C] are, as distributions: E|W - F| - E|F - F'| / 2.

    Patches of one exemplar are not alike, and a slice is compared with whichever was drawn. |W - F| alone is least where every
    F is the median of all W: what only some patches show becomes rare. Less half of what slices differ from each other, it is
    the part of the energy distance (Székely, Rizzo 2013, "Energy statistics") that depends on F, least where F is
    distributed as W.
    """
    between = torch.stack([(wanted - one).abs().mean() for one in found]).mean()
    pairs = [(found[k] - found[:k]).abs().mean((1, 2)) for k in range(1, len(found))]
    within = torch.cat(pairs).mean() if pairs else torch.zeros_like(between)
    energy = between - within / 2
    return energy / wanted.abs().mean() if relative else energy


def gram_difference(wanted: Tensor, found: Tensor, relative: bool) -> Tensor:
    """Mean absolute differences [B] of Gram matrices [B, C, C], over those wanted if `relative`."""
    difference = (wanted - found).abs().mean((1, 2))
    return difference / wanted.abs().mean((1, 2)) if relative else difference


def color_loss(wanted: Tensor, found: Tensor, generator: torch.Generator) -> Tensor:
    """L_color: how far colours [P, 3] are from others, as distributions, over the variance of those wanted.

    The squared sliced Wasserstein distance (Bonneel et al. 2015; Heitz et al. 2021 take it between VGG's features): along a
    random axis, the k-th of these belongs to the k-th of those. Gram matrices of D are moments. A material of three
    colours and one of all that lie between them may share those.
    """
    axes = F.normalize(torch.randn(3, PROJECTIONS, generator=generator, device=generator.device), dim=0)
    in_order, to_be = ((colors @ axes).sort(dim=0).values for colors in (found, wanted))
    loss: Tensor = (in_order - to_be).square().mean() / wanted.var(dim=0).mean().clamp(min=FAINTEST**2)
    return loss


def mean_grams(batches: Iterable[Sequence[Tensor]]) -> list[Tensor]:
    """The activations of several batches, by layer -> each layer's mean Gram matrix [1, C, C]."""
    of_batches = [[mean_gram(of_layer) for of_layer in activations] for activations in batches]
    return [torch.stack(of_layer).mean(0) for of_layer in zip(*of_batches, strict=True)]


def mean_gram(activations: Tensor) -> Tensor:
    """Activations [B, C, H, W] -> the mean of the batch's Gram matrices [1, C, C]."""
    return gram_matrices(activations).mean(0, keepdim=True)


def gram_matrices(activations: Tensor) -> Tensor:
    """Activations [B, C, H, W] -> the Gram matrix of each image [B, C, C]; float32 whatever came in."""
    flat = activations.float().flatten(2)
    gram: Tensor = flat @ flat.transpose(1, 2) / flat.shape[2]
    return gram
