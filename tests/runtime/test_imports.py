"""The runtime is light: no torch, no image or volume library, no onnx."""

import subprocess
import sys


def modules_after(code: str) -> set[str]:
    command = f"import sys; {code}; print(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True).stdout.split())


def test_loading_and_evaluating_needs_numpy_and_onnxruntime_only():
    loaded = modules_after("from solidgrain.runtime import load; load().grid((1, 2, 2))")
    assert not loaded & {"torch", "onnx", "spox", "OpenEXR", "OpenImageIO", "pyvista", "vtkmodules"}


def test_baking_does_not_import_torch():
    assert "torch" not in modules_after("import solidgrain.bake.baker, solidgrain.bake.commands.bake")


def test_help_needs_nothing_heavy():
    loaded = modules_after("from solidgrain.bake.cli import _parser; _parser(['--help'])")
    assert not loaded & {"torch", "numpy", "onnxruntime", "vtkmodules"}
