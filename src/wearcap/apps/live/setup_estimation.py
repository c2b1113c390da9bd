"""The first minute of a wearer: height, floor, sides and seats of the devices, by themselves or guided step by step."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from wearcap.apps.live import placement
from wearcap.apps.live.clock_offset import Aligned, aligned_by_turning, turned
from wearcap.apps.live.devices import MAX_DEVICES
from wearcap.apps.live.guided import ARMS, RAISE, SENTENCES, STAND, TURN, WALK, Step
from wearcap.apps.live.packets import HEAD
from wearcap.apps.live.placement import Seen, Window
from wearcap.apps.live.setup import Seat, Setup, hand_seat, head_seat
from wearcap.body.skeleton import WRISTS, Skeleton, skeleton_of_height, xsens23
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO
from wearcap.io.devices.hand_seats import SEATS, most_likely_seat
from wearcap.sensors import packets
from wearcap.sensors.samples import HeadSample, SuitPiece, WatchSample, WristSample
from wearcap.tracking.stature import UNKNOWN, height_over, source_of

LOOK_EVERY_S = 0.1
SHORT_S = 0.5
HOLD_S = 2.2
"""Time (s) for which a wearer stands still, and hands are looked at."""
SOON_S, DEVICES_S = 8.0, 15.0
"""Time (s) after which the capture starts with defaults: of someone who does not stand still, without a device."""
LAG_S = 1.5
"""Time (s) by which samples of a device may be later than the head's: some applications send a second at once."""
STEP_S = 25.0
"""Time (s) after which a guided step is left with its default."""
WALKED_S = 2.5
"""Time (s) of walking that is enough."""
AGREE_M = 0.15
"""Distance (m) between the head's height and that of a standing wearer for which a floor is believed."""
RAISED_M, RAISED_UP = 0.35, -0.5
"""Rise (m) of a raised tracker, and component of a raised hand's direction along the vertical."""
NO_CONTROLLER_DEG = 50.0
"""Angle between a hanging hand and a controller's nominal seat above which it is no controller that is held."""


