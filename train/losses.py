"""The losses: WGAN-GP for the critic (Eq. 3), WGAN plus the Gram loss of the critic itself for the sampler (Eq. 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from solidgrain.train.critic import Critic


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


def style_loss(real: Sequence[Tensor], fake: Sequence[Tensor], pooled: bool) -> Tensor:
    """L_style of Eq. 4: the mean over layers of the mean absolute difference of Gram matrices.

    The Gram matrix is F F^T / pixels, the normalisation of the authors' code; the equation's 1 / (4 N² M²) differs from it
    by a factor per layer. `pooled` averages the matrices over the batch before they are compared: all patches come from
    one exemplar, and their mean is a less noisy target than any one patch.
    """
    terms = [(gram_matrix(r, pooled) - gram_matrix(f, pooled)).abs().mean() for r, f in zip(real, fake, strict=True)]
    return torch.stack(terms).mean()


def gram_matrix(activations: Tensor, pooled: bool) -> Tensor:
    """Activations [B, C, H, W] -> Gram matrices [B, C, C], or their mean [C, C]; float32 whatever came in."""
    flat = activations.float().flatten(2)
    gram: Tensor = flat @ flat.transpose(1, 2) / flat.shape[2]
    return gram.mean(0) if pooled else gram
