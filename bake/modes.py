"""Which flags of `solidgrain bake` go together: a plan has one source, and one way to be worked off."""

from __future__ import annotations

import argparse

from solidgrain.runtime.errors import UsageError

# How a plan is worked off. Every other flag says what the plan is.
WORK = frozenset(
    (
        *("command", "source", "bundle", "provider", "threads", "overwrite", "no_clobber", "resume", "update", "shard"),
        *("plan", "jobs", "continue_on_error", "dask", "shards", "emit_openjd", "dry_run", "json", "quiet"),
    )
)
CLASHES = {
    "jobs": ("plan", "source", "bundle", "dask", "emit_openjd", "shard", "shards"),
    "dask": ("emit_openjd", "shard", "dry_run"),
    "emit_openjd": ("shard", "dry_run"),
}
NEEDS = {"shards": ("dask", "emit_openjd"), "continue_on_error": ("jobs",)}
NAMES = {"source": "SOURCE", "engine": "--for"}


def check_modes(arguments: argparse.Namespace) -> None:
    """Refuse flags that contradict each other, before anything is loaded. Raises UsageError."""
    given = [name for name, value in vars(arguments).items() if value is not None and value is not False and value != []]
    for mode in ("plan", "jobs"):
        described = [name for name in given if name not in WORK]
        if mode in given and described:
            raise UsageError(f"{_flag(mode)}: the file says what is baked; leave out {_flag(described[0])}, or edit the file")
    for mode, others in CLASHES.items():
        clash = next((other for other in others if other in given), None)
        if mode in given and clash:
            raise UsageError(f"{_flag(mode)}: does not go with {_flag(clash)}; leave one of them out")
    for name, modes in NEEDS.items():
        if name in given and not any(mode in given for mode in modes):
            raise UsageError(f"{_flag(name)}: needs {' or '.join(_flag(mode) for mode in modes)}")


def _flag(name: str) -> str:
    return NAMES.get(name, f"--{name.replace('_', '-')}")
