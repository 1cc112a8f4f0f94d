"""A plan is a file: what a bake has saved can be baked again, and what is no plan is refused in one line."""

from __future__ import annotations

import json
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from solidgrain.bake.baker import bake
from solidgrain.bake.flags import add_arguments
from solidgrain.bake.jobs import JobParser
from solidgrain.bake.modes import WORK
from solidgrain.bake.plan import Plan, hash_of, plan_from_json
from solidgrain.bake.schema import load_plan, plan_of, schema_of, seen_in
from solidgrain.bake.writers import PREVIEW, formats, make_output
from solidgrain.runtime import load_texture
from solidgrain.runtime.errors import UsageError
from tests.bake.test_writers import plan_for

SUFFIXES = {".exr": "a.####.exr", PREVIEW: "a.png"}


def random_plan(draw: random.Random) -> Plan:
    """Any plan that the flags could ask for, with numbers that are hard to print."""

    def number() -> float:
        return draw.choice([0.0, -0.0, 1.0, 5e-324, 0.1, 2.0**36, draw.uniform(-1, 1), draw.gauss(0, 1e6), -(2.0**-40)])

    def above_zero() -> float:
        return draw.choice([5e-324, 1.0, 1 / 3, draw.random() + 1e-9, 2.0**36])

    kinds = draw.sample(list(formats()), draw.randint(0, len(formats())))
    outputs = [make_output(Path(draw.choice(["", "/", "é 'x'/"])) / SUFFIXES.get(kind, f"a{kind}"), kind) for kind in kinds]
    rows = tuple(tuple(number() for _ in range(4)) for _ in range(3))
    return Plan(
        source=draw.choice(["granite", "/a b/ü.sgt.npz", "\udcff"]),
        texture=draw.choice(["granite", "", '"'] if draw.random() < 0.5 else ["石"]),
        texture_sha256=f"{draw.getrandbits(256):064x}",
        sampler_sha256=f"{draw.getrandbits(256):064x}",
        precision=draw.choice(["float32", "bfloat16"]),
        seed=draw.choice([0, 2**64 - 1, draw.getrandbits(64)]),
        size=(draw.randint(1, 2**40), 1, draw.randint(1, 9)),
        origin=(number(), number(), number()),
        spacing=(above_zero(), above_zero(), above_zero()),
        tile=draw.choice(["", "x", "yz", "xyz"]),
        outputs=tuple(outputs),
        transform=draw.choice([None, (*rows, (0.0, 0.0, 0.0, 1.0))]),
        samples=draw.choice([1, 8, 27]),
        bundle=draw.choice([None, "../b"]),
    )


def test_any_plan_comes_back_from_its_json(tmp_path):
    draw, path = random.Random(6), tmp_path / "plan.json"
    for _ in range(300):
        plan = random_plan(draw)
        assert plan_from_json(plan.to_json()) == plan
        path.write_text(json.dumps(plan.to_json()))
        assert load_plan(path) == seen_in(tmp_path, plan)


def test_the_schema_knows_each_key_of_a_plan_and_no_other(toy):
    plan = plan_for(toy, make_output(Path("a.vti"))).to_json()
    assert set(schema_of("plan")["properties"]) == set(plan)
    assert set(schema_of("plan")["$defs"]["output"]["properties"]) == set(plan["outputs"][0])


@pytest.mark.parametrize("name", ["plan", "jobs"])
def test_each_part_of_a_published_schema_says_what_it_expects(name):
    """Errors quote the descriptions."""
    import jsonschema

    jsonschema.Draft202012Validator.check_schema(schema_of(name))

    def parts(schema):
        yield schema
        for key in ("properties", "$defs"):
            for part in schema.get(key, {}).values():
                yield from parts(part) if isinstance(part, dict) else ()
        for part in (schema.get("items"), schema.get("additionalProperties"), *schema.get("prefixItems", [])):
            yield from parts(part) if isinstance(part, dict) else ()

    assert [part for part in parts(schema_of(name)) if "description" not in part and set(part) != {"$ref"}] == []


