"""`--emit-openjd`: a job that Open Job Description's own tools accept and run."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from solidgrain.bake.farm import anywhere, shard_count
from solidgrain.bake.openjd import template
from solidgrain.bake.plan import Plan
from solidgrain.bake.schema import load_plan
from solidgrain.bake.writers import make_output
from tests.bake.test_writers import plan_for

FLAGS = ("--size", "9x5x67", "--seed", 7, "--origin", "10,-20,1000", "--spacing", 0.7, "--tile", "y")
BIN = Path(sys.executable).parent


def openjd(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command of the package openjd-cli, with solidgrain on the PATH."""
    if not (BIN / "solidgrain").exists() or not (BIN / "openjd").exists():
        pytest.skip("solidgrain and openjd-cli are not installed as commands beside this Python")
    command = [str(BIN / "openjd"), *map(str, arguments)]
    environment = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture
def emitted(solidgrain, toy_folder, tmp_path, monkeypatch):
    """A job with four shards for two outputs, emitted with relative paths."""
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    outputs = ("--out", "a.###.exr", "--out", "a.vti", "--vti-compression", "zlib")
    outcome = solidgrain("bake", toy_folder, *FLAGS, *outputs, "--emit-openjd", tmp_path / "job", "--shards", 4, "--json")
    assert outcome.code == 0
    assert json.loads(outcome.out)["files"] == [str(tmp_path / "job" / name) for name in ("job.json", "plan.json")]
    assert list((tmp_path / "out").iterdir()) == []
    monkeypatch.chdir("/")
    return tmp_path / "job"


def test_the_template_is_accepted(emitted):
    checked = openjd("check", emitted / "job.json", "--output", "json")
    assert checked.returncode == 0, checked.stdout
    assert json.loads(checked.stdout)["status"] == "success"
    summary = json.loads(openjd("summary", emitted / "job.json", "--output", "json").stdout)
    assert summary["total_steps"] == 2
    assert [step["total_tasks"] for step in summary["steps"]] == [4, 1]


def test_the_plan_of_a_job_holds_in_any_working_folder(emitted):
    plan = load_plan(emitted / "plan.json")
    assert [output.path for output in plan.outputs] == [emitted.parent / "out" / name for name in ("a.###.exr", "a.vti")]
    assert Path(plan.source).is_absolute()


def test_the_job_makes_the_same_files_as_a_bake(emitted, solidgrain, toy_folder, tmp_path, monkeypatch):
    run = openjd("run", emitted / "job.json", "--step", "Merge", "--run-dependencies")
    assert run.returncode == 0, run.stdout
    (tmp_path / "whole").mkdir()
    monkeypatch.chdir(tmp_path / "whole")
    outputs = ("--out", "a.###.exr", "--out", "a.vti", "--vti-compression", "zlib")
    assert solidgrain("bake", toy_folder, *FLAGS, *outputs).code == 0
    names = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    assert len(names) == 67 + 1 + 2
    for name in names:
        if not name.endswith(".bake.json"):  # they say where the files lie
            assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def test_a_task_that_fails_fails_the_job(emitted):
    shutil.rmtree(emitted.parent / "out")
    run = openjd("run", emitted / "job.json", "--step", "Bake")
    assert run.returncode != 0
    assert "does not exist" in run.stdout


def test_a_merge_without_its_shards_fails_the_job(emitted):
    run = openjd("run", emitted / "job.json", "--step", "Merge")
    assert run.returncode != 0
    assert "slices 0 to 66 are missing" in run.stdout


def test_an_emitted_job_is_kept_unless_told_otherwise(solidgrain, toy_folder, tmp_path):
    flags = ("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--emit-openjd", tmp_path / "job")
    assert solidgrain(*flags).code == 0
    refused = solidgrain(*flags)
    assert refused.code == 1
    assert f"{tmp_path / 'job' / 'job.json'}: already exists" in refused.error
    assert solidgrain(*flags, "--overwrite", "--provider", "cpu", "--threads", 2).code == 0
    bake, merge = json.loads((tmp_path / "job" / "job.json").read_text())["steps"]
    words = bake["script"]["actions"]["onRun"]["args"]
    assert words[-6:] == ["--provider", "cpu", "--threads", "2", "--overwrite", "--quiet"]
    assert merge["script"]["actions"]["onRun"]["args"] == ["merge", "{{Param.Plan}}", "--threads", "2", "--overwrite"]


def test_an_update_of_what_is_whole_is_emitted_all_the_same(solidgrain, toy_folder, tmp_path):
    flags = ("bake", toy_folder, "--size", 4, "--out", tmp_path / "a.npy", "--update")
    assert solidgrain(*flags).code == 0
    assert solidgrain(*flags, "--emit-openjd", tmp_path / "job").code == 0
    assert len(load_plan(tmp_path / "job" / "plan.json").outputs) == 1


def test_what_a_bake_would_refuse_is_not_emitted(solidgrain, toy_folder, tmp_path):
    for output, folder, message in (
        ("missing/a.npy", "job", "does not exist"),
        ("a.npy", "missing/job", "--emit-openjd"),
    ):
        outcome = solidgrain("bake", toy_folder, "--out", tmp_path / output, "--emit-openjd", tmp_path / folder)
        assert outcome.code == 1
        assert message in outcome.error
        assert list(tmp_path.iterdir()) == []


def plan_of_depth(toy, depth: int) -> Plan:
    from dataclasses import replace

    return replace(plan_for(toy, make_output(Path("a.npy"))), size=(8, 8, depth))


def test_there_are_never_more_shards_than_slabs_and_none_is_empty(toy):
    for depth, asked, expected in ((1, None, 1), (16, None, 1), (17, None, 2), (100_000, None, 64), (40, 99, 3), (40, 2, 2)):
        plan = plan_of_depth(toy, depth)
        count = shard_count(plan, asked)
        assert count == expected
        shards = [plan.shard(number, count) for number in range(1, count + 1)]
        assert all(first < stop for first, stop in shards)
        assert [first for first, _ in shards[1:]] + [depth] == [stop for _, stop in shards]


def test_a_name_that_the_format_would_replace_stays_readable(toy, tmp_path):
    from dataclasses import replace

    plan = replace(anywhere(plan_of_depth(toy, 4)), texture="{{Param.Plan}}\n" + 100 * "é")
    job = template(plan, 1, [], [], overwrite=False)
    assert job["name"].startswith("solidgrain bake Param.Plan")
    (tmp_path / "job.json").write_text(json.dumps(job))
    (tmp_path / "plan.json").write_text("{}")
    assert openjd("check", tmp_path / "job.json").returncode == 0
