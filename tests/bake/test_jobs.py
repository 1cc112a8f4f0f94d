"""`--jobs`: many bakes from one file, all checked before the first begins."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from solidgrain.bake.flags import make_outputs
from solidgrain.bake.jobs import read_jobs, with_settings
from solidgrain.bake.writers import Output
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import load_texture
from solidgrain.runtime.bundle import embedded_folder
from tests.toy import toy_weights

TINY = {"size": [6, 5, 4]}


@pytest.fixture
def write_jobs(tmp_path, toy_folder):
    """A job file in a folder of its own, whose jobs bake the toy texture."""
    (tmp_path / "show").mkdir()

    def write(*jobs: dict, **defaults: object) -> Path:
        path = tmp_path / "show" / "jobs.json"
        path.write_text(json.dumps({"defaults": {"texture": str(toy_folder), **TINY, **defaults}, "jobs": list(jobs)}))
        return path

    return write


def statuses(outcome) -> dict[str, str]:
    return {job["name"]: job["status"] for job in json.loads(outcome.out)["jobs"]}


def test_each_job_bakes_what_its_keys_say(solidgrain, write_jobs, toy, tmp_path, monkeypatch):
    """Relative paths are relative to the job file's folder, wherever the command runs."""
    monkeypatch.chdir(tmp_path)
    path = write_jobs(
        {"name": "plain", "out": "plain.npy"},
        {"name": "placed", "out": ["placed.npy"], "seed": 2**64 - 1, "origin": [1e9, -5, 0.5], "spacing": 0.25, "size": 3},
        {"name": "tiled", "out": {"path": "tiled.npy"}, "tile": "yx", "size": [9, 8, 7], "preview": "tiled.png"},
        {
            "name": "turned",
            "out": "turned.npy",
            "transform": [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "pixel_size": 0.5,
            "box": [0, 0, 0, 3, 2.5, 2],
        },
    )
    outcome = solidgrain("bake", "--jobs", path, "--json", "--quiet")
    assert outcome.code == 0
    assert outcome.err == ""
    report = json.loads(outcome.out)["jobs"]
    assert [job["status"] for job in report] == ["done"] * 4
    assert [Path(file).name for file in report[2]["files"]] == ["tiled.npy", "tiled.png"]
    assert all(job["seconds"] > 0 and job["error"] is None for job in report)
    grids = {
        "plain": toy.grid((4, 5, 6)),
        "placed": toy.grid((3, 3, 3), 2**64 - 1, origin=(1e9, -5, 0.5), spacing=0.25),
        "tiled": toy.grid((7, 8, 9), tile="xy"),
        "turned": toy.grid((4, 5, 6), transform=[[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    }
    for name, grid in grids.items():
        assert np.array_equal(np.load(tmp_path / "show" / f"{name}.npy"), grid), name


def test_toml_says_the_same_as_json(solidgrain, tmp_path, toy, toy_folder):
    (tmp_path / "jobs.toml").write_text(
        f"""
        [defaults]
        texture = {json.dumps(str(toy_folder))}
        size = [6, 5, 4]
        [[jobs]]
        name = "floor"
        seed = 3
        out = ["floor.npy", {{path = "floor.vti", type = "float32"}}]
        """
    )
    assert solidgrain("bake", "--jobs", tmp_path / "jobs.toml").code == 0
    assert np.array_equal(np.load(tmp_path / "floor.npy"), toy.grid((4, 5, 6), 3))
    assert b"Float32" in (tmp_path / "floor.vti").read_bytes()


def outputs_of(path: Path) -> list[Output]:
    from argparse import Namespace

    (job,) = read_jobs(path, Namespace(provider="auto"))
    return [with_settings(output, job) for output in make_outputs(job.arguments)]


def test_a_setting_holds_for_all_outputs_of_its_format_and_an_outputs_own_comes_first(write_jobs):
    outs = ["a.####.exr", {"path": "b.####.exr", "compression": "none"}, {"path": "c.vti", "dither": 1}]
    found = outputs_of(write_jobs({"name": "a", "out": outs, "exr_start": 0}, exr_compression="piz", exr_type="float"))
    assert [(output.options.get("compression"), output.options.get("start")) for output in found[:2]] == [
        ("piz", 0),
        ("none", 0),
    ]
    assert found[0].options["type"] == "float"
    assert (found[2].options["type"], found[2].options["dither"]) == ("uint8", 1)


def test_defaults_are_for_the_jobs_that_have_a_use_for_them(solidgrain, write_jobs):
    path = write_jobs({"name": "a", "out": "a.vti"}, {"name": "b", "out": ["b.####.exr"]}, exr_compression="piz")
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    preview = {"name": "a", "preview": "a.png"}
    path = write_jobs(preview, mips=True, mip_filter="box", colorspace="ACEScg", dither=True, **{"for": "unity"})
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    lengths = {"mips": True, "mip_filter": "kaiser", "patch_scale": 2, "box": [0, 0, 0, 3, 3, 3]}
    path = write_jobs({"name": "c", "out": "c.vti", "mips": False, "spacing": 2}, {"name": "d", "out": "d.vti"}, **lengths)
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    assert (path.parent / "d.mip1.vti").exists()
    assert not (path.parent / "c.mip1.vti").exists()
    path = write_jobs({"name": "a", "out": "a.vti", "exr_compression": "piz"})
    assert "jobs[0] 'a': exr_compression: no out of this format; leave it out" in solidgrain("bake", "--jobs", path).error


@pytest.mark.parametrize(
    ("job", "message"),
    [
        ({"out": "a.vti", "mips": "kaiser"}, 'mips: expected true or false, found "kaiser"'),
        ({"out": "a.vti", "dither": 1}, "dither: expected true or false, found 1"),
        ({"out": "a.vti", "vti_type": False}, "vti_type: expected a value, found false"),
        ({"out": "a.vti", "colorspace": False}, "colorspace: expected a value, found false"),
        ({"out": {"path": "a.vti", "mips": True}}, "mips: expected a text, found true"),
        ({"out": "a.####.exr", "dither": True}, "dither: no out of whole numbers; leave it out"),
        ({"out": {"path": "a.exr"}, "size": [4, 4, 1], "exr_start": 5}, "exr_start 5: a.exr has no frame number; leave it out"),
        ({"out": "a.####.exr", "exr_channels": "\x07=r"}, "exr_channels '\\x07=r': expected NAME=SOURCE"),
        ({"out": "a.vti", "colorspace": "\x07"}, "colorspace '\\x07': expected printable characters"),
    ],
)
def test_a_value_that_makes_no_sense_is_shown_as_it_was_given(solidgrain, write_jobs, job, message):
    outcome = solidgrain("bake", "--jobs", write_jobs({"name": "a", **job}))
    assert (outcome.code, message in outcome.error) == (2, True), outcome.error


def test_an_outputs_own_engine_turns_its_axes(solidgrain, write_jobs, tmp_path):
    own = [{"name": key, "out": {"path": f"{key}.atlas.png", key: "unity"}} for key in ("engine", "for")]
    path = write_jobs(*own, {"name": "b", "out": "b.atlas.png", "for": "unity"}, size=8)
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    axes = [json.loads((tmp_path / "show" / f"{name}.atlas.json").read_text())["axes"] for name in ("engine", "for", "b")]
    assert axes == ["+x-z+y"] * 3
    path = write_jobs({"name": "a", "out": {"path": "a.dds", "engine": "unitee"}})
    assert "unknown engine; pick one of unreal, unity, godot" in solidgrain("bake", "--jobs", path).error


def test_an_outputs_own_type_has_the_colours_of_that_type(write_jobs):
    """A header of half floats cannot say sRGB, and linear bytes would be banded, unless someone asks for it."""
    half, whole = {"path": "half.dds", "type": "rgba16f"}, {"path": "whole.dds", "type": "rgba8"}
    (own,) = outputs_of(write_jobs({"name": "a", "out": half}))
    (flagged,) = outputs_of(write_jobs({"name": "a", "out": "half.dds", "dds_type": "rgba16f"}))
    assert own.options == flagged.options
    assert own.colorspace == "lin_rec709_scene"
    (back,) = outputs_of(write_jobs({"name": "a", "out": whole, "dds_type": "rgba16f"}))
    assert back.colorspace == "srgb_rec709_scene"
    (asked,) = outputs_of(write_jobs({"name": "a", "out": half, "colorspace": "srgb_rec709_scene"}))
    assert asked.colorspace == "srgb_rec709_scene"


def test_an_output_may_be_for_no_engine(write_jobs):
    (plain,) = outputs_of(write_jobs({"name": "a", "out": {"path": "a.dds", "for": ""}, "for": "unity"}))
    assert (plain.options["engine"], plain.options["axes"]) == ("", "+x+y+z")


def test_whole_numbers_of_an_output_may_be_written_as_json_may(write_jobs):
    (own,) = outputs_of(write_jobs({"name": "a", "out": {"path": "a.####.exr", "start": 5.0}}))
    assert own.options["start"] == 5
    (dithered,) = outputs_of(write_jobs({"name": "a", "out": {"path": "a.vti", "dither": True}}))
    assert dithered.options["dither"] == 1


def test_dither_is_for_whole_numbers_and_changes_no_other_plan(write_jobs):
    outs = ["a.####.exr", {"path": "b.vti", "type": "float32"}, {"path": "c.dds", "type": "bc7"}, "d.vti", "e.atlas.png"]
    found = outputs_of(write_jobs({"name": "a", "out": outs, "dither": True}))
    assert [output.options["dither"] for output in found] == [0, 0, 1, 1, 1]
    (own,) = outputs_of(
        write_jobs({"name": "a", "out": {"path": "a.vti", "type": "uint8"}, "dither": True, "vti_type": "float32"})
    )
    assert own.options["dither"] == 1


def test_flags_about_the_work_are_for_the_command_line(solidgrain, write_jobs):
    path = write_jobs({"name": "a", "out": "a.npy", "threads": 1})
    assert "how all jobs are worked off is said beside --jobs, by --threads" in solidgrain("bake", "--jobs", path).error


def test_whole_numbers_may_be_written_as_floats(solidgrain, write_jobs, tmp_path):
    path = write_jobs({"name": "a", "out": "a.npy"}, size=4.0, seed=7.0)
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    assert np.load(tmp_path / "show" / "a.npy").shape == (4, 4, 4, 3)


def test_a_switch_is_true_or_false(write_jobs):
    (on,) = outputs_of(write_jobs({"name": "a", "out": "a.####.exr", "mips": True, "mip_filter": "kaiser"}))
    (off,) = outputs_of(write_jobs({"name": "a", "out": "a.####.exr", "mips": False}))
    assert (on.options["mips"], off.options["mips"]) == ("kaiser", "")


@pytest.mark.parametrize(
    ("job", "message"),
    [
        ({"size": [4, 4]}, "jobs[0].size: expected a whole number above 0, or three of them for x, y and z, found [4, 4]"),
        ({"size": 0}, "jobs[0].size: expected a whole number above 0"),
        ({"size": [1, 2, 0]}, "jobs[0].size[2]: expected a whole number above 0, found 0"),
        ({"seed": -1}, "jobs[0].seed: expected a whole number from 0 to 2^64 - 1, found -1"),
        ({"seed": "7"}, 'jobs[0].seed: expected a whole number from 0 to 2^64 - 1, found "7"'),
        ({"origin": [1e300, 0, 0]}, "jobs[0].origin[0]: expected a number within 2^36 of 0, found 1e+300"),
        ({"spacing": 0}, "jobs[0].spacing: expected a number above 0, or three of them for x, y and z, found 0"),
        ({"origin": [1, 2]}, "jobs[0].origin: expected three numbers"),
        ({"tile": "xw"}, "jobs[0] 'a': tile: expected each of x, y, z at most once, found 'xw'"),
        ({"box": [0, 0, 0, 1, 1, 0]}, "jobs[0] 'a': box: expected X,Y,Z,X,Y,Z"),
        ({"box": [0, 0, 0, 1, 1, 1], "origin": [0, 0, 0]}, "jobs[0] 'a': box: says where the grid is already"),
        ({"transform": [[1, 2], [3]]}, "jobs[0].transform: expected four rows of four numbers"),
        ({"exr_compression": "lzma"}, "jobs[0] 'a': exr_compression: invalid choice: 'lzma'"),
        ({"exr_start": -1}, "jobs[0] 'a': exr_start: expected a whole number, 0 or more, found '-1'"),
        ({"exr_compressoin": "zip"}, "jobs[0] 'a': unknown key 'exr_compressoin'; did you mean exr_compression?"),
        ({"spacnig": 2}, "unknown key 'spacnig'; did you mean spacing?"),
        ({"threads": 2}, "jobs[0] 'a': unknown key 'threads'"),
        ({"plan": "other.json"}, "unknown key 'plan'"),
        ({"quiet": True}, "unknown key 'quiet'"),
        ({"size\n--quiet": 4}, "unknown key 'size\\n--quiet'"),
        ({"out": []}, "jobs[0] 'a': nothing to write: give it out or preview"),
        ({"out": 7}, "jobs[0].out: expected a file name, an object with path and settings, or a list of those, found 7"),
        ({"out": [{"type": "half"}]}, "jobs[0].out: expected a file name"),
        ({"out": ["a.npy", "./a.npy"]}, "out: two outputs have the same name"),
        ({"out": "a.tga"}, "jobs[0] 'a': out a.tga: unknown format '.tga'"),
        ({"out": {"path": "a.vti", "type": "int4"}}, "show/a.vti: type 'int4', expected one of uint8"),
        ({"out": {"path": "a.vti", "bits": 4}}, "unknown option 'bits' of vti"),
        ({"out": {"path": "a.vti", "kind": ".npy"}}, "unknown option 'kind' of vti"),
        ({"out": {"path": "a.vti", "where": "here"}}, "unknown option 'where' of vti"),
        ({"out": {"path": "a.vti", "output": 1}}, "unknown option 'output' of vti"),
        ({"out": {"path": "a.vti", "dither": "on"}}, 'out a.vti.dither: expected a whole number, found "on"'),
        ({"preview": "a.jpg"}, "ends in .png"),
        ({"name": ""}, "jobs[0].name: expected a name of its own"),
        ({"texture": ""}, "jobs[0].texture: expected an embedded name"),
    ],
)
def test_a_job_that_cannot_be_is_a_usage_error_with_its_place(solidgrain, write_jobs, tmp_path, monkeypatch, job, message):
    monkeypatch.chdir(tmp_path)
    path = write_jobs({"name": "a", "out": "a.npy", **job}).relative_to(tmp_path)
    outcome = solidgrain("bake", "--jobs", path)
    assert outcome.code == 2
    assert outcome.error.startswith("solidgrain: show/jobs.json: ")
    assert message in outcome.error
    assert [file.name for file in path.parent.iterdir()] == ["jobs.json"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("jobs.json", "{}", "'jobs' is missing, expected a job file"),
        ("jobs.json", '{"jobs": []}', "jobs: expected a list of at least one job, found []"),
        ("jobs.json", '{"jobs": [{}]}', "jobs[0]: 'name' is missing, expected a job"),
        ("jobs.json", '{"jobs": [4]}', "jobs[0]: expected an object with settings"),
        (
            "jobs.json",
            '{"jobs": [{"name": "a", "out": "a.npy"}], "job": 1}',
            "unknown key 'job', expected some of defaults, jobs",
        ),
        (
            "jobs.json",
            '{"defaults": {"out": "a.npy"}, "jobs": [{"name": "a"}]}',
            "defaults.out: expected nothing, because it differs",
        ),
        ("jobs.json", "jobs = 1", "not JSON"),
        ("jobs.toml", "{}", "not TOML"),
        ("jobs.toml", "[[jobs]]\nname = 2024-01-01", 'jobs[0].name: expected a name of its own, found "2024-01-01"'),
        ("jobs.toml", '[[jobs]]\nname = "a"\nspacing = nan\nout = "a.npy"', "spacing: expected X,Y,Z"),
        ("jobs.json", '{"jobs": [{"name": "a", "out": "a.npy"}, {"name": "a", "out": "b.npy"}]}', "another job has this name"),
    ],
)
def test_a_file_that_is_no_job_file_is_refused(solidgrain, tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    outcome = solidgrain("bake", "--jobs", tmp_path / name)
    assert outcome.code == 2
    assert message in outcome.error


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"out": "missing/b.npy"}, "missing does not exist"),
        ({"texture": "granit"}, "did you mean granite"),
        ({"size": [10**6, 10**6, 1]}, "memory"),
        ({"out": "b.####.exr", "size": [4, 4, 10**9]}, "memory"),
    ],
)
def test_one_bad_job_keeps_all_others_from_beginning(solidgrain, write_jobs, bad, message):
    path = write_jobs({"name": "a", "out": "a.npy"}, {"name": "b", "out": "b.npy", **bad})
    outcome = solidgrain("bake", "--jobs", path)
    assert outcome.code == 1
    assert f"{path}: jobs[1] 'b': " in outcome.error
    assert message in outcome.error
    assert [file.name for file in path.parent.iterdir()] == ["jobs.json"]


