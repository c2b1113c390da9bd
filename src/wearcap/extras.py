"""Packages that only some features need: the extra that brings each, and one line that says so where it is missing."""

import importlib
import importlib.util
from types import ModuleType
from typing import Any

from wearcap.errors import WearcapError

EXTRAS = {
    "lightning": "train",
    "lightning_utilities": "train",
    "wandb": "train",
    "prodigyopt": "train",
    "hydra_plugins": "train",
    "viser": "view",
    "websockets": "view",
    "trimesh": "view",
    "pythonosc": "live",
    "cv2": "scene",
    "poselib": "scene",
    "onnx": "export",
    "onnxscript": "export",
    "onnxruntime": "export",
    "pycolmap": "track",
    "kornia": "learned",
    "c3d": "biomechanics",
    "pxr": "usd",
    "projectaria_tools": "aria",
    "mediapipe": "hands",
    "open_clip": "images",
    "timm": "images",
    "dask": "cluster",
}
"""Extra of each module that is no dependency of the core."""
VERBS = {
    "train": ("lightning",),
    "adapt": ("lightning",),
    "demo": ("lightning",),
    "view": ("viser",),
    "scene_edit": ("viser",),
    "live": ("pythonosc", "viser"),
    "scene": ("cv2",),
    "track": ("cv2",),
}
"""Modules that a verb cannot do without; further ones are named when a setting asks for them."""


def check_verb(verb: str) -> None:
    """Raise WearcapError, before anything is imported, for a verb whose extra is missing."""
    for module in VERBS.get(verb, ()):
        if importlib.util.find_spec(module) is None:
            raise missing(module, "this command")


def missing(module: str, what: str, otherwise: str = "") -> WearcapError:
    """The error of a feature whose module is missing: what needs it, and how to get it (or what to do without it)."""
    name = module.partition(".")[0]
    package = f"wearcap[{EXTRAS[name]}]" if name in EXTRAS else name
    fix = f'Run: pip install "{package}"{f", or {otherwise}" if otherwise else ""}.'
    return WearcapError(f"{what} needs the package {name!r}", fix=fix)


def required(module: str, what: str, otherwise: str = "") -> Any:
    """A module of an extra, imported. Raises WearcapError where it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(error.name or module, what, otherwise) from error


class _AtFirstUse(ModuleType):
    """A module that is imported when an attribute of it is first read."""

    def __init__(self, name: str, what: str):
        super().__init__(name)
        self._what = what

    def __getattr__(self, name: str) -> Any:
        value = getattr(required(self.__name__, self._what), name)
        setattr(self, name, value)
        return value


def at_first_use(module: str, what: str) -> Any:
    """A module of an extra for `what` ("localisation"), imported at its first use, which raises WearcapError where it is
    missing."""
    return _AtFirstUse(module, what)
