"""The table of writers, from suffix to file format, and the little that all formats share."""

from solidgrain.bake.writers.base import FloatArray, Output, Volume, Writer
from solidgrain.bake.writers.table import (
    encoding,
    make_output,
    open_writer,
    output_bytes,
    output_exists,
    output_files,
    suffixes,
)

__all__ = [
    "FloatArray",
    "Output",
    "Volume",
    "Writer",
    "encoding",
    "make_output",
    "open_writer",
    "output_bytes",
    "output_exists",
    "output_files",
    "suffixes",
]