@pytest.mark.parametrize(
    ("first", "second", "culprit"),
    [
        ("a.npy", "./a.npy", "a.npy"),
        ("a.npy", "../show/a.npy", "a.npy"),
        ("a.##.exr", "a.%02d.exr", "a.01.exr"),
    ],
)
def test_two_jobs_that_write_the_same_file_are_refused(solidgrain, write_jobs, first, second, culprit):
    path = write_jobs({"name": "one", "out": first}, {"name": "two", "out": second})
    outcome = solidgrain("bake", "--jobs", path)
    assert outcome.code == 2
    assert f"jobs[1] 'two': would write {path.parent / culprit}, as job 'one' does" in outcome.error
    assert [file.name for file in path.parent.iterdir()] == ["jobs.json"]


@pytest.fixture
def failing(tmp_path):
    """A texture that returns NaN: its job fails while it is baked."""
    weights = toy_weights()
    weights.weights[2][0, 0] = np.nan
    return write_bundle(tmp_path / "nan", weights, Details(name="nan", patch=64))


def test_the_first_failure_ends_the_work_unless_told_to_go_on(solidgrain, write_jobs, failing):
    jobs = [{"name": name, "out": f"{name}.npy"} for name in "abc"]
    jobs[1]["texture"] = str(failing)
    path = write_jobs(*jobs)
    stopped = solidgrain("bake", "--jobs", path, "--json", "--quiet")
    assert stopped.code == 1
    assert statuses(stopped) == {"a": "done", "b": "failed", "c": "skipped"}
    assert f"{path}: jobs[1] 'b': nan: the sampler returned NaN" in stopped.error
    report = json.loads(stopped.out)["jobs"]
    assert report[1]["error"] in stopped.error
    assert report[2]["note"] == "a job before it failed"
    assert sorted(file.name for file in path.parent.iterdir()) == ["a.npy", "a.npy.bake.json", "jobs.json"]
    went_on = solidgrain("bake", "--jobs", path, "--json", "--quiet", "--update", "--continue-on-error")
    assert went_on.code == 1
    assert statuses(went_on) == {"a": "skipped", "b": "failed", "c": "done"}
    assert json.loads(went_on.out)["jobs"][0]["note"] == "its files are there"


