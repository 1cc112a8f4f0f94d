"""Colour encodings. The sampler speaks the exemplar's encoding, sRGB; film formats want linear light."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]


def to_linear(rgb: FloatArray) -> FloatArray:
    """sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    low = rgb / np.float32(12.92)
    high = ((rgb + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    linear: FloatArray = np.where(rgb <= np.float32(0.04045), low, high)
    return linear
