"""Random streams. torch's generator on CPUs takes 32 bits of a seed: seeds that share those would share a stream."""

from __future__ import annotations

import numpy as np
import torch

TABLES, MEASURE = 0x7AB1E5, 0x3EA5  # numbers of streams beside a training's own


def stream(device: torch.device, seed: int, *numbers: int) -> torch.Generator:
    """The stream of a seed from 0 to 2^64 - 1, and another one for any numbers that come with it."""
    return torch.Generator(device).manual_seed(narrowed(seed, *numbers))


def narrowed(seed: int, *numbers: int) -> int:
    """The 32 bits that tell a seed, and numbers that come with it, from others; a small seed alone as it is."""
    if seed < 2**32 and not numbers:
        return seed
    return int(np.random.SeedSequence(seed, spawn_key=numbers).generate_state(1, np.uint32)[0])
