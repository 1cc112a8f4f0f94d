"""Training tests need torch, which the runtime's own environment does not have."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'solidgrain[train]'")

collect_ignore_glob: list[str] = []


@pytest.fixture(scope="session")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stand-in for a photograph, made by code: coloured blotches of two sizes, 96 x 80 pixels."""
    import OpenImageIO as oiio

    path = tmp_path_factory.mktemp("photographs") / "blotches.png"
    oiio.ImageBuf(blotches(80, 96)).write(os.fspath(path), oiio.UINT8)
    return path


def blotches(height: int, width: int) -> np.ndarray:
    draw = np.random.default_rng(0)
    fine = draw.random((height, width, 3), np.float32)
    coarse = np.kron(draw.random((-(-height // 8), -(-width // 8), 3), np.float32), np.ones((8, 8, 1), np.float32))[
        :height, :width
    ]
    return np.ascontiguousarray(0.5 * fine + 0.5 * coarse, np.float32)
