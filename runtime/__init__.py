"""The runtime: load a texture, evaluate it anywhere in space. Needs numpy and onnxruntime, nothing else.

    from solidgrain.runtime import load_space, load_texture

    texture = load_texture("granite")               # an embedded name, a bundle folder, or a saved texture file
    rgb = texture.sample(points, seed=7)            # points [P, 3] (x, y, z) in exemplar pixels -> [P, 3]
    volume = texture.grid((64, 128, 128), seed=7)   # (z, y, x) voxels -> [64, 128, 128, 3]

    space = load_space("stone")                     # a bundle with an encoder
    texture = space.encode(exemplar)                # [H, W, 3] float32 in [0, 1] or uint8
    wall = space.blend_along(texture, other, "z", 0, 96)    # one below, the other above

Conventions, everywhere in this package. Coordinates are in exemplar pixels; vectors are (x, y, z), right-handed, z up;
arrays are [z, y, x, channel], C order. Samples sit at voxel centres: voxel k of an axis is at origin + (k + 0.5) spacing.
Colour is sRGB-encoded float32 in [0, 1]. The colour of a voxel depends on texture, seed and coordinate, and on nothing
else: not on chunk, slab, order or threads.
"""

from solidgrain.runtime.bundle import embedded_names
from solidgrain.runtime.errors import (
    BakeError,
    BundleError,
    EvaluationError,
    ExemplarError,
    ProviderError,
    SolidgrainError,
    TrainingError,
    UsageError,
    ViewError,
)
from solidgrain.runtime.loading import load
from solidgrain.runtime.space import Space, load_space
from solidgrain.runtime.texture import Texture, load_texture

__all__ = [
    "BakeError",
    "BundleError",
    "EvaluationError",
    "ExemplarError",
    "ProviderError",
    "SolidgrainError",
    "Space",
    "Texture",
    "TrainingError",
    "UsageError",
    "ViewError",
    "embedded_names",
    "load",
    "load_space",
    "load_texture",
]
