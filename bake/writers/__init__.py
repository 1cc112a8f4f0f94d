"""The table of writers, from suffix to file format, and the little that all formats share."""

from solidgrain.bake.writers.base import Output, Volume, Writer
from solidgrain.bake.writers.table import make_output, open_writer, output_bytes, output_exists, suffixes

__all__ = ["Output", "Volume", "Writer", "make_output", "open_writer", "output_bytes", "output_exists", "suffixes"]
