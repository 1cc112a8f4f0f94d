"""`view`, `info` and `doctor`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import OpenImageIO as oiio
import pytest

from solidgrain.bake import opengl
from solidgrain.bake.masks import read_mask
from solidgrain.bake.messages import first_line
from solidgrain.bake.view import read_volume
from solidgrain.runtime.bundle import embedded_folder
from solidgrain.runtime.errors import BakeError


@pytest.fixture(scope="module")
def volume(tmp_path_factory, toy_folder):
    from solidgrain.bake.cli import main

    folder = tmp_path_factory.mktemp("volume")
    outputs = ["--out", str(folder / "a.vti"), "--out", str(folder / "a.npy")]
    assert main(["bake", str(toy_folder), "--size", "24x20x16", "--quiet", *outputs]) == 0
    wide = ["--out", str(folder / "wide.vti"), "--vti-type", "uint16"]
    assert main(["bake", str(toy_folder), "--size", "24x20x16", "--quiet", *wide]) == 0
    return folder


@pytest.fixture(scope="module")
def drawing():
    if reason := opengl.opengl_error():
        pytest.skip(f"VTK cannot draw here: {reason}")


MODES = ["slices", "volume", "threshold", "block"]


@pytest.mark.parametrize(
    ("name", "mode"), [("wide.vti", "slices"), *((name, mode) for name in ("a.vti", "a.npy") for mode in MODES)]
)
def test_a_screenshot_shows_the_volume_in_colour(solidgrain, drawing, volume, tmp_path, name, mode):
    outcome = solidgrain("view", volume / name, "--mode", mode, "--screenshot", tmp_path / "view.png")
    assert outcome.code == 0, outcome.err
    picture = oiio.ImageBuf(os.fspath(tmp_path / "view.png")).get_pixels(oiio.FLOAT)
    shown = picture[np.abs(picture - picture[0, 0]).max(-1) > 0.05]
    assert len(shown) > 0.05 * picture.shape[0] * picture.shape[1]
    assert shown[:, 0].mean() > shown[:, 2].mean()  # the toy texture is reddish
    assert [path.name for path in tmp_path.iterdir()] == ["view.png"]


def test_colours_are_the_same_from_numbers_of_any_type(volume, tmp_path):
    shown = read_volume(volume / "a.vti").point_data["rgb"].astype(int)
    for dtype in (np.uint8, np.uint16, np.uint32, np.float32, np.float64):
        largest = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
        np.save(tmp_path / "a.npy", (np.load(volume / "a.npy").astype(float) * largest).astype(dtype))
        assert np.abs(read_volume(tmp_path / "a.npy").point_data["rgb"] - shown).max() <= 1
    assert np.abs(read_volume(volume / "wide.vti").point_data["rgb"] - shown).max() <= 1


def test_black_and_white_are_exact_in_numbers_of_any_type(tmp_path):
    for dtype in (np.uint8, np.uint16, np.uint32, np.uint64):
        ends = np.array([[[[0, 0, 0], [np.iinfo(dtype).max] * 3]]], dtype)
        np.save(tmp_path / "a.npy", ends)
        assert read_volume(tmp_path / "a.npy").point_data["rgb"].tolist() == [[0, 0, 0], [255, 255, 255]]


def test_without_opengl_there_is_an_error_instead_of_a_crash(solidgrain, volume, tmp_path, monkeypatch):
    """The probe of a machine without OpenGL dies of a segmentation fault; so does this one."""
    monkeypatch.setattr(opengl, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    outcome = solidgrain("view", volume / "a.vti", "--screenshot", tmp_path / "view.png")
    assert outcome.code == 1
    assert "no OpenGL library; apt install" in outcome.error
    assert list(tmp_path.iterdir()) == []


def test_a_window_needs_a_display(solidgrain, volume, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    outcome = solidgrain("view", volume / "a.vti")
    assert outcome.code == 1
    assert "--screenshot" in outcome.error


def test_a_display_that_does_not_answer_is_an_error_and_no_silence(drawing, volume):
    """In a process of its own: VTK decides once what its windows are."""
    command = [sys.executable, "-m", "solidgrain.bake.cli", "view", volume / "a.vti"]
    outcome = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "DISPLAY": ":99"}, check=False)
    assert outcome.returncode == 1
    assert "--screenshot FILE.png (DISPLAY is :99, which does not answer)" in outcome.stderr.splitlines()[-1]


def test_linear_colours_are_shown_as_srgb_and_others_as_they_are(solidgrain, toy_folder, volume, tmp_path, capsys):
    def baked(name, *flags):
        assert solidgrain("bake", toy_folder, "--size", "24x20x16", "--out", tmp_path / name, *flags).code == 0
        return read_volume(tmp_path / name).point_data["rgb"].astype(int)

    shown = read_volume(volume / "a.vti").point_data["rgb"]
    linear = ("--colorspace", "lin_rec709_scene")
    assert np.abs(baked("whole.vti", *linear, "--vti-type", "uint16") - shown).max() <= 1
    assert np.abs(baked("float.vti", *linear, "--vti-type", "float32") - shown).max() <= 1
    capsys.readouterr()
    assert np.abs(baked("wide.vti", "--colorspace", "ACEScg") - shown).max() > 1
    assert "are shown as if they were srgb_rec709_scene" in capsys.readouterr().err


@pytest.mark.parametrize("mode", ["volume", "threshold"])
def test_where_and_how_small_a_volume_is_does_not_show(solidgrain, drawing, toy_folder, tmp_path, mode):
    pictures = []
    for name, box in (("near", ()), ("far", ("--origin", "1e9,0,0")), ("small", ("--spacing", "0.001"))):
        assert solidgrain("bake", toy_folder, "--size", 16, "--out", tmp_path / f"{name}.vti", *box).code == 0
        image = read_volume(tmp_path / f"{name}.vti")
        image.point_data["rgb"] = read_volume(tmp_path / "near.vti").point_data["rgb"]
        image.save(tmp_path / "a.vti")
        assert solidgrain("view", tmp_path / "a.vti", "--mode", mode, "--screenshot", tmp_path / "a.png").code == 0
        pictures.append(oiio.ImageBuf(os.fspath(tmp_path / "a.png")).get_pixels(oiio.FLOAT))
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).mean() < 0.01


@pytest.mark.parametrize("colors", [np.zeros((8, 2)), np.zeros((8, 3), np.int32), np.zeros(8), np.full((8, 3), np.nan)])
def test_image_data_of_others_that_holds_no_colours_is_refused(solidgrain, tmp_path, colors):
    import pyvista

    image = pyvista.ImageData(dimensions=(2, 2, 2))
    image.point_data["rgb"] = colors
    image.save(tmp_path / "odd.vti")
    assert "odd.vti" in solidgrain("view", tmp_path / "odd.vti", "--screenshot", tmp_path / "view.png").error


def test_alpha_of_others_is_left_out(tmp_path):
    import pyvista

    image = pyvista.ImageData(dimensions=(2, 1, 1))
    image.point_data["rgb"] = np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.uint8)
    image.save(tmp_path / "rgba.vti")
    assert read_volume(tmp_path / "rgba.vti").point_data["rgb"].tolist() == [[1, 2, 3], [5, 6, 7]]


@pytest.mark.parametrize(
    ("name", "content"),
    [("none.vti", None), ("bad.vti", b"hello"), ("bad.npy", b"hello"), ("empty.vti", b""), ("odd.xyz", b"?")],
)
def test_a_file_that_is_no_volume_is_refused(solidgrain, tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    outcome = solidgrain("view", tmp_path / name, "--screenshot", tmp_path / "view.png")
    assert outcome.code == 1
    assert name in outcome.error
    assert not (tmp_path / "view.png").exists()


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((2, 2, 2)),
        np.zeros((0, 2, 2, 3)),
        np.full((2, 2, 2, 3), np.nan),
        np.full((2, 2, 2, 3), "a"),
        np.zeros((2, 2, 2, 3), int),
    ],
)
def test_an_array_that_is_no_volume_is_refused(solidgrain, tmp_path, array):
    np.save(tmp_path / "odd.npy", array)
    assert "odd.npy" in solidgrain("view", tmp_path / "odd.npy", "--screenshot", tmp_path / "view.png").error


def test_an_archive_that_is_called_an_array_is_refused(solidgrain, tmp_path):
    with open(tmp_path / "archive.npy", "wb") as file:
        np.savez(file, np.zeros((2, 2, 2, 3)))
    outcome = solidgrain("view", tmp_path / "archive.npy", "--screenshot", tmp_path / "view.png")
    assert (outcome.code, outcome.error.endswith("archive.npy: not readable as a NumPy array")) == (1, True)
    with pytest.raises(BakeError, match=r"archive\.npy: not readable as a NumPy array"):
        read_mask(tmp_path / "archive.npy")


def test_a_library_s_error_without_words_is_called_by_its_type():
    assert first_line(MemoryError()) == "MemoryError"
    assert first_line(ValueError("one\ntwo")) == "one"


def test_a_closed_pipe_is_no_traceback():
    command = f"{sys.executable} -m solidgrain.bake.cli info --json | head -c 1"
    outcome = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert "Traceback" not in outcome.stderr


def test_info_says_what_granite_is_and_that_it_is_reproduced(solidgrain):
    outcome = solidgrain("info")
    assert outcome.code == 0
    assert "probe      reproduced" in outcome.out
    assert "CC0" in outcome.out
    report = json.loads(solidgrain("info", "granite", "--json").out)
    assert report["probe_error"] < 1e-4
    assert report["training"]["exemplars"][0]["license"]


def test_info_exits_with_3_when_the_colours_are_not_those_of_the_manifest(solidgrain, toy_folder, tmp_path):
    folder = shutil.copytree(toy_folder, tmp_path / "toy")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["probe"]["rgb"][0][0] += 0.1
    (folder / "manifest.json").write_text(json.dumps(manifest))
    outcome = solidgrain("info", folder)
    assert outcome.code == 3
    assert "NOT REPRODUCED" in outcome.out


def test_doctor_reports_a_healthy_installation(solidgrain):
    report = json.loads(solidgrain("doctor", "--json").out)
    assert report["providers"]["cpu"] == "works"
    assert report["onnxruntime_builds"] == ["onnxruntime"]
    assert report["textures"]["granite"] < 1e-4
    assert report["problems"] == []
    assert "OpenGL" in solidgrain("doctor").out


def test_doctor_reports_a_damaged_texture_and_all_the_rest(solidgrain, tmp_path, monkeypatch):
    shutil.copytree(embedded_folder("granite"), tmp_path / "granite")
    (tmp_path / "granite" / "sampler.onnx").write_bytes(b"damaged")
    monkeypatch.setattr("solidgrain.runtime.bundle._embedded_root", lambda: tmp_path)
    outcome = solidgrain("doctor")
    assert outcome.code == 1
    assert "kernel     not tried: " in outcome.out
    assert "PROBLEM    " in outcome.out
    assert "sampler.onnx" in outcome.out
    assert "OpenGL" in outcome.out


def test_doctor_says_why_there_is_no_kernel(solidgrain, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL_LIBRARY", "nowhere.so")
    outcome = solidgrain("doctor")
    assert outcome.code == 0, outcome.err
    assert "the fused kernel cannot be loaded" in outcome.out
    assert "nowhere.so" in outcome.out


def pretend_installed(folder, monkeypatch, name: str, module: str) -> None:
    package = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (package / "top_level.txt").write_text(f"{module}\n")
    monkeypatch.syspath_prepend(folder)


def test_doctor_finds_two_builds_of_onnx_runtime(solidgrain, tmp_path, monkeypatch):
    pretend_installed(tmp_path, monkeypatch, "onnxruntime-gpu", module="onnxruntime")
    outcome = solidgrain("doctor")
    assert outcome.code == 1
    assert "onnxruntime and onnxruntime-gpu are installed together" in outcome.out


def test_doctor_tells_an_extension_of_onnx_runtime_from_a_build(solidgrain, tmp_path, monkeypatch):
    pretend_installed(tmp_path, monkeypatch, "onnxruntime-extensions", module="onnxruntime_extensions")
    assert json.loads(solidgrain("doctor", "--json").out)["onnxruntime_builds"] == ["onnxruntime"]


def test_one_cause_is_one_problem(solidgrain, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", "bogus")
    problems = json.loads(solidgrain("doctor", "--json").out)["problems"]
    assert problems
    assert len(problems) == len(set(problems))


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_that_lacks_a_character_gets_it_escaped(encoding):
    command = [sys.executable, "-m", "solidgrain.bake.cli", "bake", "--help"]
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    outcome = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert outcome.returncode == 0, outcome.stderr
    assert b"\\u2026" in outcome.stdout


@pytest.mark.parametrize(
    ("command", "flags", "extra"),
    [
        ("export", ["run", "--out", "b"], "export"),
        ("evaluate", ["granite", "--exemplar", "a.png"], "evaluate"),
        ("adapt", ["a.png", "--out", "a.sgt.npz"], "train"),
    ],
)
def test_the_extra_that_is_named_is_all_that_a_command_needs(command, flags, extra):
    outcome = without("torch", command, *flags)
    assert outcome.stderr.strip().endswith(f"{command} needs the package torch; pip install 'solidgrain[{extra}]'")


def test_an_unknown_flag_points_to_the_help_of_its_command(solidgrain):
    outcome = solidgrain("bake", "--nope")
    assert outcome.code == 2
    assert outcome.err.endswith("solidgrain bake: unrecognized arguments: --nope (see solidgrain bake --help)\n")


def without(package: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """The command line on an installation that lacks a package."""
    code = f"import sys; sys.modules[{package!r}] = None; from solidgrain.bake.cli import main; sys.exit(main(sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("package", ["OpenEXR", "isal"])
def test_a_missing_extra_is_named(tmp_path, toy_folder, package):
    outcome = without(package, "bake", toy_folder, "--size", 2, "--out", tmp_path / "a.#.exr")
    assert outcome.returncode == 1
    assert outcome.stderr.strip() == f"solidgrain: bake needs the package {package}; pip install 'solidgrain[bake]'"
    assert list(tmp_path.iterdir()) == []


def test_what_needs_no_extra_bakes_without(tmp_path, toy_folder):
    assert "--exr-compression" in without("isal", "bake", "--help").stdout
    outcome = without("isal", "bake", toy_folder, "--size", 2, "--out", tmp_path / "a.npy", "--quiet")
    assert (outcome.returncode, outcome.stderr) == (0, "")


def test_an_extra_that_a_commands_flags_need_is_named(solidgrain, monkeypatch):
    def missing(parser):
        raise ModuleNotFoundError("no module", name="isal.isal_zlib")

    monkeypatch.setattr("solidgrain.bake.commands.bake.add_arguments", missing)
    outcome = solidgrain("bake", "--help")
    assert outcome.code == 1
    assert outcome.error == "solidgrain: bake needs the package isal; pip install 'solidgrain[bake]'"


def test_a_bundle_flag_that_is_about_nothing_is_refused(solidgrain):
    assert "granite: is a bundle itself, and --bundle is about texture files; leave nope out" in (
        solidgrain("info", "granite", "--bundle", "nope").error
    )


def test_a_working_folder_that_is_gone_is_said_to_be(solidgrain, tmp_path, monkeypatch, toy_folder):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    outcome = solidgrain("bake", toy_folder, "--size", 4, "--out", "a.npy")
    assert (outcome.code, outcome.error) == (1, "solidgrain: the working folder is no longer there; change to another one")


def test_names_that_are_not_utf8_are_written_as_they_came_or_refused(tmp_path, toy_folder):
    strange = os.fsencode(tmp_path) + b"/caf\xe9"
    bake = [sys.executable, "-m", "solidgrain.bake.cli", "bake", toy_folder, "--size", "4", "--quiet"]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}

    def run(*flags):
        return subprocess.run([*bake, *flags], env=environment, capture_output=True, check=False)

    planned = run("--out", strange + b".npy", "--dry-run")
    assert (planned.returncode, strange in planned.stdout) == (0, True), planned.stderr
    assert run("--out", strange + b".npy").returncode == 0
    for refused in (run("--preview", strange + b".png"), run("--out", strange + b".atlas.png")):
        assert refused.returncode == 1
        assert b"the name is not UTF-8, with which OpenImageIO writes no file; rename it" in refused.stderr


@pytest.mark.parametrize("flags", [("--origin", "1e12,0,0"), ("--spacing", "1e11")])
def test_a_grid_that_is_out_of_reach_is_a_matter_of_its_flags(solidgrain, toy_folder, tmp_path, flags):
    outcome = solidgrain("bake", toy_folder, *flags, "--out", tmp_path / "a.npy")
    assert (outcome.code, flags[0] in outcome.error) == (2, True), outcome.error
