"""Baking: a texture evaluated on a voxel grid, slab by slab, into the files that pipelines load.

`plan` says what is baked and whether it can be, `baker` runs it, `writers` holds one file format per module behind a table
from suffix to writer, `view` shows a volume, `cli` is the command line.
"""
