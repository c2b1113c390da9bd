"""Plain descriptions of what runs around an exported network: skeleton, schedule and rotation channels, as JSON."""

from typing import Any

import torch

from wearcap.body.skeleton import Site, Skeleton
from wearcap.diffusion.schedule import CosineSchedule, LinearSchedule, Schedule
from wearcap.errors import WearcapError

SCHEDULES = {cls.__name__: cls for cls in (CosineSchedule, LinearSchedule)}
ROT6D = tuple(f"{column}{axis}" for column in "xy" for axis in "xyz")
"""First two columns of a rotation matrix, one after the other."""


def schedule_to_json(schedule: Schedule) -> dict[str, Any]:
    """A schedule by name and settings. Raises WearcapError for one of another class than `SCHEDULES`."""
    name = type(schedule).__name__
    if name not in SCHEDULES:
        raise WearcapError(f"schedule {name} cannot be exported", expected=f"one of {', '.join(SCHEDULES)}")
    return {"name": name, **vars(schedule)}


def schedule_from_json(tree: dict[str, Any]) -> Schedule:
    """The inverse of `schedule_to_json`."""
    return SCHEDULES[tree["name"]](**{key: value for key, value in tree.items() if key != "name"})


def skeleton_to_json(skeleton: Skeleton) -> dict[str, Any]:
    """A skeleton as plain data; offsets in m."""
    return {
        "name": skeleton.name,
        "joint_names": skeleton.joint_names,
        "parents": skeleton.parents,
        "t_parent_joint": skeleton.t_parent_joint.tolist(),
        "sites": {name: [site.joint, *site.t_joint_site] for name, site in skeleton.sites.items()},
    }


def skeleton_from_json(tree: dict[str, Any]) -> Skeleton:
    """The inverse of `skeleton_to_json`."""
    sites = {name: Site(joint, (x, y, z)) for name, (joint, x, y, z) in tree["sites"].items()}
    offsets = torch.tensor(tree["t_parent_joint"])
    return Skeleton(tree["name"], tuple(tree["joint_names"]), tuple(tree["parents"]), offsets, sites)