def saved(toy, tmp_path, **changes) -> tuple[Path, dict]:
    """A plan file without its hash, changed."""
    values = {**plan_for(toy, make_output(tmp_path / "a.npy")).to_json(), **changes}
    del values["hash"]
    values = {key: value for key, value in values.items() if value != "absent"}
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(values))
    return path, values


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, "plan of format 2, this solidgrain reads format 1"),
        ({"size": [4, 4]}, r"size: expected voxels along x, y and z, three whole numbers above 0, found [4, 4]"),
        ({"size": [4, 0, 4]}, r"size[1]: expected a whole number above 0, found 0"),
        ({"size": [4, True, 4]}, r"size[1]: expected a whole number above 0, found true"),
        ({"size": [4, 4.5, 4]}, r"size[1]: expected a whole number above 0, found 4.5"),
        ({"spacing": [1, 1, -1]}, r"spacing[2]: expected a number above 0, found -1"),
        ({"origin": [0, 0, "far"]}, r'origin[2]: expected a number within 2^36 of 0, found "far"'),
        ({"seed": 2**64}, "seed: expected a whole number from 0 to 2^64 - 1, found 18446744073709551616"),
        ({"seed": -1}, "seed: expected"),
        ({"tile": "zx"}, 'tile: expected the axes that repeat, some of xyz in this order, found "zx"'),
        ({"samples": 4}, "samples: expected 1, 8 or 27 samples per voxel, found 4"),
        ({"precision": "int8"}, "precision: expected float32 or bfloat16"),
        ({"texture_sha256": "abc"}, "texture_sha256: expected 64 hexadecimal digits"),
        ({"transform": [[1, 0, 0, 0]] * 4}, r"transform[3]: expected the last row, 0, 0, 0, 1"),
        ({"transform": [[1, 0, 0]] * 4}, r"transform[0]: expected four numbers"),
        ({"tile": "absent"}, "'tile' is missing, expected a plan"),
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"outputs": {}}, "outputs: expected a list of outputs, found {}"),
        ({"outputs": [{"path": "a.npy"}]}, r"outputs[0]: 'kind' is missing"),
        ({"outputs": [{"path": "a.tga", "kind": ".tga", "options": {}}]}, r"outputs[0].kind: unknown format '.tga'"),
        (
            {"outputs": [{"path": "a.vti", "kind": ".npy", "options": {}}]},
            r"outputs[0].path: expected a name that ends in .npy",
        ),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"type": "int4"}}]}, "type 'int4', expected one of uint8"),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"bits": 4}}]}, "unknown option 'bits' of vti"),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"kind": ".npy"}}]}, "unknown option 'kind' of vti"),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"path": "b.vti"}}]}, "unknown option 'path' of vti"),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"dither": "no"}}]}, "dither: expected a whole number"),
        ({"outputs": [{"path": "a.vti", "kind": ".vti", "options": {"type": []}}]}, "type: expected a text or a whole number"),
    ],
)
def test_what_is_wrong_with_a_plan_is_said_with_its_place(solidgrain, toy, tmp_path, changes, message):
    path, _ = saved(toy, tmp_path, **changes)
    outcome = solidgrain("bake", "--plan", path)
    assert outcome.code == 2
    assert outcome.error.startswith(f"solidgrain: {path}: ")
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[]", "expected a plan: an object"),
        (b"7", "expected a plan: an object"),
        (
            b'{"plan": 7}',
            "plan: expected a plan: an object with what the bytes of a bake depend on, and where they go, found 7",
        ),
        (b"\xff\xfe", "not JSON"),
        (b'{"seed": 1, "seed": 2}', "'seed' is there twice"),
        (b'{"seed": NaN}', "NaN is not a number of JSON"),
        (b"[" * 100_000, "not JSON"),
        (b'{"format_version": [1]}', "plan of format [1]"),
    ],
)
def test_a_file_that_is_no_plan_is_refused(solidgrain, tmp_path, content, message):
    path = tmp_path / "plan.json"
    path.write_bytes(content)
    outcome = solidgrain("bake", "--plan", path)
    assert outcome.code == 2
    assert message in outcome.error


def test_a_number_beyond_all_bounds_is_refused(toy, tmp_path):
    path, _ = saved(toy, tmp_path)
    path.write_text(re.sub(r'"spacing": \[1.0', '"spacing": [1e999', path.read_text()))
    with pytest.raises(UsageError, match=r"spacing\[0\]: expected a number above 0, found Infinity"):
        load_plan(path)


