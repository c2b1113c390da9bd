"""Places outdoors, and a wearer who walks, runs and sits there: over kerbs, up stairs, on the ramp."""

import numpy as np
import pytest
import torch

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearcap.recording.serialize import flatten
from wearsim.people.actions import ACTIVITIES
from wearsim.people.person import draw_person
from wearsim.people.wearer import simulate_motion
from wearsim.places.outdoor import build_outdoor
from wearsim.places.outline import points_in_convex
from wearsim.recordings.simulate import SimulationConfig, simulate_recording

FPS = 60.0
SEEDS = range(4)


@pytest.fixture(scope="module", params=SEEDS)
def place(request):
    return build_outdoor(np.random.default_rng(request.param), "place")


@pytest.fixture(scope="module")
def walks():
    """(world, 60 s of motion) for some places and people."""
    made = []
    for seed in SEEDS:
        world = build_outdoor(np.random.default_rng(seed), "place")
        person = draw_person("somebody", np.random.default_rng(50 + seed))
        made.append((world, simulate_motion(world, person, np.random.default_rng(seed), 60.0)))
    return made


@pytest.fixture(scope="module")
def up_and_down():
    """90 s of nothing but walking from place to place."""
    world = build_outdoor(np.random.default_rng(1), "place")
    person = draw_person("somebody", np.random.default_rng(3))
    return world, simulate_motion(world, person, np.random.default_rng(0), 90.0, FPS, ["walk"])


def patches_of(motion):
    """Positions of `FOOT_PATCHES` in the world (m), time patch 3."""
    sites = [motion.skeleton.sites[name] for name in FOOT_PATCHES]
    return torch.stack([motion.joint(s.joint) @ torch.tensor(s.t_joint_site) for s in sites], 1)


def over(world, motion, kind: str):
    """Whether the pelvis is above a surface of a kind."""
    xy = motion.t_world_root[:, :2].double().numpy()
    return np.any([points_in_convex(xy, s.polygon) for s in world.surfaces if s.kind == kind], axis=0)


def test_kerbs_ramps_and_stairs_have_street_sizes(place):
    for surface in place.surfaces:
        a, b, _ = surface.plane
        assert np.hypot(a, b) <= 0.1001
        assert (np.hypot(a, b) > 0.05) == (surface.kind == "ramp")
    flights = [f for f in place.places.flights if f.steps > 1]
    assert len(flights) == 1
    assert 0.149 < flights[0].rise < 0.171
    assert 0.299 < flights[0].tread < 0.321
    kerbs = [f for f in place.places.flights if f.steps == 1]
    assert kerbs
    assert all(0.099 < kerb.rise < 0.151 for kerb in kerbs)
    assert {s.kind for s in place.surfaces} == {"floor", "kerb", "ramp", "stairs_step"}


def test_the_ramp_meets_the_ground_and_the_terrace(place):
    ramp = max((s for s in place.surfaces if s.kind == "ramp"), key=lambda s: np.ptp(s.height(s.polygon)))
    height = ramp.height(ramp.polygon)
    top = next(f.top_z for f in place.places.flights if f.steps > 1)
    kerb = next(f.rise for f in place.places.flights if f.steps == 1)
    np.testing.assert_allclose([height.min(), height.max()], [kerb, top], atol=1e-6)
    inner = ramp.polygon.mean(0) + 0.9 * (ramp.polygon - ramp.polygon.mean(0))
    np.testing.assert_allclose(place.floor_height(inner, ramp.height(inner)), ramp.height(inner), atol=1e-9)


def test_terrace_street_and_seats_hang_together(place):
    rng = np.random.default_rng(0)
    points = place.navigation.node_points
    high, low = points[points[:, 2].argmax()], points[points[:, 2].argmin()]
    assert high[2] - low[2] > 0.5
    path = place.plan_path(low, high, rng)
    assert path is not None
    assert np.abs(np.diff(path[:, 2])).max() < 0.18, "one step at a time"
    assert place.places.seats
    assert place.places.reach_targets
    for seat in place.places.seats:
        assert place.plan_path(low, seat.standing_point(), rng) is not None


def test_kerbs_are_stepped_over_only_where_they_can(place):
    """Wherever two walkable neighbours lie a step apart, a flight (kerb or stairs) is there to time the feet."""
    grid = place.navigation
    height = np.where(grid.walkable[0], grid.height[0], np.nan)
    edge = np.abs(np.diff(height, axis=0)) > 0.05
    cells = np.argwhere(edge)
    points = grid.origin + (cells + np.array([1.0, 0.5])) * grid.cell
    known = np.zeros(len(points), bool)
    for flight in place.places.flights:
        run, side = flight.up_and_left(points)
        known |= (run > -0.2) & (run < flight.length + 0.2) & (np.abs(side) < flight.width / 2)
    assert len(points)
    assert known.all()


