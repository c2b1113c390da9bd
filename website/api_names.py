"""What Griffe, which reads the docstrings for the pages of the Python API, does not know of this project: names in backticks
link to the pages of what they name, and the shapes of jaxtyping are text."""

import re
from typing import Any

import griffe

NAME = re.compile(r"`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)`")
ARRAYS = ("Float", "Float32", "Float64", "Int", "Int64", "Bool", "UInt8", "Shaped")


class Names(griffe.Extension):
    """Changes docstrings and annotations once a package is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = NAME.sub(lambda found: _linked(obj, found[1]), obj.docstring.value)
        annotations = [getattr(obj, "annotation", None), getattr(obj, "returns", None)]
        annotations += [parameter.annotation for parameter in getattr(obj, "parameters", ())]
        for annotation in annotations:
            if isinstance(annotation, griffe.Expr):
                _quote_shapes(annotation)


def _linked(obj: griffe.Object, name: str) -> str:
    """A name as a link to what it names from an object's point of view; the site leaves out links to what it does not show."""
    try:
        path = name if name.startswith("wearcap.") else f"wearcap.{name}" if "." in name else obj.resolve(name)
    except griffe.NameResolutionError:
        return f"`{name}`"
    return f'<autoref identifier="{path}" optional><code>{name}</code></autoref>'


def _quote_shapes(annotation: griffe.Expr) -> None:
    """Shapes as the text that they are; those of one word, such as "time", are read as names."""
    for part in annotation.iterate(flat=False):
        if isinstance(part, griffe.Expr) and part is not annotation:
            _quote_shapes(part)
    if isinstance(annotation, griffe.ExprSubscript) and str(annotation.left) in ARRAYS:
        array = annotation.slice
        if isinstance(array, griffe.ExprTuple):
            shape = str(array.elements[1]).strip("'\"")
            array.elements[1] = f'"{shape}"'
