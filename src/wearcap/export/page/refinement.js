// Refinement of predicted motion: rotations are smoothed, feet that stand are held. As wearcap.tracking.refinement.

import { add, column, norm, ofTwo, scale, sub } from "./rotation.js";

const REACH = 2.5; // half width of the filter in standard deviations
const NEVER = 1_000_000; // frames to a contact that does not exist

// Of one stretch: frames {local, root, head, floor, contact, …} go in and come out refined.
export class Refiner {
  constructor(settings, skeleton, fps) {
    Object.assign(this, { settings, skeleton, fps });
    this.half = Math.ceil(REACH * settings.smooth);
    this.ahead = settings.feet ? settings.feet.fade + Math.max(settings.feet.settle, settings.feet.shortest) : 0;
    this.before = []; // frames that are smooth, as far as the next ones need them as they were
    this.raw = []; // frames that are not smooth yet
    this.smooth = []; // frames that are smooth, but not final
    this.feet = [newFoot(), newFoot()];
  }

  push(frames, ended = false) {
    this.raw.push(...frames);
    const ready = Math.max(0, this.raw.length - (ended ? 0 : this.half));
    const all = [...this.before, ...this.raw];
    for (let k = 0; k < ready; k++) this.smooth.push(this.#averaged(all, this.before.length + k));
    this.before = this.half ? all.slice(0, this.before.length + ready).slice(-this.half) : [];
    this.raw = this.raw.slice(ready);
    const count = Math.max(0, this.smooth.length - (ended ? 0 : this.ahead));
    const final = this.#held(count);
    this.smooth = this.smooth.slice(count);
    return final;
  }

  // A frame with the average of its neighbours, anchored to the head.
  #averaged(frames, at) {
    const frame = frames[at];
    if (!this.half) return frame;
    const near = [];
    for (let k = Math.max(0, at - this.half); k <= Math.min(frames.length - 1, at + this.half); k++) {
      near.push([Math.exp(-0.5 * ((k - at) / this.settings.smooth) ** 2), frames[k]]);
    }
    const total = near.reduce((sum, [weight]) => sum + weight, 0);
    const local = frame.local.map((_, joint) => {
      const columns = [0, 1].map((k) =>
        near.reduce((sum, [weight, other]) => add(sum, scale(column(other.local[joint], k), weight / total)), [0, 0, 0]));
      return ofTwo(...columns);
    });
    return { ...frame, ...this.skeleton.anchored(local, frame.head) };
  }

  // The first `count` smooth frames with standing feet held; the others are looked at alone.
  #held(count) {
    if (!count || !this.settings.feet) return this.smooth.slice(0, count);
    const poses = this.smooth.map(({ local, root }) => this.skeleton.forward(local, root));
    const soles = poses.map((pose) => this.skeleton.soles(pose));
    const floor = this.smooth.map((frame) => frame.floor);
    const offsets = this.feet.map((before, foot) => {
      const points = soles.map((patches) => patches.slice(2 * foot, 2 * foot + 2));
      const contact = this.smooth.map((frame) => frame.contact[foot]);
      const found = displacements(this.settings.feet, points, contact, floor, this.fps, before);
      this.feet[foot] = found.state(count);
      return found.offset;
    });
    return this.smooth.slice(0, count).map((frame, k) => {
      const bent = this.skeleton.bendLegs(poses[k], [0, 1].map((foot) => offsets[foot][k]));
      return { ...frame, local: this.skeleton.local(bent) };
    });
  }
}

const newFoot = () =>
  ({ believed: false, stands: false, kept: [0, 0, 0], offset: [0, 0, 0], since: NEVER, points: null });

// Displacements (m) of one foot over some frames. As wearcap.tracking.foot_lock.
function displacements(how, points, contact, floor, fps, before) {
  const count = points.length;
  const leak = 1 - 1 / (how.leak_s * fps);
  const low = points.map(([heel, tip]) => (tip[2] < heel[2] ? 1 : 0));
  const step = points.map((here, k) => sub(here[low[k]], (k ? points[k - 1] : before.points ?? points[0])[low[k]]));
  const height = points.map((here, k) => here[low[k]][2]);
  let last = before.believed;
  const believed = contact.map((prob, k) => {
    const sure = norm(step[k]) * fps > how.fastest_m_s ? 0 : prob;
    if (sure > how.begin_prob) last = true;
    else if (sure < how.end_prob) last = false;
    return last;
  });
  const held = new Array(count).fill(false);
  const kept = new Array(count).fill([0, 0, 0]);
  for (let start = 0, stop; start < count; start = stop) {
    for (stop = start + 1; stop < count && believed[stop] === believed[start]; stop++);
    if (!believed[start]) continue;
    const goesOn = start === 0 && before.believed;
    if (goesOn ? !before.stands : stop - start < how.shortest) continue;
    let value = goesOn ? scale(before.kept, leak) : [0, 0, 0];
    for (let k = start; k < stop; k++) {
      value = k === start && !goesOn ? [0, 0, 0] : sub(k === start ? value : scale(value, leak), step[k]);
      kept[k] = value;
      held[k] = true;
    }
    if (goesOn) continue;
    const middle = [0, 1, 2].map((axis) => median(kept.slice(start, Math.min(start + how.settle, stop)).map((v) => v[axis])));
    for (let k = start; k < stop; k++) kept[k] = sub(kept[k], scale(middle, leak ** (k - start)));
  }
  // A standing foot is put on the floor, where that is near; before all stands the last frame of contact that is known.
  const marks = [{ at: -before.since, offset: before.offset }];
  for (let k = 0; k < count; k++) {
    if (!held[k]) continue;
    const [x, y, z] = kept[k];
    const limit = how.farthest_m / Math.max(Math.hypot(x, y), how.farthest_m);
    marks.push({ at: k, offset: [x * limit, y * limit, z + near(floor[k] - height[k] - z, how.floor_within_m)] });
  }
  marks.push({ at: NEVER, offset: [0, 0, 0] });
  let place = 0;
  const offset = points.map((_, k) => {
    if (held[k]) place++;
    const after = marks[Math.min(place + (held[k] ? 0 : 1), marks.length - 1)];
    const out = fading((k - marks[place].at) / (how.fade + 1));
    const into = held[k] ? 0 : fading((after.at - k) / (how.fade + 1));
    const mixed = add(scale(marks[place].offset, out), scale(after.offset, into));
    const value = scale(mixed, 1 / Math.max(out + into, 1));
    value[2] += Math.max(near(floor[k] - height[k] - value[2], how.raise_m), 0);
    return value;
  });
  const state = (final) => {
    const at = held.lastIndexOf(true, final - 1);
    const stood = at < 0 ? {} : { kept: kept[at], offset: offset[at], since: final - at };
    const since = before.since + final;
    return { ...before, since, ...stood, believed: believed[final - 1], stands: held[final - 1], points: points[final - 1] };
  };
  return { offset, state };
}

function median(values) {
  const sorted = values.slice().sort((a, b) => a - b);
  const middle = (sorted.length - 1) / 2;
  return (sorted[Math.floor(middle)] + sorted[Math.ceil(middle)]) / 2;
}

// The gap (m) up to `within`, from there less and less, 0 at twice as much.
const near = (gap, within) => Math.sign(gap) * Math.max(Math.min(Math.abs(gap), 2 * within - Math.abs(gap)), 0);

// From 1 at 0 to 0 at 1, without a jump of the speed.
function fading(share) {
  const rest = 1 - Math.min(Math.max(share, 0), 1);
  return rest * rest * (3 - 2 * rest);
}
