"""Plans and job files from outside: read strictly, held against their JSON Schema, refused in one line.

The schemas (JSON Schema 2020-12) are published beside this module, in `schemas/`. Each part of them has a description: it is
what an error says was expected.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from solidgrain.bake.plan import FORMAT_VERSION, Plan, is_there, plan_from_json
from solidgrain.bake.writers import PREVIEW, Output, formats, make_output
from solidgrain.runtime.errors import UsageError

LONGEST = 60  # characters of a value that an error shows


def load_plan(path: Path) -> Plan:
    """The plan of a file: a plan by itself, or what a manifest, a dry run or a report of `solidgrain bake` has as "plan".

    Its relative paths are relative to the file's folder. Raises UsageError for what is no plan, is one of another version, or
    was edited without dropping its hash.
    """
    values = read_data(path)
    if isinstance(values, dict) and "plan" in values:
        return seen_in(path.parent, plan_of(values["plan"], str(path), "plan"))
    return seen_in(path.parent, plan_of(values, str(path)))


def seen_in(folder: Path, plan: Plan) -> Plan:
    """A plan from a file in this folder, by absolute paths: of its outputs, and of a texture or bundle that lies there."""
    from solidgrain.runtime.bundle import embedded_bundles

    def here(source: str) -> str:
        path = (folder / source).absolute()
        return str(path) if source not in embedded_bundles() and is_there(path) else source

    outputs = (replace(output, path=(folder / output.path).absolute()) for output in plan.outputs)
    return replace(plan, outputs=tuple(outputs), source=here(plan.source), bundle=plan.bundle and here(plan.bundle))


def plan_of(values: Any, where: str, place: str = "") -> Plan:
    """The plan that plain data describes; `where` and `place` are its file and where in it, for errors. Raises UsageError."""
    if isinstance(values, dict) and values.get("format_version", FORMAT_VERSION) != FORMAT_VERSION:
        raise UsageError(
            f"{where}: {place or 'plan'} of format {_shown(values['format_version'])}, this solidgrain reads format "
            f"{FORMAT_VERSION}; use the version that wrote it, or make the plan anew"
        )
    validate(values, "plan", where, place)
    plan = plan_from_json(_normal(values))
    if values.get("hash", plan.to_json()["hash"]) != plan.to_json()["hash"]:
        raise UsageError(f'{where}: the plan was edited, it no longer has its hash; remove the line "hash" to accept the edit')
    outputs = (checked_output(output, f"{where}: {_join(place, f'outputs[{k}]')}") for k, output in enumerate(plan.outputs))
    return replace(plan, outputs=tuple(outputs))


def whole(value: Any) -> Any:
    """Neither JSON's 5.0 nor its true is more than a whole number here."""
    return int(value) if isinstance(value, bool) or (isinstance(value, float) and value.is_integer()) else value


def _normal(values: dict[str, Any]) -> dict[str, Any]:
    """JSON does not tell 1 from 1.0: whole numbers where the plan has such, floats elsewhere."""
    normal = dict(values)
    for key in ("origin", "spacing"):
        normal[key] = [float(number) for number in values[key]]
    if values.get("transform"):
        normal["transform"] = [[float(number) for number in row] for row in values["transform"]]
    normal["size"] = [int(extent) for extent in values["size"]]
    return normal | {key: int(values[key]) for key in ("seed", "samples") if key in values}


def checked_output(output: Output, where: str, /, **options: str | int) -> Output:
    """An output with options on top, if its format knows them all. Missing ones get their defaults. Raises UsageError."""
    if output.kind not in formats():
        raise UsageError(f"{where}.kind: unknown format {output.kind!r}, expected one of {', '.join(formats())}")
    suffix = ".png" if output.kind == PREVIEW else output.kind
    if not output.path.name.lower().endswith(suffix):
        raise UsageError(f"{where}.path: expected a name that ends in {suffix}, found {_shown(str(output.path))}")
    given = {**output.options, **options}
    options = {key: whole(value) for key, value in given.items()}
    known = make_output(output.path, output.kind)
    for name in sorted(set(options) & set(known.options)):
        expected = type(known.options[name])
        if not isinstance(options[name], expected):
            kind = "a whole number" if expected is int else "a text"
            raise UsageError(f"{where}.{name}: expected {kind}, found {_shown(given[name])}")
    try:
        return make_output(output.path, output.kind, **options)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def read_data(path: Path) -> Any:
    """A JSON file, or a TOML file by its suffix, as plain data. Raises UsageError if it cannot be read or is ambiguous."""
    try:
        content = path.read_bytes()
        if path.suffix.lower() == ".toml":
            return tomllib.loads(content.decode())
        values = json.loads(content, parse_constant=_refuse_constant, object_pairs_hook=_without_repeats)
        json.dumps(values, ensure_ascii=False).encode(errors="surrogateescape")  # refuses what no file name can have
        return values
    except OSError as error:
        raise UsageError(f"{path}: cannot read it ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        kind = "TOML" if path.suffix.lower() == ".toml" else "JSON"
        raise UsageError(f"{path}: not {kind} ({error})") from error


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number of JSON")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is there twice")
    return values


def validate(values: Any, schema: str, where: str, place: str = "") -> None:
    """Hold plain data against a schema. Raises UsageError for the first thing that is wrong: where, expected, found."""
    error = next(iter(_validator(schema).iter_errors(values)), None)
    if error is None:
        return
    found_in = _join(place, _path(error.absolute_path))
    at = f"{where}: {found_in}" if found_in else where
    if error.validator == "required":
        missing = next(key for key in error.validator_value if key not in error.instance)
        raise UsageError(f"{at}: {missing!r} is missing, expected {error.schema['description']}")
    if error.validator == "additionalProperties":
        unknown = next(key for key in error.instance if key not in error.schema["properties"])
        raise UsageError(f"{at}: unknown key {unknown!r}, expected some of {', '.join(error.schema['properties'])}")
    raise UsageError(f"{at}: expected {error.schema['description']}, found {_shown(error.instance)}")


@cache
def _validator(schema: str) -> Any:
    import jsonschema

    return jsonschema.Draft202012Validator(schema_of(schema))


def schema_of(name: str) -> Mapping[str, Any]:
    """A published schema, "plan" or "jobs"."""
    path = Path(__file__).with_name("schemas") / f"{name}.schema.json"
    values: dict[str, Any] = json.loads(path.read_bytes())
    return values


def _path(parts: Iterable[str | int]) -> str:
    """jobs[0].size"""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")


def _join(place: str, inner: str) -> str:
    return f"{place}{'.' if place and inner and not inner.startswith('[') else ''}{inner}"


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"
