"""The paired Wilcoxon signed-rank test (Wilcoxon 1945), exact, ties and all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def signed_rank(differences: Sequence[float]) -> float:
    """The two-sided p-value of paired differences: how often signs that were tossed would give ranks as uneven as these.

    Differences of zero are left out, and equal ones share their mean rank. Nothing is approximated: the distribution is
    counted, given the ranks. 1.0 where no difference is left.
    """
    found = np.asarray(differences, np.float64)
    found = found[found != 0]
    _, place, count = np.unique(np.abs(found), return_inverse=True, return_counts=True)
    doubled = (2 * np.cumsum(count) - count + 1)[place]  # twice the mean rank of each: whole numbers
    chance = np.ones(1)  # chance[k]: that the ranks of positive signs sum to k / 2
    for rank in doubled:
        chance = 0.5 * (np.pad(chance, (0, rank)) + np.pad(chance, (rank, 0)))
    positive = int(doubled[found > 0].sum())
    return float(min(1.0, 2 * min(chance[: positive + 1].sum(), chance[positive:].sum())))