def test_a_missing_plan_is_a_usage_error(solidgrain, tmp_path):
    outcome = solidgrain("bake", "--plan", tmp_path / "none.json")
    assert outcome.code == 2
    assert "none.json: cannot read it (No such file" in outcome.error


def test_an_edited_plan_is_refused_until_its_hash_is_removed(solidgrain, toy, toy_folder, tmp_path):
    plan = plan_for(toy, make_output(tmp_path / "a.npy")).to_json()
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({**plan, "source": str(toy_folder), "seed": 8}))
    refused = solidgrain("bake", "--plan", path)
    assert refused.code == 2
    assert 'remove the line "hash" to accept the edit' in refused.error
    edited = json.dumps({**plan, "source": str(toy_folder), "seed": 8}, indent=1)
    path.write_text("".join(line for line in edited.splitlines(keepends=True) if '"hash"' not in line))
    assert solidgrain("bake", "--plan", path).code == 0
    grid = toy.grid(plan["size"][::-1], seed=8, origin=plan["origin"], spacing=plan["spacing"])
    assert np.array_equal(np.load(tmp_path / "a.npy"), grid)


def test_whole_numbers_in_an_edited_plan_mean_the_same_as_floats(toy, tmp_path):
    _, values = saved(toy, tmp_path)
    other = {**values, "origin": [int(number) for number in values["origin"]], "size": [7.0, 5.0, 19.0], "seed": 7.0}
    assert plan_of(other, "here").to_json() == plan_of(values, "here").to_json()
    assert plan_of({**other, "hash": hash_of(values)}, "here") == plan_of(values, "here")


def test_options_that_a_plan_does_not_mention_have_their_defaults(toy, tmp_path):
    path, _ = saved(toy, tmp_path, outputs=[{"path": "a.vti", "kind": ".vti", "options": {}}])
    assert load_plan(path).outputs == (make_output(tmp_path / "a.vti"),)


def test_a_manifest_and_a_dry_run_are_plan_files(solidgrain, toy_folder, tmp_path, monkeypatch):
    """In any working folder: paths are absolute, those in a manifest's own folder relative to it."""
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    monkeypatch.chdir(first)
    flags = ("--size", "6x5x4", "--seed", 3, "--spacing", 0.3, "--tile", "x", "--out", "a.##.exr", "--out", "a.vti")
    dry = solidgrain("bake", toy_folder, *flags, "--dry-run", "--json").out
    (tmp_path / "dry.json").write_text(dry)
    assert solidgrain("bake", toy_folder, *flags).code == 0
    shutil.copytree(first, second)
    (second / "a.03.exr").unlink()
    monkeypatch.chdir(tmp_path)
    assert solidgrain("bake", "--plan", second / "a.vti.bake.json", "--overwrite").code == 0
    for path in first.iterdir():
        assert (second / path.name).read_bytes() == path.read_bytes(), path.name
    again = solidgrain("bake", "--plan", tmp_path / "dry.json", "--overwrite", "--threads", 1, "--provider", "cpu", "--json")
    assert json.loads(again.out)["plan"] == json.loads(dry)["plan"]
    assert list(tmp_path.glob("*.vti")) == []


def test_what_was_baked_of_a_texture_beside_it_moves_with_it(solidgrain, toy_folder, tmp_path):
    (tmp_path / "before").mkdir()
    load_texture(toy_folder).save(tmp_path / "before" / "mine.sgt.npz")
    source = (tmp_path / "before" / "mine.sgt.npz", "--bundle", toy_folder)
    assert solidgrain("bake", *source, "--size", 4, "--out", tmp_path / "before" / "a.npy").code == 0
    (tmp_path / "before").rename(tmp_path / "after")
    assert solidgrain("verify", tmp_path / "after" / "a.npy").code == 0
    (tmp_path / "after" / "mine.sgt.npz").unlink()
    outcome = solidgrain("verify", tmp_path / "after" / "a.npy")
    assert outcome.code == 1
    assert "its files are whole, but not its texture" in outcome.error
    assert "say where it is with --source, or check the files alone with --voxels 0" in outcome.error
    assert solidgrain("verify", tmp_path / "after" / "a.npy", "--voxels", 0).code == 0


