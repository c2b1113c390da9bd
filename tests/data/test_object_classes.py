"""Names of objects to classes."""

import pytest

from data_prep.one_object import OBJECT_CLASSES, object_class
from wearcap.errors import WearcapError

BEHAVE = (
    "backpack",
    "basketball",
    "boxlarge",
    "boxlong",
    "boxmedium",
    "boxsmall",
    "boxtiny",
    "chairblack",
    "chairwood",
    "keyboard",
    "monitor",
    "plasticcontainer",
    "stool",
    "suitcase",
    "tablesmall",
    "tablesquare",
    "toolbox",
    "trashbin",
    "yogaball",
    "yogamat",
)
OMOMO = (
    "clothesstand",
    "floorlamp",
    "largebox",
    "largetable",
    "monitor",
    "mop",
    "plasticbox",
    "smallbox",
    "smalltable",
    "suitcase",
    "trashcan",
    "tripod",
    "vacuum",
    "whitechair",
    "woodchair",
)


def test_classes_are_sorted_unique_and_their_own_names():
    assert list(OBJECT_CLASSES) == sorted(set(OBJECT_CLASSES))
    assert [object_class(name) for name in OBJECT_CLASSES] == list(OBJECT_CLASSES)


def test_every_object_of_both_data_sets_has_a_class():
    assert {object_class(name) for name in (*BEHAVE, *OMOMO)} <= set(OBJECT_CLASSES)
    wanted = {
        "boxlarge": "box",
        "largebox": "box",
        "basketball": "ball",
        "yogaball": "ball",
        "chairblack": "chair",
        "whitechair": "chair",
        "tablesquare": "table",
        "largetable": "table",
        "plasticbox": "box",
        "plasticcontainer": "container",
        "trashbin": "trashcan",
        "yogamat": "yogamat",
    }
    assert {name: object_class(name) for name in wanted} == wanted


def test_an_unknown_name_is_refused_with_those_that_are_known():
    with pytest.raises(WearcapError, match="no class for the object 'boxlarg'.*chairblack.*Did you mean 'boxlarge'"):
        object_class("boxlarg")
    with pytest.raises(WearcapError, match="no class for the object 'spaceship'.*one of backpack.*one_object.py"):
        object_class("spaceship")
