"""Object classes, and the class of every object name in the data sets."""

from wearcap.errors import WearcapError, nearest

OBJECT_CLASSES: tuple[str, ...] = (
    "backpack",
    "ball",
    "bottle",
    "box",
    "cabinet_door",
    "chair",
    "clothesstand",
    "container",
    "door",
    "drawer",
    "floorlamp",
    "keyboard",
    "monitor",
    "mop",
    "sofa",
    "stool",
    "suitcase",
    "table",
    "tool",
    "toolbox",
    "trashcan",
    "tripod",
    "vacuum",
    "window",
    "yogamat",
)
"""All classes in alphabetical order; a class's index is its position here."""

_OTHER_NAMES = {
    "ball": ("basketball", "yogaball"),
    "box": ("boxlarge", "boxlong", "boxmedium", "boxsmall", "boxtiny", "largebox", "plasticbox", "smallbox"),
    "chair": ("chairblack", "chairwood", "whitechair", "woodchair"),
    "container": ("plasticcontainer",),
    "table": ("largetable", "smalltable", "tablesmall", "tablesquare"),
    "trashcan": ("trashbin",),
}
"""BEHAVE's and OMOMO's names by class, where they differ from the class's name."""

_CLASS_OF = {name: name for name in OBJECT_CLASSES} | {
    name: kind for kind, names in _OTHER_NAMES.items() for name in names
}


def object_class(name: str) -> str:
    """The class (of `OBJECT_CLASSES`) of an object by a data set's name, such as "largebox".

    Raises WearcapError, which lists the accepted names, for any other.
    """
    if name not in _CLASS_OF:
        near = nearest(name, _CLASS_OF)
        hint = near if near.startswith("Did you mean") else ""
        raise WearcapError(
            f"no class for the object {name!r}",
            expected=f"one of {', '.join(sorted(_CLASS_OF))}",
            fix=f"{hint} A new name belongs into data/object_classes.py.".strip(),
        )
    return _CLASS_OF[name]