def test_a_texture_is_loaded_once_for_all_its_jobs(solidgrain, write_jobs, toy_folder, monkeypatch):
    from solidgrain.bake.commands import bake

    loaded = []
    load = bake.load_texture
    monkeypatch.setattr(bake, "load_texture", lambda arguments: loaded.append(arguments.source) or load(arguments))
    path = write_jobs(
        {"name": "a", "out": "a.npy"},
        {"name": "b", "out": "b.npy", "precision": "float32"},
        {"name": "c", "out": "c.npy", "texture": "granite"},
    )
    assert solidgrain("bake", "--jobs", path, "--quiet").code == 0
    assert loaded == [str(toy_folder), "granite"]


def test_textures_and_bundles_are_found_from_the_job_files_folder(
    solidgrain, write_jobs, toy, toy_folder, tmp_path, monkeypatch
):
    monkeypatch.chdir("/")
    toy.save(tmp_path / "show" / "mine.sgt.npz")
    (tmp_path / "toy").symlink_to(toy_folder)
    path = write_jobs(
        {"name": "a", "out": "a.npy", "texture": "mine.sgt.npz", "bundle": "../toy"},
        {"name": "b", "out": "b.npy", "texture": "../toy"},
    )
    assert solidgrain("bake", "--jobs", path).code == 0
    for name in "ab":
        assert np.array_equal(np.load(tmp_path / "show" / f"{name}.npy"), toy.grid((4, 5, 6)))


