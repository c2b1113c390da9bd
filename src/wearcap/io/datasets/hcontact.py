"""The H-contact data set: bodies by sequence, contacts of each hand, and the published split of windows.

Folders as it unpacks: `body/NAME.json.zip`, `contacts/NAME.json`, and, from the published code, `splits/…/NAME.json`.
"""

from dataclasses import dataclass, replace
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.hps_sequence import subject_of
from wearcap.io.formats.contact_labels import LabelClock, read_contact_labels
from wearcap.io.formats.json_text import read_json
from wearcap.io.formats.smpl_json import read_smpl_json
from wearcap.recording.interactions import Interactions
from wearcap.recording.recording import Recording
from wearcap.scene.objects import CONTACT_CLASSES

ENDING = ".json.zip"


@dataclass(frozen=True)
class HContactSplit:
    """Middle frames of the training, validation and test windows, counted from the first whole window."""

    window_radius: int
    train: tuple[int, ...]
    valid: tuple[int, ...]
    test: tuple[int, ...]


def hcontact_names(root: str | Path) -> list[str]:
    """Names of all sequences with a body, in order."""
    return sorted(path.name.removesuffix(ENDING) for path in Path(root).glob(f"body/*{ENDING}"))


def read_hcontact(root: str | Path, name: str, contact_class: str = "") -> Recording:
    """Read a sequence: `motion` (smplh52 with hands, else smpl24) on its own clock, and `interactions` of unknown
    objects, all of `contact_class` (of `scene.objects.CONTACT_CLASSES`, or "" where unknown).

    A contact with end < start lasts until the sequence ends. Raises WearcapError for an unknown sequence or class,
    and for what the readers of bodies and contacts refuse.
    """
    if contact_class not in ("", *CONTACT_CLASSES):
        raise WearcapError(f"no contact class {contact_class!r}", expected=f"one of {', '.join(CONTACT_CLASSES)}")
    root = Path(root)
    if name not in hcontact_names(root):
        raise WearcapError(
            f"no sequence {name!r}",
            where=root,
            expected=f"body/{name}{ENDING}",
            fix=f"There are {len(hcontact_names(root))}, such as {hcontact_names(root)[:3]}.",
        )
    body = read_smpl_json(root / "body" / f"{name}{ENDING}")
    clock = LabelClock.of(name, body.motion.timestamps)
    contacts = read_contact_labels(root / "contacts" / f"{name}.json", clock)
    return Recording(
        name,
        motion=body.motion,
        interactions=_of_class(contacts, contact_class),
        skeleton=body.motion.skeleton,
        shape=body.shape,
        subject=subject_of(name),
        location=location_of(name),
        activity=activity_of(name),
        source="H-contact",
    )


def _of_class(contacts: Interactions, contact_class: str) -> Interactions:
    """The interactions with `contact_class` filled in where they have none."""
    return replace(contacts, classes=tuple(named or contact_class for named in contacts.classes))


def location_of(name: str) -> str:
    """The scene of a sequence's name, as the published code takes it apart: MPI_Etage6, MPI_BIB_EG, TUB_2OG, …"""
    parts = name.split(".")[0].removeprefix(f"{subject_of(name)}_").split("_")
    return "_".join(parts[: 3 if parts[1:2] == ["BIB"] else 2])


def activity_of(name: str) -> str:
    """Activity in a sequence's name."""
    rest = name.split(".")[0].removeprefix(f"{subject_of(name)}_").removeprefix(location_of(name))
    return rest.strip("_")


def read_hcontact_split(path: str | Path) -> HContactSplit:
    """Read `splits/…/NAME.json` {window_radius, train, valid, test}. Raises WearcapError for anything else."""
    content = read_json(path)
    parts = ("train", "valid", "test")
    radius = content.get("window_radius") if isinstance(content, dict) else None
    lists = [content.get(part) for part in parts] if isinstance(content, dict) else []
    sound = (
        type(radius) is int
        and radius > 0
        and all(
            isinstance(windows, list) and all(type(k) is int and 0 <= k < 1 << 40 for k in windows) for windows in lists
        )
    )
    if not sound:
        raise WearcapError(
            "not a split of windows",
            where=path,
            expected='{"window_radius": 30, "train": [frame, …], "valid": […], "test": […]}',
        )
    return HContactSplit(radius, *map(tuple, lists))