def test_feet_in_contact_stand_still_on_what_is_below(walks, up_and_down):
    for world, simulated in [*walks, up_and_down]:
        patches = patches_of(simulated.motion)
        speed = (patches[1:, :, :2] - patches[:-1, :, :2]).norm(dim=-1) * FPS
        still = simulated.contact[1:] & simulated.contact[:-1]
        assert speed[still].mean() < 0.002
        assert speed[still].max() < 0.02
        points = patches.double().numpy()
        floor = torch.from_numpy(world.floor_height(points[..., :2], points[..., 2]))
        below = (floor - points[..., 2]).nan_to_num(nan=-1.0)
        assert below[simulated.contact].max() < 0.005
        assert below[simulated.contact].min() > -0.02
        assert below.max() < 0.035, "no swing passes through a kerb"
        assert (below > 0.005).double().mean() < 0.002


def test_on_the_ramp_the_floor_is_the_ramps_plane(up_and_down):
    world, simulated = up_and_down
    motion = simulated.motion
    ramp = max((s for s in world.surfaces if s.kind == "ramp"), key=lambda s: np.ptp(s.height(s.polygon)))
    inside = ramp.polygon.mean(0) + 0.8 * (ramp.polygon - ramp.polygon.mean(0))
    xy = motion.t_world_root[:, :2].double().numpy()
    on = points_in_convex(xy, inside)
    assert on.sum() > 60
    assert np.abs(simulated.floor_height.numpy()[on] - ramp.height(xy[on])).max() < 0.06
    patches = patches_of(motion)[torch.from_numpy(on)].double().numpy()
    gap = patches[..., 2] - ramp.height(patches[..., :2])
    assert np.abs(gap[simulated.contact.numpy()[on]]).max() < 0.005


def test_kerb_stairs_and_ramp_are_walked(walks, up_and_down):
    runs = [*walks, up_and_down]
    for kind in ("kerb", "stairs_step", "ramp"):
        assert any(over(world, simulated.motion, kind).any() for world, simulated in runs), kind
    climbed = [simulated.floor_height.max() - simulated.floor_height.min() for _, simulated in runs]
    assert max(climbed) > 0.5


def test_no_joint_leaves_its_range_and_nothing_jumps(walks, up_and_down):
    for _, simulated in [*walks, up_and_down]:
        motion = simulated.motion
        turn = rotation.log(motion.R_parent_joint.double())
        for name, limit in (("hip", 125), ("knee", 150), ("elbow", 150)):
            for side in ("left", "right"):
                angle = turn[:, motion.skeleton.index(f"{side}_{name}")]
                assert angle.norm(dim=-1).rad2deg().max() < limit
                if name == "knee":
                    assert angle[:, 1].min() > 0, "knees bend backwards only"
        head = turn[:, motion.skeleton.indices("head", "l5", "t8")].norm(dim=-1).rad2deg()
        assert head.max() < 80
        position = motion.T_world_joint.t.double()
        acceleration = (position.diff(n=2, dim=0) * FPS**2).norm(dim=-1)
        assert acceleration[:, motion.skeleton.index("pelvis")].max() < 25
        assert acceleration[:, motion.skeleton.index("left_knee")].max() < 300


def test_in_running_the_pelvis_is_low_over_the_standing_leg_and_high_in_flight():
    world = build_outdoor(np.random.default_rng(0), "place")
    person = draw_person("somebody", np.random.default_rng(50))
    simulated = simulate_motion(world, person, np.random.default_rng(0), 40.0, FPS, ["run"])
    motion = simulated.motion
    speed = (motion.t_world_root[1:, :2] - motion.t_world_root[:-1, :2]).norm(dim=-1) * FPS
    fast = torch.nn.functional.pad(speed, (1, 0)) > 2.2
    assert fast.sum() > 60
    height = motion.t_world_root[:, 2] - simulated.floor_height
    flight = fast & ~simulated.contact.any(-1)
    stance = fast & simulated.contact.any(-1)
    assert flight.sum() > 5
    assert height[flight].mean() > height[stance].mean() + 0.01


def test_more_running_outdoors():
    assert ACTIVITIES["run"].outdoors > 1
    assert all(activity.outdoors >= 1 for activity in ACTIVITIES.values())


def test_an_outdoor_recording_is_seen_and_repeats():
    config = SimulationConfig(duration_s=5.0, world="outdoor")
    first, again = (simulate_recording(config, "one", "train", 5) for _ in range(2))
    assert "outdoor" in first.location
    assert len(first.points.points_world) > 500
    one, two = flatten(first)[1], flatten(again)[1]
    assert one.keys() == two.keys()
    assert all(torch.equal(one[key], two[key]) for key in one)
