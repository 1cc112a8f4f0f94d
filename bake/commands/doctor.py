"""`solidgrain doctor`: what this installation can do. Exit code 1 if something is wrong with it."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from typing import Any

from solidgrain.bake.messages import first_line

PACKAGES = (
    *("solidgrain", "numpy", "onnxruntime", "OpenEXR", "OpenImageIO", "isal", "jsonschema", "etcpak", "distributed"),
    *("pyvista", "vtk", "torch", "onnx", "spox"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    report = diagnose()
    print(json.dumps(report, indent=2) if arguments.json else summary(report))
    return 1 if report["problems"] else 0


def diagnose() -> dict[str, Any]:
    """Everything that the doctor looks at, as plain data; `problems` is empty on a healthy installation."""
    from solidgrain.runtime.workers import usable_threads

    problems: list[str] = []
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "packages": {name: _version(name) for name in PACKAGES},
        "threads": {"usable": usable_threads(), "processors": os.cpu_count()},
        "onnxruntime_builds": _onnxruntime_builds(problems),
        "kernel": _kernel(),
        "providers": _providers(problems),
        "textures": _textures(problems),
        "opengl": _opengl(),
        "problems": list(dict.fromkeys(problems)),  # one cause is met by many textures
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _onnxruntime_builds(problems: list[str]) -> list[str]:
    """Installed builds of ONNX Runtime. Two of them overwrite each other's files, and the CPU build usually wins."""
    builds = sorted(set(packages_distributions().get("onnxruntime", [])))
    if len(builds) > 1:
        problems.append(f"{' and '.join(builds)} are installed together; uninstall all of them, then install one")
    return builds


def _kernel() -> dict[str, Any]:
    """The fused kernel: the paths that run here and the one that is used, or why there is none. It may be missing."""
    from solidgrain.runtime import ProviderError, SolidgrainError, load_texture
    from solidgrain.runtime.kernel import kernel_paths

    try:
        return {"paths": list(kernel_paths()), "used": load_texture(provider="kernel").provider}
    except ProviderError as error:
        return {"paths": [], "used": None, "reason": f"{error}; textures are evaluated by ONNX Runtime"}
    except SolidgrainError as error:  # the embedded texture is damaged: that is among the problems, too
        return {"paths": [], "used": None, "reason": f"not tried: {error}"}


def _providers(problems: list[str]) -> dict[str, str]:
    """What happens when the embedded texture is really loaded on each provider that ONNX Runtime offers."""
    from solidgrain.runtime import SolidgrainError, load_texture
    from solidgrain.runtime.provider import available_providers

    found = {}
    for provider in available_providers():
        try:
            load_texture(provider=provider).sample([[0.5, 0.5, 0.5]])
            found[provider] = "works"
        except SolidgrainError as error:
            found[provider] = str(error)
        except Exception as error:  # a provider's own failure, whatever its type, is what is being reported
            found[provider] = first_line(error)
    if found.get("cpu") != "works":
        problems.append(f"the CPU provider does not work: {found.get('cpu', 'not offered')}")
    return found


def _textures(problems: list[str]) -> dict[str, float]:
    """The embedded textures, with their largest difference from the colours in their manifests."""
    from solidgrain.runtime import SolidgrainError
    from solidgrain.runtime.bundle import embedded_bundles, embedded_folder, open_bundle
    from solidgrain.runtime.probe import TOLERANCE, probe_error

    errors = {}
    for name in embedded_bundles():
        try:
            errors[name] = probe_error(open_bundle(embedded_folder(name)))
        except SolidgrainError as error:
            problems.append(str(error))
    problems += [
        f"{name}: colours differ from the manifest by {error:.1g}" for name, error in errors.items() if error > TOLERANCE
    ]
    return errors


def _opengl() -> str:
    from solidgrain.bake.opengl import REMEDY, opengl_error

    if importlib.util.find_spec("pyvista") is None:
        return "not needed: pyvista is not installed (pip install 'solidgrain[view]')"
    reason = opengl_error()
    return "works" if reason is None else f"{reason}; {REMEDY}"


def _kernel_line(kernel: dict[str, Any]) -> str:
    if kernel["used"] is None:
        return str(kernel["reason"])
    return f"{kernel['used']} is used, of {', '.join(kernel['paths'])}"


def summary(report: dict[str, Any]) -> str:
    """The report for people."""
    threads = report["threads"]
    packages = ", ".join(f"{name} {found or '-'}" for name, found in report["packages"].items())
    lines = [
        f"python     {report['python']} on {report['machine']}",
        f"packages   {packages}",
        f"threads    {threads['usable']} usable of {threads['processors']} processors",
        f"runtime    {', '.join(report['onnxruntime_builds'])}",
        f"kernel     {_kernel_line(report['kernel'])}",
        *(f"provider   {name}: {state}" for name, state in report["providers"].items()),
        *(f"texture    {name}: largest difference from its manifest {error:.1g}" for name, error in report["textures"].items()),
        f"OpenGL     {report['opengl']}",
        *(f"PROBLEM    {problem}" for problem in report["problems"]),
    ]
    return "\n".join(lines)
