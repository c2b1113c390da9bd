"""Which frames a batch's windows consist of and what is read of them: as each window was cut and read on its own."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.rivals.single_windows import transforms as before
from drawn_windows import single
from wearcap.body.skeleton import xsens23
from wearcap.data import batch as batches
from wearcap.data.batch import Batch, Rows
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, Track, joined, quantized
from wearcap.data.transforms import joint_twins
from wearcap.geometry import rotation
from wearcap_testing import swaying_motion

SKELETON, COUNT = xsens23(), 20
SENSED = frozenset({"R_world_head", "t_world_head", "floor_height"})
TWINS = {name: joint_twins(SKELETON) for name in ("R_parent_joint", "t_parent_joint")}
TWINS |= {name: [1, 0] for name in ("acc_world_wrist", "foot_contact")}
SPEED, LATER = torch.tensor([0.85, 1.2, 1.0, 1.13]), torch.tensor([3.0, 0.25, 60.0, 1.75])
KEPT = torch.rand(4, 27, generator=torch.Generator().manual_seed(0)) > 0.3
KEPT[:, [0, 21, 26]] = True
CASES = {
    "whole frames": {},
    "every second frame": {"step": 2},
    "some frames later": {"later": LATER.long()},
    "between frames": {"later": LATER.double()},
    "slower and faster": {"speed": SPEED, "stretch": 1.25},
    "dropped frames": {"kept": KEPT[:, :22]},
    "dropped frames at another speed": {"kept": KEPT, "speed": SPEED, "stretch": 1.25},
    "early end": {"end": torch.tensor([7, 20, 1, 12])},
    "still start": {"begin": torch.tensor([0, 4, 17, 9]), "later": LATER.double()},
    "all at once": {
        "step": 2,
        "speed": SPEED,
        "stretch": 1.25,
        "later": LATER.double(),
        "begin": torch.tensor([0, 4, 2, 9]),
        "end": torch.tensor([7, 20, 6, 12]),
    },
}


def track(frames: int, seed: int) -> Track:
    motion, random = swaying_motion(frames, seed), torch.Generator().manual_seed(seed)
    body, wrists = motion.T_world_joint, SKELETON.indices("left_wrist", "right_wrist")
    values = {
        "R_parent_joint": motion.R_parent_joint,
        "R_world_head": body.R[:, SKELETON.index("head")],
        "t_world_head": body.t[:, SKELETON.index("head")],
        "vel_world_root": torch.randn(frames, 3, generator=random),
        "acc_world_wrist": body.t[:, wrists],
        "floor_height": torch.randn(frames, generator=random),
        "foot_contact": torch.rand(frames, 2, generator=random) < 0.5,
        "object": (torch.arange(frames) // 10 % 3 - 1).int(),
    }
    constants = {"t_parent_joint": SKELETON.t_parent_joint + 0.01 * seed, "size": torch.rand(5, generator=random)}
    return Track(values, constants, {"object": torch.randn(2, 3, generator=random)})


TRACKS = [track(*each) for each in ((70, 0), (14, 1), (90, 2))]  # one is shorter than a window
PACKED = Packed(*joined([each.packed() for each in TRACKS], ["a", "b", "c"]))


def batch(**changes) -> Batch:
    """Four windows, one of which begins near the end of its recording."""
    order = {name: torch.tensor(twins) for name, twins in TWINS.items()}
    which, start = torch.tensor([0, 2, 1, 2]), torch.tensor([5, 10, 0, 60])
    return Batch(PACKED, Draws(torch.arange(4)), which, start, COUNT, 60.0, twins=order, sensed=SENSED, **changes)


def close(found: torch.Tensor, expected: torch.Tensor, name: str, off_deg: float = 0.02) -> None:
    """Alike, rotations but for the bits that they are kept in."""
    limit = torch.tensor(off_deg).deg2rad().item() if name.startswith("R_") else 1e-4
    torch.testing.assert_close(found.float(), expected.float(), atol=limit, rtol=0, msg=lambda text: f"{name}: {text}")


@pytest.mark.parametrize("case", CASES)
def test_values_are_those_of_each_window_on_its_own(case):
    changes = CASES[case]
    whole = batch(**changes).read()
    assert set(whole.values) == {*TRACKS[0].values, *TRACKS[0].constants}
    for number in range(4):
        mine = {name: value[number] if torch.is_tensor(value) else value for name, value in changes.items()}
        recording, later = TRACKS[whole.track[number]], mine.pop("later", torch.tensor(0)).item()
        shown = (int(mine.pop("begin", 0)), int(mine.pop("end", COUNT)))
        speed = mine.pop("speed", torch.tensor(torch.nan)).item()
        cut = before.Cut(
            whole.start[number].item() + later,
            COUNT,
            len(recording.values["object"]),
            shown=shown,
            speed=None if speed != speed else speed,
            **mine,
        )
        if "kept" in mine and number in (2, 3):
            continue  # the frames before interpolated towards a frame beyond the recording's end
        assert torch.equal(whole.valid[number], cut.valid)
        first = PACKED.first[whole.track[number]]
        for name, part in recording.values.items():
            if name == "object":  # rows of the common table
                part = PACKED.values[name][first : first + len(part)]
            close(whole.values[name][number], cut.take(name, part, sensed=name in SENSED), name, 0.2)
        for name, value in recording.constants.items():
            assert torch.equal(whole.values[name][number], value)


def test_a_mirrored_window_is_the_mirror_image():
    flags = torch.tensor([True, False, True, True])
    plain, flipped = batch(speed=SPEED).read(), replace(batch(speed=SPEED), mirrored=flags).read()
    for number, flag in enumerate(flags.tolist()):
        expected = before.mirrored(single(plain, number)) if flag else single(plain, number)
        for name, value in expected.values.items():
            close(flipped.values[name][number], value, name)


def test_nothing_is_interpolated_where_another_object_becomes_active():
    jumps = {"R_world_head": "object", "t_world_head": "object"}
    smooth = batch(speed=SPEED, later=LATER.double())
    found, rows = replace(smooth, jumps=jumps).read().values, smooth.rows()
    changes = PACKED.values["object"][rows.low] != PACKED.values["object"][rows.high]
    assert changes.any()
    assert torch.equal(found["t_world_head"][changes], PACKED.values["t_world_head"][rows.nearest[changes]])
    for name in jumps:
        assert torch.equal(found[name][~changes], smooth.read().values[name][~changes])


def test_rows_of_tables_are_the_recordings_own_and_none_is_the_last_one():
    table, found = PACKED.tables["object"], batch().read()
    for number, which in enumerate(found.track.tolist()):
        own = torch.cat([TRACKS[which].tables["object"], torch.zeros(1, 3)])
        place = (found.start[number] + torch.arange(COUNT)).clamp_max(len(TRACKS[which].values["object"]) - 1)
        expected = own[TRACKS[which].values["object"][place].long()]
        assert torch.equal(table[found.values["object"][number].long()], expected)


class _Elsewhere(torch.Tensor):
    """A tensor that says that it is on another device, whose code is then taken."""

    device = property(lambda self: torch.device("meta"))  # pyright: ignore[reportAssignmentType]


def test_loops_of_the_cpu_give_what_tensor_code_does_and_the_way_between(monkeypatch):
    random = torch.Generator().manual_seed(3)
    R = rotation.exp(1.5 * torch.randn(50, 23, 3, generator=random))
    rows = Rows(*torch.randint(50, (2, 4, 9), generator=random), torch.rand(4, 9, generator=random).round(decimals=1))
    twins, flip = torch.tensor(TWINS["R_parent_joint"]), torch.tensor([True, False, False, True])
    packed = quantized(R)
    with monkeypatch.context() as patch:
        patch.setattr(batches, "_sides", lambda signs, device: torch.tensor(signs))
        there = batches.matrices(packed, rows._replace(low=rows.low.as_subclass(_Elsewhere)), twins, flip)
    here = batches.matrices(packed, rows, twins, flip)
    torch.testing.assert_close(here, there.as_subclass(torch.Tensor), atol=2e-6, rtol=0)
    between = batches.matrices(packed, rows, None, None)
    torch.testing.assert_close(here[flip], before_mirrored(between[flip]), atol=2e-6, rtol=0)
    near = Slerp([0, 1], Rotation.from_matrix(rotation.exp(torch.tensor([[0.0, 0, 0], [0.3, 0.2, -0.1]])).numpy()))
    two = quantized(torch.from_numpy(near([0, 1]).as_matrix()).float()[:, None])
    share = torch.linspace(0, 1, 11)[None]
    way = batches.matrices(two, Rows(torch.zeros(1, 11).long(), torch.ones(1, 11).long(), share), None, None)
    torch.testing.assert_close(way[0, :, 0], torch.from_numpy(near(share[0]).as_matrix()).float(), atol=5e-4, rtol=0)
    values = torch.randn(50, 2, 3, generator=random)
    torch.testing.assert_close(batches.between(values, rows), batches.between(values.double(), rows).float())


def before_mirrored(R: torch.Tensor) -> torch.Tensor:
    """Rotations of joints, mirrored one window after another."""
    windows = [before.Window({"R_parent_joint": each}, TWINS) for each in R]
    return torch.stack([before.mirrored(each).values["R_parent_joint"] for each in windows])