def test_a_plan_of_another_texture_is_refused(solidgrain, toy, toy_folder, tmp_path):
    for key in ("texture", "sampler"):
        path, _ = saved(toy, tmp_path, source=str(toy_folder), **{f"{key}_sha256": "0" * 64})
        outcome = solidgrain("bake", "--plan", path)
        assert outcome.code == 1
        assert f"--plan {path}: made with the {key} 000000000000…, {toy_folder} now has" in outcome.error
        assert list(tmp_path.iterdir()) == [path]


def test_source_says_where_the_texture_of_a_plan_lies_now(solidgrain, toy, toy_folder, tmp_path):
    path, _ = saved(toy, tmp_path, source="/moved/away")
    assert solidgrain("bake", "--plan", path).code == 1
    assert solidgrain("bake", toy_folder, "--plan", path).code == 0


def test_a_plan_bakes_in_shards_and_merges_by_its_file_or_its_output(solidgrain, toy, toy_folder, tmp_path):
    whole = bake(plan_for(toy, make_output(tmp_path / "a.npy")), toy).files[0].read_bytes()
    path, _ = saved(toy, tmp_path, source=str(toy_folder))
    for target in (path, tmp_path / "a.npy"):
        for file in tmp_path.glob("a.npy*"):
            file.unlink()
        assert "slices 0 to 18 are missing" in solidgrain("merge", path).error
        assert solidgrain("bake", "--plan", path, "--shard", "2/2").code == 0
        missing = solidgrain("merge", target)
        assert missing.code == 1
        assert "a.npy: slices 0 to 15 are missing or damaged; bake their shards first" in missing.error
        assert solidgrain("bake", "--plan", path, "--shard", "1/2").code == 0
        merged = solidgrain("merge", target, "--json", "--quiet")
        assert merged.err == ""
        assert json.loads(merged.out)["files"] == [str(tmp_path / "a.npy")]
        assert (tmp_path / "a.npy").read_bytes() == whole
        again = solidgrain("merge", target)
        assert again.code == 0
        assert "nothing to merge" in again.err
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.npy", "a.npy.bake.json", "plan.json"]


@pytest.fixture
def other_texture(toy, toy_folder, tmp_path):
    """A texture file that has neither its texture's name nor its bundle's folder."""
    folder = tmp_path / "textures"
    folder.mkdir()
    toy.save(folder / "mine.sgt.npz")
    return folder / "mine.sgt.npz"


@pytest.mark.parametrize("moved", [False, True])
def test_a_merge_by_one_output_has_all_of_the_plan(solidgrain, other_texture, toy_folder, tmp_path, monkeypatch, moved):
    """Shards are baked with relative names; the merge is called elsewhere, and the files may lie elsewhere by then."""
    for name in ("work", "work/out", "work/slices", "elsewhere"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "work")
    flags = ("bake", "../textures/mine.sgt.npz", "--bundle", toy_folder, "--size", "6x5x40")
    flags += ("--out", "out/a.vti", "--out", "out/b.npy")
    flags += () if moved else ("--out", "slices/c.###.exr")
    for share in ("1/2", "2/2"):
        assert solidgrain(*flags, "--shard", share).code == 0
    monkeypatch.chdir(tmp_path / "elsewhere")
    folder = tmp_path / "work/out"
    if moved:
        folder = folder.rename(tmp_path / "moved")
    report = json.loads(solidgrain("merge", folder / "b.npy", "--json", "--quiet").out)
    outputs = [folder / "a.vti", folder / "b.npy", *([] if moved else [tmp_path / "work/slices/c.###.exr"])]
    assert [output["path"] for output in report["plan"]["outputs"]] == [str(path) for path in outputs]
    assert len(report["files"]) == 2 + (0 if moved else 40)
    for output in outputs:
        plan = load_plan(output.with_name(f"{output.name}.bake.json"))
        assert plan.to_json() == report["plan"]
        assert Path(plan.source).samefile(other_texture)
        assert Path(plan.bundle).samefile(toy_folder)
    assert solidgrain("verify", *outputs).code == 0
    assert solidgrain("bake", "--plan", f"{outputs[0]}.bake.json", "--overwrite").code == 0
    assert sorted(path.name for path in folder.iterdir()) == ["a.vti", "a.vti.bake.json", "b.npy", "b.npy.bake.json"]


