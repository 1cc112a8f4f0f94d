"""The table of writers, from suffix to file format, and the little that all formats share."""

from solidgrain.bake.writers.base import FloatArray, Option, Output, Volume, Writer, slab_slices
from solidgrain.bake.writers.table import (
    PREVIEW,
    bounds,
    check_output,
    formats,
    kind_of,
    make_output,
    may_round,
    open_writer,
    output_bytes,
    output_exists,
    output_files,
    rounds,
    scratch_bytes,
    suffixes,
    turned_bytes,
)

__all__ = [
    "PREVIEW",
    "FloatArray",
    "Option",
    "Output",
    "Volume",
    "Writer",
    "bounds",
    "check_output",
    "formats",
    "kind_of",
    "make_output",
    "may_round",
    "open_writer",
    "output_bytes",
    "output_exists",
    "output_files",
    "rounds",
    "scratch_bytes",
    "slab_slices",
    "suffixes",
    "turned_bytes",
]
