"""Versions of the software that can change a figure."""

from importlib.metadata import version


def versions() -> dict[str, str]:
    return {name: version(name) for name in ("trompe", "torch", "numpy", "pyrender", "onnxruntime")}