def test_merge_keeps_a_file_that_was_there_unless_told_otherwise(solidgrain, toy, toy_folder, tmp_path):
    path, _ = saved(toy, tmp_path, source=str(toy_folder))
    assert solidgrain("bake", "--plan", path, "--shard", "1/1").code == 0
    (tmp_path / "a.npy").write_text("mine")
    refused = solidgrain("merge", path)
    assert refused.code == 1
    assert "already exists" in refused.error
    assert (tmp_path / "a.npy").read_text() == "mine"
    assert solidgrain("merge", path, "--overwrite").code == 0
    assert np.load(tmp_path / "a.npy").shape == (19, 5, 7, 3)


def test_merge_refuses_what_it_cannot_find(solidgrain, tmp_path):
    outcome = solidgrain("merge", tmp_path / "a.vti")
    assert outcome.code == 2
    assert "no shard of it has been baked here" in outcome.error


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--plan", "p.json", "--size", "4"], "--plan: the file says what is baked; leave out --size"),
        (["--plan", "p.json", "--seed", "0"], "leave out --seed"),
        (["--plan", "p.json", "--out", "a.vti"], "leave out --out"),
        (["--plan", "p.json", "--preview", "a.png"], "leave out --preview"),
        (["--plan", "p.json", "--precision", "float32"], "leave out --precision"),
        (["--plan", "p.json", "--exr-start", "0"], "leave out --exr-start"),
        (["--plan", "p.json", "--for", "unity"], "leave out --for"),
        (["--jobs", "j.json", "--size", "4"], "--jobs: the file says what is baked; leave out --size"),
        (["--jobs", "j.json", "--plan", "p.json"], "--jobs: does not go with --plan"),
        (["granite", "--jobs", "j.json"], "--jobs: does not go with SOURCE"),
        (["--jobs", "j.json", "--shard", "1/2"], "--jobs: does not go with --shard"),
        (["--jobs", "j.json", "--dask", "local:2"], "--jobs: does not go with --dask"),
        (["--jobs", "j.json", "--emit-openjd", "d"], "--jobs: does not go with --emit-openjd"),
        (["--dask", "local:2", "--shard", "1/2"], "--dask: does not go with --shard"),
        (["--dask", "local:2", "--emit-openjd", "d"], "--dask: does not go with --emit-openjd"),
        (["--dask", "local:2", "--dry-run"], "--dask: does not go with --dry-run"),
        (["--emit-openjd", "d", "--shard", "1/2"], "--emit-openjd: does not go with --shard"),
        (["--emit-openjd", "d", "--dry-run"], "--emit-openjd: does not go with --dry-run"),
        (["--shards", "4"], "--shards: needs --dask or --emit-openjd"),
        (["--continue-on-error"], "--continue-on-error: needs --jobs"),
        (["--shards", "0", "--dask", "local:2"], "--shards: expected a whole number above 0"),
        (["--dask", "local:0"], "expected local:N or a scheduler such as tcp://host:8786, found 'local:0'"),
        (["--dask", "local:"], "--dask: expected local:N"),
        (["--dask", "host"], "--dask: expected local:N"),
        (["--dask", "tcp://host:x"], "--dask: expected local:N"),
    ],
)
def test_flags_that_do_not_go_together_are_refused_before_anything_is_loaded(solidgrain, tmp_path, monkeypatch, flags, message):
    monkeypatch.chdir(tmp_path)
    outcome = solidgrain("bake", *flags)
    assert outcome.code == 2
    assert message in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_every_flag_that_is_no_work_describes_a_plan():
    """A new flag for the work must be named in modes.WORK, or --plan refuses it."""
    import argparse

    parser = argparse.ArgumentParser(add_help=False)
    add_arguments(parser)
    flags = vars(parser.parse_args([]))
    assert set(flags) >= WORK - {"command"}
    assert {"size", "origin", "out", "preview", "precision", "exr_start"} <= set(flags) - WORK
    assert not set(JobParser().keys) & WORK
    assert [name for name, value in flags.items() if name not in WORK and value not in (None, False, [])] == []
