"""Presets for game engines (`--for`): which way their axes point, and what their importers take.

Textures are right-handed, z up. A volume texture is looked up by coordinates (u, v, w) that follow the engine's own x, y, z, so
the file's axes are those of the engine, each named by the axis of the texture that it is (`Volume.axes`). A change between
right-handed and left-handed needs a mapping of determinant -1, or the stone would be its mirror image.

Unreal: x forward, y right, z up, left-handed. Ours with y mirrored: "+x-y+z", determinant -1.
Unity: x right, y up, z forward, left-handed. Its y is our z and its z our y: "+x+z+y", a swap, determinant -1.
    Unity reads images from the bottom row upwards (v = 0 is the bottom), but an atlas has y = 0 at the top of each tile. So
    there the rows run the other way: "+x-z+y". The mirror in the file undoes that of the importer.
Godot: x right, y up, z towards the viewer, right-handed. Its y is our z and its z our -y, a quarter turn about x:
    "+x+z-y", determinant +1. Godot keeps the top row of an image at v = 0, as Unreal does.

Limits: 2048 voxels a side is Direct3D's for volume textures (Unity's manual, "3D textures", says the same); Unreal cuts
volumes that it makes from an atlas at 512 slices (MAX_VOLUME_TEXTURE_DEPTH in VolumeTexture.cpp). 16384 pixels a side is
Direct3D's limit of images, Unity's largest "Max Size", and the side of the square that Godot's Image::MAX_PIXELS is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from solidgrain.bake.writers import Output, Volume
from solidgrain.bake.writers.atlas import Layout, layout
from solidgrain.bake.writers.table import BLOCKS
from solidgrain.runtime.errors import UsageError

VOLUME_SIDE, IMAGE_SIDE = 2048, 16384
ATLASES = (".atlas.png", ".atlas.exr")
VOLUME_TEXTURES = (".dds", ".raw", *ATLASES)  # kinds that an engine loads as a whole


@dataclass(frozen=True)
class Engine:
    """What an engine expects of a volume texture."""

    name: str
    axes: str
    atlas_axes: str
    depth: int = VOLUME_SIDE  # slices
    side: int = VOLUME_SIDE  # voxels along x and y
    image_side: int = IMAGE_SIDE  # pixels of an atlas


ENGINES = {
    "unreal": Engine("Unreal", "+x-y+z", "+x-y+z", depth=512),
    "unity": Engine("Unity", "+x+z+y", "+x-z+y"),
    "godot": Engine("Godot", "+x+z-y", "+x+z-y"),
}


def axes_for(engine: str, kind: str = "") -> str:
    """Which axes of the texture the x, y and z of a file for an engine are. `kind` is the output's. Raises UsageError."""
    preset = _preset(engine)
    return preset.atlas_axes if kind in ATLASES else preset.axes


def check_engine(engine: str, output: Output, volume: Volume) -> None:
    """Refuse what an engine's importer cannot take. `volume` has the engine's axes. Raises UsageError with the reason."""
    preset = _preset(engine)
    if output.kind not in VOLUME_TEXTURES:
        return
    for axis, extent, most in zip("zyx", volume.shape, (preset.depth, preset.side, preset.side), strict=True):
        if extent > most:
            raise UsageError(
                f"--for {engine}: {output.path} has {extent} voxels along its {axis}, {preset.name} takes at most {most} in a "
                "volume texture; bake fewer"
            )
    if engine == "unreal" and output.options.get("type") in BLOCKS:
        raise UsageError(
            f"--for unreal: {output.path} is {output.options['type']}, Unreal imports no block-compressed DDS; use "
            "--dds-type rgba8, Unreal compresses it itself"
        )
    if output.kind in ATLASES and output.options["mips"]:
        raise UsageError(
            f"--for {engine}: {output.path} is an atlas, whose levels {preset.name} makes itself; leave out --mips"
        )
    if output.kind in ATLASES:
        _check_atlas(engine, output, volume)


def _check_atlas(engine: str, output: Output, volume: Volume) -> None:
    preset, tiles, depth = _preset(engine), layout(output, volume), volume.shape[0]
    picture = f"--for {engine}: {output.path} has {tiles.columns}x{tiles.rows} tiles of {tiles.tile_width}x{tiles.tile_height}"
    if max(tiles.width, tiles.height) > preset.image_side:
        raise UsageError(
            f"{picture}, {tiles.width}x{tiles.height} pixels, {preset.name} imports at most {preset.image_side} a side; choose "
            f"another --atlas-columns or bake fewer"
        )
    if tiles.columns * tiles.rows != depth:
        raise UsageError(
            f"{picture} for {depth} slices, {preset.name} would take the empty ones for slices; choose --atlas-columns "
            f"that divides {depth}"
        )
    if engine == "unreal" and unreal_guess(tiles) != (tiles.tile_width, tiles.tile_height):
        raise UsageError(
            f"{picture}, Unreal would guess their size wrongly; bake .dds, which says it, or a cube with a square number of "
            "slices, such as 64 or 256"
        )


def unreal_guess(tiles: Layout) -> tuple[int, int]:
    """The tile size that Unreal makes of an image: it takes the volume for about a cube and its grid of tiles for a square
    (UVolumeTexture::SetDefaultSource2DTileSize). (0, 0) where it finds none."""
    side = math.floor((tiles.width * tiles.height) ** (1 / 3) + 0.5)
    along = math.floor(math.sqrt((tiles.width // side) * (tiles.height // side)) + 0.5)
    return (tiles.width // along, tiles.height // along) if along else (0, 0)


def _preset(engine: str) -> Engine:
    if engine not in ENGINES:
        raise UsageError(f"--for {engine}: unknown engine; pick one of {', '.join(ENGINES)}")
    return ENGINES[engine]
