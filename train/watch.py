"""Whether a training is still sound: losses that explode, weights that are no numbers, an average that has gone flat.

How the limit was chosen is in docs/training.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

LIMIT = 30.0  # times its lowest that the running mean of a loss may be
SPIKE = 300.0  # times the lowest mean that a single loss may be: a mean alone is slow to show that an explosion has begun
PATIENCE = 100  # iterations beyond the limit in a row: it will not come back
MEMORY = 10  # iterations, of the running means
UNITS = {"L_style": 2e-2, "L_D": 1.0}  # added to the magnitudes: L_D crosses zero, and neither means much far below
SETTLING = 1000  # iterations in which a critic from N(0,1) scales its features up, and both losses with them
FLAT = 0.05  # of the exemplar's deviation: an average whose colours deviate less than that ignores its noise


@dataclass
class Watch:
    """What is remembered of the losses from one iteration to the next; goes into the checkpoint."""

    means: dict[str, float] = field(default_factory=dict)  # running means of the logarithms of the magnitudes
    lowest: dict[str, float] = field(default_factory=dict)  # of the means
    latest: dict[str, float] = field(default_factory=dict)  # logarithms of the latest magnitudes
    settles: int = 0  # the first iterations, whose magnitudes say nothing
    seen: int = 0  # iterations
    beyond: int = 0  # iterations in a row in which a loss was beyond the limit

    def see(self, style: float, critic: float) -> str:
        """Take in the losses of one iteration. What is wrong with the training, or "" if it can go on."""
        if not math.isfinite(style) or not math.isfinite(critic):
            return "a loss is not finite"
        self.seen += 1
        keep = 1 - 1 / min(self.seen, MEMORY)
        for name, loss in (("L_style", style), ("L_D", critic)):
            magnitude = math.log(abs(loss) + UNITS[name])
            self.latest[name] = magnitude
            self.means[name] = keep * self.means.get(name, 0.0) + (1 - keep) * magnitude
            if self.seen >= max(MEMORY, self.settles):
                self.lowest[name] = min(self.lowest.get(name, math.inf), self.means[name])
        self.beyond = self.beyond + 1 if self.doubt() else 0
        return self.doubt() if self.beyond >= PATIENCE else ""

    def doubt(self) -> str:
        """Which loss is beyond its limit at the moment; "" if none is. What is in doubt must not become a checkpoint."""
        for name, lowest in self.lowest.items():
            mean, latest = (math.exp(magnitudes[name] - lowest) for magnitudes in (self.means, self.latest))
            if mean > LIMIT or latest > SPIKE:
                return f"{name} is {max(mean, latest):.0f} times its lowest mean, too high for {self.beyond} iterations"
        return ""

    def state(self) -> dict[str, Any]:
        return asdict(self)


def flaw(networks: Iterable[nn.Module], colors: Tensor, exemplars: Sequence[Tensor]) -> str:
    """What makes weights unfit for a checkpoint: NaN, infinity, or colours that hardly vary; "" if nothing does.

    colors [K, P, 3] are the average's, at far-apart places of K textures, exemplars [3, H, W] what these were learned from.
    """
    if not all(bool(torch.isfinite(tensor).all()) for network in networks for tensor in network.state_dict().values()):
        return "a weight is not finite"
    wanted = float(torch.stack([exemplar.flatten(1).std(-1).mean() for exemplar in exemplars]).mean())
    found = float(colors.std(1).mean())
    if not found >= FLAT * wanted:  # NaN is none either
        return f"the average has collapsed: its colours deviate by {found:.2g}, the exemplar's by {wanted:.2g}"
    return ""