class SetupEstimation:
    """Finds the set-up of one wearer. `look` and `see` never raise for what devices send.

    By itself it starts as soon as possible; `guided`, step after step, each of which can be skipped and done again.
    """

    def __init__(
        self,
        requires: Sequence[str],
        *,
        tracked: bool = True,
        hands: str = "grip",
        height_m: float | None = None,
        skeleton: Skeleton | None = None,
        setup: Setup | None = None,
        guided: bool = False,
    ):
        """`requires`: what the system needs ("head", wrists); `tracked`: whether wrists are poses rather than watches.

        `hands` is what hand poses are (`setup.hand_seat`, or "auto": by how arms bend), `skeleton` the one that is scaled, and
        `setup` that of last time. Raises WearcapError for a height that is no person's.
        """
        self.requires, self.tracked, self.hands, self.guided = tuple(requires), tracked, hands, guided
        self.before, self.skeleton = setup, skeleton or xsens23()
        self.height_m = height_m
        if height_m is not None:
            self.skeleton = skeleton_of_height(height_m, self.skeleton)
        elif setup is not None:
            self.skeleton, self.height_m = setup.skeleton, setup.skeleton.stature
        self.found: Setup | None = None
        self.notes: list[str] = []
        self.aligned: list[Aligned] = []
        """What was found of the watches' clocks, for the one who keeps them to take away: their next samples should count
        it. It is of the clocks that run, not of the set-up."""
        self.late_s = 0.0
        """Time (s) by which samples of the latest watch are known to come after the head's of the same time."""
        self._seen: dict[str, Seen] = {}
        self._seats: dict[str, Seat] = {}
        """Found so far, by device."""
        self._head, self._floor_m, self._own_floor_m = head_seat(), None, None
        self._measured = False
        """Whether the height is known better than by the default."""
        self._source = "unknown"
        """What the head's path showed of the height (`tracking.stature.source_of`)."""
        self._hanging: dict[str, Tensor] = {}
        """Orientation of hanging devices, "time 3 3"."""
        self._hanging_m: dict[str, float] = {}
        self._heading = 0.0
        """Heading (rad) of the wearer whose arms hang."""
        self._looked_s = self._begun_s = self._step_s = -math.inf
        self._hold_s = -math.inf
        """Time (s, head's clock) since which the wearer does as the step says."""
        self._progress, self._reason = 0.0, ""
        self._steps = [STAND, ARMS, TURN, RAISE, WALK]
        if setup is not None and HEAD in setup.seats:
            self._head = setup.seats[HEAD]

    # --- what the page asks ---------------------------------------------------------------------------------------

    @property
    def step(self) -> Step | None:
        """The guided step that is going on; None when not guided, and at the end."""
        if not self.guided or self.found is not None or not self._steps:
            return None
        name = self._steps[0]
        return Step(name, SENTENCES[name], min(max(self._progress, 0.0), 1.0), self._reason)

    def skip(self) -> None:
        """Leave the step with its default."""
        if self.step is not None:
            self._leave(f"{SENTENCES[self._steps[0]][:-1]!r} was skipped: a default stands for what it finds.")

    def redo(self) -> None:
        """Begin the step again."""
        self._step_s = self._looked_s
        self._again("")

    # --- samples --------------------------------------------------------------------------------------------------

    def see(self, device: str, sample: Any, now_s: float) -> None:
        """Take in a device's sample, on the head's clock; `now_s` is our time."""
        if self.found is not None:
            return
        match sample:
            case SuitPiece() if HEAD not in self.requires:
                self.skeleton = self.skeleton if self.height_m is not None else sample.suit.skeleton
                self._finish()
            case HeadSample(T_world_device=pose):
                if packets.number_fault(sample.floor_height, packets.MAX_POSITION_M) is None:
                    self._own_floor_m = float(sample.floor_height)  # pyright: ignore[reportArgumentType]
                if isinstance(pose, Rigid):
                    self._add(HEAD, sample.timestamp, pose.R, pose.t, False)
            case WristSample(T_world_joint=pose) if self.tracked:
                if isinstance(pose, Rigid):
                    self._add(device, sample.timestamp, pose.R, pose.t, False)
            case WatchSample() if not self.tracked:
                self._add(device, sample.timestamp, sample.R_world_imu, sample.acc_world, True)
            case _:
                pass
        self.look(now_s)

    def _add(self, device: str, time_s: Any, R: Any, v: Any, watch: bool) -> None:
        """Keep a device's sample if it is valid."""
        if (
            packets.time_fault(time_s)
            or packets.rotation_fault(R)
            or packets.values_fault(v, (3,), packets.MAX_POSITION_M)
        ):
            return
        if device not in self._seen:
            if device not in self.requires and len(self._seen) >= MAX_DEVICES:
                return
            self._seen[device] = Seen(watch)
        self._seen[device].add(float(time_s), packets.owned(R), packets.owned(v))

    def look(self, now_s: float) -> None:
        """Go on with what has been seen; to be called now and then also when no samples come."""
        if self.found is not None or now_s < self._looked_s + LOOK_EVERY_S:
            return
        self._looked_s = now_s
        if HEAD not in self._seen:
            self._reason = "The head is not tracked yet."
            if HEAD not in self.requires and self._seen:
                self._finish()
            return
        if self._begun_s == -math.inf:
            self._begun_s = self._step_s = now_s
            self._hold_s = self._now_s
        self._hold_s = min(self._hold_s, self._now_s)  # the device's clock may have been set anew
        self._known_devices()
        if self.guided:
            self._guide(now_s)
        else:
            self._start_soon(now_s)

    @property
    def _now_s(self) -> float:
        """Newest time (s) on the head's clock."""
        return self._seen[HEAD].newest_s if HEAD in self._seen else -math.inf

    def _window(self, device: str, start_s: float) -> Window | None:
        """Samples of a device since a time (s, head's clock), in the head's case of the head joint.

        Of a device whose samples come late, up to `LAG_S` beyond what is known of it, as many from before.
        """
        if device not in self._seen:
            return None
        now_s = self._now_s
        lag_s = min(max(now_s - self._seen[device].newest_s, 0.0), LAG_S + self.late_s)
        found = self._seen[device].between(start_s - lag_s, now_s - lag_s)
        if found is None or device != HEAD:
            return found
        return placement.head_of(found, Rigid(self._head.R_joint_device, self._head.t_joint_device))

    # --- devices --------------------------------------------------------------------------------------------------

    @property
    def _wrists(self) -> tuple[str, ...]:
        return tuple(joint for joint in WRISTS if joint in self.requires)

    @property
    def _missing(self) -> tuple[str, ...]:
        """Required wrists on which no device is known."""
        taken = {seat.joint for seat in self._seats.values()}
        return tuple(joint for joint in self._wrists if joint not in taken)

    @property
    def _unplaced(self) -> list[str]:
        return [device for device in self._seen if device != HEAD and device not in self._seats]

    def _known_devices(self) -> None:
        """Seat devices that say where they are, and those of last time."""
        for device in self._unplaced:
            seat = self.before.seats.get(device) if self.before is not None else None
            if seat is None and device in WRISTS:
                seat = self._nominal(device)
            if seat is not None and seat.joint in self._missing:
                self._seats[device] = replace(seat, yaw_rad=0.0)

    def _nominal(self, joint: str) -> Seat:
        return hand_seat(joint, ("grip" if self.hands == AUTO else self.hands) if self.tracked else "joint")

    # --- by itself ------------------------------------------------------------------------------------------------

    def _start_soon(self, now_s: float) -> None:
        """Finish as soon as everything is known, or time is over."""
        waited = now_s - self._begun_s
        head = self._window(HEAD, self._now_s - HOLD_S)
        if not self._measured and self.height_m is not None:
            early = self._window(HEAD, self._now_s - SHORT_S)
            self._measured = early is not None and self._measure(early)
        elif not self._measured and head is not None and self._is_standing(head):
            self._measured = self._measure(head)
        placed = not self._missing and (self.tracked or not self._wrists)
        arms = placed or (head is not None and self._see_arms(head, waited))
        late = waited > (DEVICES_S if self._missing or not arms else SOON_S)
        if (self._measured and arms) or late:
            if not self._measured:
                self._measure_path()
            self._finish()

    def _measure_path(self) -> None:
        """Height of a wearer who did not stand still, from how high the head is carried, else the default."""
        path = self._window(HEAD, max(self._now_s - SOON_S, self._hold_s))
        if path is not None and self._measure(path, 0.9):
            self.notes.append("The height is rough: the wearer did not stand still.")
        else:
            self._default_height(", since the wearer did not stand still on a known floor")

    def _is_standing(self, head: Window) -> bool:
        return not _sways(head) and rotation.mean_rotation(head.R)[2, 2].item() > 0.8

    def _see_arms(self, head: Window, waited: float) -> bool:
        """Whether each wrist's device is known with its seat; looks at hands that are below a head."""
        windows = {device: self._window(device, self._now_s - HOLD_S) for device in self._seen if device != HEAD}
        seen = {device: window for device, window in windows.items() if window is not None}
        if self.tracked:
            if self._missing:
                self._place_trackers(head, seen)
            return not self._missing
        late = waited > SOON_S
        if self._missing:
            self._place_watches(seen, sure=late)
        worn = [device for device, seat in self._seats.items() if seat.joint in WRISTS and device in self._seen]
        if self._missing or any(device not in seen for device in worn):
            return False
        still = not _sways(head) and not any(placement.moves(seen[device], True) for device in worn)
        if not still and not late:
            return False
        self._heading = rotation.yaw_of(rotation.mean_rotation(head.R)).item()
        for device in worn:
            self._hanging[device] = seen[device].R
            self._seat_watch(device, rough=True)
        return True

    # --- measuring ------------------------------------------------------------------------------------------------

    def _measure(self, head: Window, upright: float = 0.5) -> bool:
        """Height and floor of a wearer by the quantile of the head's height that is upright; whether the height is known."""
        head_m = head.v[:, 2].quantile(upright).item()
        floor_m, self._source = self._floor_below(head_m), "unknown"
        if self.height_m is None:
            if floor_m is None:
                return False
            height_m = height_over(head_m - floor_m, self.skeleton, 1.0)
            self._source = source_of(height_m, head.timestamps, head.v)
            if self._source != "head":
                self._floor_m = None if self._source == "unknown" else floor_m
                return False
            self.skeleton = skeleton_of_height(height_m, self.skeleton)
            self.notes.append(f"Height: {height_m:.2f} m, from the head {head_m - floor_m:.2f} m above the floor.")
        else:
            how = "of last time" if self.before is not None and self.before.skeleton is self.skeleton else "as given"
            self.notes.append(f"Height: {self.skeleton.stature:.2f} m, {how}.")
        if floor_m is None and self.guided:
            floor_m = head_m - self.skeleton.height_of("head")
            self.notes.append(f"Floor: at {floor_m:.2f} m, below the standing head.")
        elif floor_m is None:
            self.notes.append("Floor: not known yet; it is followed from the head's path.")
        else:
            self.notes.append(f"Floor: at {floor_m:.2f} m, as the device says.")
        self._floor_m = floor_m
        return True

    def _default_height(self, why: str = "") -> None:
        """Note that the default stands for the height; somebody who sits is the reason before any other."""
        why = why if self._source == "unknown" else f" ({UNKNOWN[self._source]})"
        guide = "" if self.guided else ", or use the guided first minute"
        self.notes.append(f"Height: the default of {self.skeleton.stature:.2f} m{why}. Give the height{guide}.")

    def _floor_below(self, head_m: float) -> float | None:
        """Floor height (m) that is believed below an upright head joint at `head_m`: the device's, that of last time, 0."""
        low, high = placement.HEAD_M
        if self.height_m is not None:
            upright = self.skeleton.height_of("head")
            low, high = upright - AGREE_M, upright + AGREE_M
        before = None if self.before is None else self.before.floor_m
        candidates = (self._own_floor_m, before, 0.0)
        return next((one for one in candidates if one is not None and low <= head_m - one <= high), None)

    def _place_trackers(self, head: Window, seen: dict[str, Window]) -> None:
        """Find the hands among trackers of unknown place, by the side of the head on which they are."""
        places = {device: placement.placed(head, seen[device]) for device in self._unplaced if device in seen}
        above = None if self._floor_m is None else head.v[:, 2].median().item() - self._floor_m
        for device, joint in placement.sides_of(places, self._missing, above).items():
            self._seats[device] = self._nominal(joint)
            self._note(joint, f"{device!r}, {abs(places[device].left_m):.2f} m to that side of the head.")

    def _place_watches(self, seen: dict[str, Window], sure: bool) -> None:
        """Find the sides of watches of unknown place: by how watches are usually worn, at last (`sure`) by their names."""
        for device in sorted(device for device in self._unplaced if device in seen):
            joint = placement.watch_side(seen[device].R)
            missing = self._missing
            if joint in missing and joint is not None:
                self._seats[device] = self._nominal(joint)
                self._note(joint, f"{device!r}, as watches are usually worn. Check it on the page.")
            elif sure and missing:
                self._seats[device] = self._nominal(missing[0])
                self._note(missing[0], f"{device!r}, by the order of names. Check it on the page.")

    def _seat_watch(self, device: str, rough: bool) -> None:
        """Seat and heading of a watch on a hanging arm."""
        seat, R = self._seats[device], self._hanging[device]
        known = self.before is not None and device in self.before.seats
        mount = None if known else placement.watch_mount(R, seat.joint)
        if mount is not None:
            seat = replace(seat, R_joint_device=mount)
        R_ref_joint = R @ seat.R_joint_device.mT
        if not known and mount is None:
            self._note(seat.joint, "its z axis is along the arm; taken as mounted along the joint.")
        elif not placement.arm_is_down(R_ref_joint, seat.joint):
            self._note(seat.joint, "the arm did not hang; its heading is a guess.")
        yaw = placement.hanging_yaw(R_ref_joint, seat.joint, self._heading)
        self._seats[device] = replace(seat, yaw_rad=yaw)
        if rough:
            self._note(seat.joint, "seat and heading are rough, from an arm that hangs.")

    # --- guided ---------------------------------------------------------------------------------------------------

    def _guide(self, now_s: float) -> None:
        """Go on with the step; a step that is not needed is passed."""
        while self._steps and not self._needed(self._steps[0]):
            self._next()
        if not self._steps:
            self._finish()
            return
        if getattr(self, f"_{self._steps[0]}")():  # `_stand`, `_arms`, `_turn`, `_raise`, `_walk`
            self._next()
        elif now_s - self._step_s > STEP_S:
            self._leave(f"{SENTENCES[self._steps[0]][:-1]!r} took too long: a default stands for what it finds.")

    def _needed(self, step: str) -> bool:
        if step == STAND:
            return True
        if step == RAISE:
            candidates = [device for device in self._hanging if device not in self._seats]
            return bool(self._missing and candidates)
        return bool(self._wrists) if step == ARMS else bool(self._wrists) and not self.tracked

    def _next(self) -> None:
        self._steps.pop(0)
        self.redo()

    def _again(self, reason: str) -> bool:
        """The wearer does not do as the step says, for a reason; False."""
        self._hold_s, self._progress, self._reason = self._now_s, 0.0, reason
        return False

    def _name(self, device: str) -> str:
        """A device by its joint, if that is known, at the beginning of a sentence."""
        return _plain(self._seats[device].joint if device in self._seats else device)

    def _note(self, joint: str, what: str) -> None:
        self.notes.append(f"{_plain(joint)}: {what}")

    def _leave(self, note: str) -> None:
        """Leave the step with a note and what can be known without it."""
        self.notes.append(note)
        step = self._steps[0]
        head = self._window(HEAD, self._now_s - HOLD_S)
        if step == STAND and (head is None or not self._measure(head)):
            self._default_height()
        elif step in (ARMS, RAISE) and head is not None:
            self._see_arms(head, math.inf)
        self._next()

    def _hold(self, devices: Sequence[str]) -> bool:
        """Whether the head and some devices have been still for `HOLD_S`; keeps progress and reason."""
        self._hold_s = max(self._hold_s, self._now_s - HOLD_S - 0.2)
        for device in (HEAD, *devices):
            window = self._window(device, max(self._hold_s, self._now_s - 0.6))
            whole = self._window(device, self._hold_s)
            name = self._name(device)
            if self._now_s - self._hold_s < 0.5:
                continue
            if window is None or whole is None:
                return self._again(f"{name} sends nothing.")
            if _sways(whole) if device == HEAD else placement.moves(whole, self._seen[device].watch):
                return self._again(f"{name} still moves.")
        held = self._now_s - self._hold_s
        self._progress = held / HOLD_S
        if held >= 1.0:
            self._reason = ""
        return held >= HOLD_S

    def _stand(self) -> bool:
        if not self._hold(()):
            return False
        raw = self._seen[HEAD].between(self._hold_s, self._now_s)
        level = None if raw is None else placement.level_head(raw.R)
        if level is None:
            return self._again("Look straight ahead.")
        self._head = replace(self._head, R_joint_device=level)
        head = self._window(HEAD, self._hold_s)
        assert head is not None
        if not self._measure(head):
            self._default_height(", since the floor is not known")
            if self._floor_m is None:
                self._floor_m = head.v[:, 2].median().item() - self.skeleton.height_of("head")
        return True

    def _arms(self) -> bool:
        devices = [device for device in self._seen if device != HEAD]
        if len(devices) < len(self._wrists):
            self._reason = (
                f"{len(self._wrists) - len(devices)} of {len(self._wrists)} devices of the hands send nothing."
            )
            return False
        if not self._hold(devices):
            return False
        windows = {device: self._window(device, self._hold_s) for device in (HEAD, *devices)}
        head = windows[HEAD]
        seen = {device: window for device, window in windows.items() if window is not None and device != HEAD}
        if head is None:
            return False
        self._heading = rotation.yaw_of(rotation.mean_rotation(head.R)).item()
        if self.tracked:
            raised = next((device for device, one in seen.items() if placement.placed(head, one).below_m < 0.25), None)
            if raised is not None:
                return self._again(f"{self._name(raised)} is not down yet.")
            self._place_trackers(head, seen)
        self._hanging = {device: window.R for device, window in seen.items()}
        self._hanging_m = {device: window.v[:, 2].median().item() for device, window in seen.items()}
        for device, seat in list(self._seats.items()):
            if seat.joint in WRISTS and device in self._hanging:
                self._seat_hanging(device)
        return True

    def _seat_hanging(self, device: str) -> None:
        """Seat of a device of a known, hanging hand."""
        if not self.tracked:
            self._seat_watch(device, rough=False)
            return
        seat, R = self._seats[device], rotation.mean_rotation(self._hanging[device])
        R_world_joint = placement.hanging(seat.joint, self._heading)
        off = math.degrees(rotation.geodesic(R @ seat.R_joint_device.mT, R_world_joint).item())
        if off > NO_CONTROLLER_DEG and self.before is None:
            self._seats[device] = replace(
                seat, R_joint_device=R_world_joint.mT @ R, t_joint_device=0 * seat.t_joint_device
            )
            self._note(seat.joint, f"{device!r} is not held like a controller; seated by the hanging arm.")

    def _turn(self) -> bool:
        """Find the offsets of watches' clocks once all have turned to and fro, and rest again.

        What is not found within `STEP_S` is left as it is.
        """
        start_s = max(self._hold_s - HOLD_S, self._now_s - placement.KEEP_S + 1.0)
        worn = [device for device in self._seen if device in self._seats or (device != HEAD and self._missing)]
        watches = {device: self._track(device, start_s) for device in worn}
        head, over = self._track(HEAD, start_s), self._looked_s - self._step_s > STEP_S
        names = {device: self._name(device) for device in watches}
        self._progress, self._reason = turned({"Head": head, **{names[device]: watches[device] for device in watches}})
        if not watches or (self._progress < 1.0 and not over):
            return over
        found = {device: aligned_by_turning(head, track, device, names[device]) for device, track in watches.items()}
        if not over and not all(sure for _, sure in found.values()):
            self._reason = "Once more, head and body together, arms hanging."
            return False
        for device, (aligned, _) in found.items():
            self.aligned.append(aligned)
            self._seen[device].shift(aligned.offset_s)
        self.late_s += max(0.0, *(-aligned.offset_s for aligned in self.aligned))
        return True

    def _track(self, device: str, start_s: float) -> Trajectory | None:
        """Poses of a device from a time (s) on its own clock to its newest one."""
        found = self._seen[device].between(start_s, self._seen[device].newest_s)
        return None if found is None else Trajectory(*found)

    def _raise(self) -> bool:
        candidates = [device for device in self._hanging if device not in self._seats]
        risen = {device: self._rise(device) for device in candidates}
        self._progress = max(0.0, *risen.values()) if risen else 0.0
        raised = [device for device, share in risen.items() if share >= 1.0]
        if len(raised) != 1:
            self._reason = "Only the left one." if raised else ""
            return False
        others = [device for device in candidates if device not in raised]
        for joint, device in zip(WRISTS, [*raised, *others[:1]]):
            if joint in self._missing:
                self._seats[device] = self._nominal(joint)
                self._note(joint, f"{device!r}, by the raised left hand.")
                self._seat_hanging(device)
        return True

    def _rise(self, device: str) -> float:
        """How far a hand is raised, 1 or more when it is up."""
        window = self._window(device, self._now_s - 0.5)
        if window is None:
            return 0.0
        if self.tracked:
            return (window.v[:, 2].median().item() - self._hanging_m[device]) / RAISED_M
        hand = -rotation.mean_rotation(self._hanging[device])[2]  # downwards while it was down, in the watch's axes
        up = (rotation.mean_rotation(window.R) @ hand)[2].item()
        return (up + 1) / (RAISED_UP + 1)

    def _walk(self) -> bool:
        head = self._window(HEAD, max(self._hold_s, self._now_s - placement.KEEP_S + 1.0))
        if head is None:
            self._reason = "" if self._now_s - self._hold_s < 1.0 else "The head is not tracked."
            return False
        walk = placement.walk_of(head)
        shown = walk.before(self._now_s - self.late_s)
        self._progress = shown.seconds / WALKED_S
        self._reason = "" if walk.seconds else "You are not walking yet."
        if shown.seconds < WALKED_S:
            return False
        for device, seat in list(self._seats.items()):
            watch = None if seat.joint not in WRISTS else self._window(device, head.timestamps[0].item())
            guess = seat.yaw_rad
            yaw = None if watch is None else placement.swing_yaw(walk, watch, seat.R_joint_device, seat.joint, guess)
            if yaw is not None:
                self._seats[device] = replace(seat, yaw_rad=yaw)
                self._note(seat.joint, "its heading is by the swing of the arm while walking.")
            elif seat.joint in WRISTS:
                self._note(seat.joint, "the arm hardly swings; its heading is by the hanging arm, rough.")
        return True

    # --- end ------------------------------------------------------------------------------------------------------

    def _seat_hands(self) -> None:
        """Seat what hands hold by how the arms were seen, but for devices that are known from last time."""
        start_s, known = self._now_s - HOLD_S, {} if self.before is None else self.before.seats
        head = self._seen[HEAD].between(start_s, self._now_s) if HEAD in self._seen else None
        seats = {device: seat for device, seat in self._seats.items() if seat.joint in WRISTS and device not in known}
        seen = {seat.joint: found for device, seat in seats.items() if (found := self._window(device, start_s))}
        if head is not None and seen:
            family, sure = most_likely_seat(Trajectory(*head), {joint: Trajectory(*one) for joint, one in seen.items()})
            self._seats |= {device: hand_seat(seat.joint, family) for device, seat in seats.items()}
            self.notes.append(f"Hands hold {SEATS[family].label}, {100 * sure:.0f} % sure by the arms (else: hands=…).")

    def _finish(self) -> None:
        """Write up what was found; required wrists without a device get the nominal seat under their own name."""
        for joint in self._missing:
            self._note(joint, "no device was seen.")
            self._seats[joint] = self._nominal(joint)
        if self.tracked and self.hands == AUTO:
            self._seat_hands()
        seats = {device: seat for device, seat in self._seats.items() if seat.joint in WRISTS}
        if HEAD in self.requires:
            seats[HEAD] = self._head
        self.found = Setup(self.skeleton, seats, self._floor_m, tuple(self.notes))


def _sways(head: Window) -> bool:
    """Whether a head moves more than that of someone who stands; it may turn."""
    return (head.v - head.v.median(0).values).norm(dim=-1).max().item() > placement.STILL_M


def _plain(joint: str) -> str:
    """A device's joint, as a word at the beginning of a sentence."""
    return joint.replace("_", " ").capitalize() if joint in (HEAD, *WRISTS) else repr(joint)
