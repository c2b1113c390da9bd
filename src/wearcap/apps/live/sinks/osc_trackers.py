"""The body as VRChat's OSC trackers (docs.vrchat.com/docs/osc-trackers; port 9000): full-body tracking without trackers.

Up to eight trackers, `/tracking/trackers/1/position` and `…/rotation` to 8, and `/tracking/trackers/head/…`, by which VRChat
lays the trackers' space over its own: the head's joint is at the root of the head, as it expects. Three numbers each, in
Unity's axes (left-handed, x right, y up, z forward): metres, and Euler angles in degrees that turn about z, then x, then y.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.apps.live.sinks.udp import Message, UdpSink, osc_bundle
from wearcap.apps.live.source import Address
from wearcap.body.skeleton import SIDES
from wearcap.errors import WearcapError, nearest
from wearcap.io.devices.axes import UNITY
from wearcap.recording import Motion

_PARTS = {"hip": ("pelvis", "pelvis"), "chest": ("t8", "t8")} | {
    f"{side} {part}": (f"{side}_{bone}", f"{side}_{joint}")
    for part, bone, joint in (("foot", "ankle", "ankle"), ("knee", "hip", "knee"), ("elbow", "shoulder", "elbow"))
    for side in SIDES
}
"""Trackers in the order of their numbers: the joint whose bone carries them, and the joint at which they sit.

Those of knees and elbows are worn on thighs and upper arms.
"""
GROUPS = {"hip": "hip", "chest": "chest", "feet": "foot", "knees": "knee", "elbows": "elbow"}


class OscTrackerSink(UdpSink):
    """Sends one wearer's trackers and head; `?trackers=hip+feet` leaves out the others, which keep their numbers."""

    port = 9000
    convention = "VRChat's OSC trackers: metres, Euler degrees (z, x, y); left-handed, y up, z forward"
    joints = ("head", *(joint for pair in _PARTS.values() for joint in pair))
    own_options = ("trackers",)

    def __init__(self, address: Address, pace: bool = True):
        """Raises WearcapError for options that the sink does not have, and for other trackers."""
        super().__init__(address, pace)
        wanted = address.options.get("trackers", " ".join(GROUPS)).split()
        for name in wanted:
            if name not in GROUPS:
                raise WearcapError(f"no trackers {name!r}", self.name, "trackers=hip+feet", nearest(name, GROUPS))
        ends = tuple(GROUPS[name] for name in wanted)
        self._trackers = {"head": ("head", "head")} | {
            str(number): pair for number, (part, pair) in enumerate(_PARTS.items(), 1) if part.endswith(ends)
        }

    def datagrams(self, motion: Motion, origin_s: float) -> Iterator[bytes]:
        bones, joints = zip(*self._trackers.values())
        t = (motion.T_world_joint.t[:, motion.skeleton.indices(*joints)] @ UNITY).tolist()
        R = UNITY.mT @ motion.T_world_joint.R[:, motion.skeleton.indices(*bones)] @ UNITY
        angles = euler_deg(R).tolist()
        for places, turns in zip(t, angles):
            messages: list[Message] = []
            for name, place, turn in zip(self._trackers, places, turns):
                messages += [
                    (f"/tracking/trackers/{name}/position", *place),
                    (f"/tracking/trackers/{name}/rotation", *turn),
                ]
            yield osc_bundle(messages)


def euler_deg(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Angles (degrees) x, y, z of R = R_y(y) R_x(x) R_z(z), Unity's order; looking straight up or down z is 0."""
    R = R.double()
    cos = torch.hypot(R[..., 1, 0], R[..., 1, 1])
    steep = cos < 1e-7
    x = torch.atan2(-R[..., 1, 2], cos)
    y = torch.where(steep, torch.atan2(-R[..., 2, 0], R[..., 0, 0]), torch.atan2(R[..., 0, 2], R[..., 2, 2]))
    z = torch.where(steep, 0.0, torch.atan2(R[..., 1, 0], R[..., 1, 1]))
    return torch.stack([x, y, z], -1).rad2deg()