def test_the_working_folder_does_not_say_which_texture_a_job_is_of(
    solidgrain, write_jobs, toy, toy_folder, tmp_path, monkeypatch
):
    (tmp_path / "granite").symlink_to(toy_folder)
    monkeypatch.chdir(tmp_path)
    path = write_jobs({"name": "a", "out": "a.npy", "texture": "granite"})
    assert solidgrain("bake", "--jobs", path).code == 0
    assert np.array_equal(np.load(tmp_path / "show" / "a.npy"), load_texture(embedded_folder("granite")).grid((4, 5, 6)))
    (tmp_path / "show" / "granite").symlink_to(toy_folder)
    assert solidgrain("bake", "--jobs", path, "--overwrite").code == 0
    assert np.array_equal(np.load(tmp_path / "show" / "a.npy"), toy.grid((4, 5, 6)))


def test_flags_of_the_work_hold_for_all_jobs(solidgrain, write_jobs):
    path = write_jobs({"name": "a", "out": "a.npy"}, {"name": "b", "out": "b.npy"})
    (path.parent / "a.npy").write_text("mine")
    assert "a.npy: already exists" in solidgrain("bake", "--jobs", path).error
    kept = solidgrain("bake", "--jobs", path, "--no-clobber", "--json")
    assert kept.code == 0
    assert statuses(kept) == {"a": "skipped", "b": "done"}
    assert (path.parent / "a.npy").read_text() == "mine"
    assert statuses(solidgrain("bake", "--jobs", path, "--overwrite", "--json", "--threads", 1)) == {"a": "done", "b": "done"}
    assert statuses(solidgrain("bake", "--jobs", path, "--resume", "--json")) == {"a": "skipped", "b": "skipped"}


def test_a_dry_run_tells_of_every_job_and_writes_nothing(solidgrain, write_jobs):
    path = write_jobs({"name": "a", "out": "a.npy"}, {"name": "b", "out": "b.vti", "seed": 9})
    report = json.loads(solidgrain("bake", "--jobs", path, "--dry-run", "--json").out)["jobs"]
    assert [(job["name"], job["plan"]["seed"]) for job in report] == [("a", 0), ("b", 9)]
    assert solidgrain("bake", "--jobs", path, "--dry-run").out.count("memory") == 2
    assert [file.name for file in path.parent.iterdir()] == ["jobs.json"]


def test_all_jobs_together_must_fit_on_the_disk(solidgrain, write_jobs, monkeypatch):
    """Each fits, two do not."""
    first, second = ({"name": name, "size": 16, "out": f"{name}.npy"} for name in "ab")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=80_000))
    outcome = solidgrain("bake", "--jobs", write_jobs(first, second))
    assert (outcome.code, "all 2 jobs need up to" in outcome.error) == (1, True)
    assert solidgrain("bake", "--jobs", write_jobs(first)).code == 0
