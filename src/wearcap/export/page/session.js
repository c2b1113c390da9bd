// A streaming capture: samples of head and wrists go in, final frames come out. As wearcap.systems.hmd2.stream; the network
// itself is one graph of a whole window, with features and blending.

import { Generator } from "./noise.js";
import { Refiner } from "./refinement.js";
import { EYE, angle, between, lerp, mul, norm, sub, transpose, turned } from "./rotation.js";

const SAME_S = 1e-4; // largest difference (s) of times that count as equal
const STRETCH_SEED = 1_000_003; // between the seeds of stretches, times the number of their first frame
const HANDS = [0, 1];

export class Session {
  // `run`: the graph, from its inputs by name to its output; `floor`: its height (m), null: followed from the head's path.
  constructor(about, run, { skeleton, mount, floor = null, seed = 0, lookahead = about.lookahead }) {
    Object.assign(this, { about, run, skeleton, mount, seed, lookahead });
    this.samples = [];
    this.wrists = HANDS.map(() => []);
    this.frame = 0; // number of the next frame, from the first sample's time on
    this.windows = null; // windows of the present stretch
    this.floor = floor === null ? new FloorTracker(skeleton.headHeight, about) : { below: () => floor };
  }

  // A sample {time (s), head: {R, t} of the device, wrists: [{R, t} or null, …]}; times rise.
  push({ time, head, wrists }) {
    this.start ??= time;
    this.samples.push({ time, ...head });
    HANDS.forEach((hand) => wrists?.[hand] && this.wrists[hand].push({ time, ...wrists[hand] }));
  }

  // Frames that became final since the last call.
  async advance(ended = false) {
    const final = [];
    for (;;) {
      const { frames, stops } = this.#next(ended);
      if (frames.length) {
        this.windows ??= new Windows(this, frames[0].number);
        final.push(...(await this.windows.push(frames)));
      }
      if (stops && this.windows) {
        final.push(...this.windows.finish());
        this.windows = null;
      }
      if (!frames.length && !stops) return final;
    }
  }

  // The next frames, once all their times have passed, and whether a stretch of tracking stops after them.
  #next(ended) {
    const { fps, stride } = this.about;
    const { samples } = this;
    const found = { frames: [], stops: false };
    if (!samples.length) return found;
    let count = 1;
    while (count < samples.length && !this.#breaks(samples[count - 1], samples[count])) count++;
    const cut = count < samples.length;
    const last = samples[count - 1].time;
    if (!this.windows) this.frame = Math.max(this.frame, Math.ceil((samples[0].time - 1e-6 - this.start) * fps));
    const known = Math.floor((last - this.start) * fps + 1e-3) + 1;
    const whole = Math.min(known - this.frame, stride);
    if (!cut && !ended && whole < stride) return found;
    for (let k = 0; k < whole; k++) found.frames.push(this.#frame(this.frame++));
    found.stops = (cut || ended) && this.frame >= known;
    if (found.stops) samples.splice(0, count);
    else this.#forget(samples, 1);
    this.wrists.forEach((track) => this.#forget(track, 1));
    return found;
  }

  #breaks(a, b) {
    const step = b.time - a.time;
    const { max_gap_s, max_speed_m_s, max_turn_rad_s } = this.about;
    return step > max_gap_s || norm(sub(b.t, a.t)) > max_speed_m_s * step || angle(a.R, b.R) > max_turn_rad_s * step;
  }

  // Drop what later frames are not interpolated from.
  #forget(track, kept) {
    const time = this.start + (this.frame - 1) / this.about.fps + SAME_S;
    let first = 0;
    while (first + kept < track.length && track[first + kept].time <= time) first++;
    track.splice(0, first);
  }

  #frame(number) {
    const time = this.start + number / this.about.fps;
    const device = interpolated(this.samples, time);
    const R = mul(device.R, transpose(this.mount.R));
    const head = { R, t: sub(device.t, turned(R, this.mount.t)) };
    const wrists = this.wrists.map((track) => this.#wrist(track, time));
    return { number, time, head, wrists, floor: this.floor.below(head.t), valid: true };
  }

  // Pose of a wrist, null where it was not seen lately; whether it was depends on the past alone.
  #wrist(track, time) {
    const unseen = this.about.unseen_s;
    const before = lastBefore(track, time);
    if (before < 0 || time - track[before].time > unseen) return null;
    const [a, b] = [track[before], track[before + 1] ?? track[before]];
    const step = b.time - a.time;
    const share = step > 0 && step <= unseen ? Math.min(Math.max((time - a.time) / step, 0), 1) : 0;
    return { R: between(a.R, b.R, share), t: lerp(a.t, b.t, share) };
  }
}

function lastBefore(track, time) {
  let [low, high] = [0, track.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (track[middle].time <= time + SAME_S) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

export function interpolated(track, time) {
  const before = Math.max(0, lastBefore(track, time));
  const [a, b] = [track[before], track[before + 1]];
  if (!b || Math.abs(time - a.time) <= SAME_S) return a;
  const share = Math.min(Math.max((time - a.time) / (b.time - a.time), 0), 1);
  return { R: between(a.R, b.R, share), t: lerp(a.t, b.t, share) };
}

// The floor's height by the head's path so far: people are upright for a tenth of any half minute.
class FloorTracker {
  constructor(stature, { fps, upright_within_s, look_frames }) {
    Object.assign(this, { stature, every: look_frames, most: Math.floor((upright_within_s * fps) / look_frames) });
    this.heights = [];
    this.frames = 0;
  }

  below(place) {
    if (this.frames++ % this.every === 0) {
      this.heights.push(place[2]);
      if (this.heights.length > this.most) this.heights.shift();
      this.height = quantile(this.heights, 0.9) - this.stature;
    }
    return this.height;
  }
}

export function quantile(values, share) {
  const sorted = values.slice().sort((a, b) => a - b);
  const at = share * (sorted.length - 1);
  const [low, high] = [Math.floor(at), Math.ceil(at)];
  return sorted[low] + (at - low) * (sorted[high] - sorted[low]);
}

// Overlapping windows over one stretch. Each is predicted anew from the noise of its frames until they are final.
class Windows {
  constructor(session, first) {
    Object.assign(this, { about: session.about, run: session.run, skeleton: session.skeleton });
    this.lookahead = session.lookahead;
    this.random = new Generator(session.seed + STRETCH_SEED * first);
    this.size = Float32Array.from(this.skeleton.size(this.about.limbs));
    this.frames = [];
    [this.taken, this.final] = [0, 0];
    const { refinement, fps } = this.about;
    this.refiner = refinement && new Refiner(refinement, this.skeleton, fps);
  }

  async push(frames) {
    const { stride, window, pose_size } = this.about;
    const noise = this.random.randn(stride * pose_size);
    for (let k = 0; k < stride; k++) {
      const frame = frames[Math.min(k, frames.length - 1)];
      const fresh = { local: this.skeleton.names.map(() => EYE), contact: [0, 0], std: [] };
      const own = noise.subarray(k * pose_size, (k + 1) * pose_size);
      this.frames.push({ ...frame, ...fresh, noise: own, valid: k < frames.length });
    }
    this.frames.splice(0, Math.max(0, this.frames.length - window));
    this.taken += stride;
    await this.#predict();
    return this.#refined(this.#finalized(this.lookahead));
  }

  finish() {
    return this.#refined(this.#finalized(0), true);
  }

  #finalized(lookahead) {
    const missing = this.frames.filter((frame) => !frame.valid).length;
    const before = this.taken - this.frames.length;
    const start = this.final;
    this.final = Math.max(this.final, this.taken - lookahead - missing);
    return this.frames.slice(start - before, this.final - before);
  }

  #refined(frames, ended = false) {
    const anchored = frames.map((frame) => ({ ...frame, ...this.skeleton.anchored(frame.local, frame.head) }));
    return this.refiner ? this.refiner.push(anchored, ended) : anchored;
  }

  async #predict() {
    const { window, pose_size, deviations } = this.about;
    const joints = this.skeleton.names.length;
    const seen = this.frames.length;
    const made = (width, of, kind = Float32Array) => {
      const values = new kind(window * width);
      for (let k = 0; k < window; k++) values.set(of(this.frames[Math.min(k, seen - 1)], k), k * width);
      return values;
    };
    const isFinal = this.final - this.taken + seen;
    const output = await this.run({
      head_rotation: [made(9, (frame) => frame.head.R), [1, window, 3, 3]],
      head_position: [made(3, (frame) => frame.head.t), [1, window, 3]],
      floor_height: [made(1, (frame) => [frame.floor]), [1, window]],
      wrist_rotation: [made(18, (frame) => frame.wrists.flatMap((hand) => hand?.R ?? EYE)), [1, window, 2, 3, 3]],
      wrist_position: [made(6, (frame) => frame.wrists.flatMap((hand) => hand?.t ?? [0, 0, 0])), [1, window, 2, 3]],
      seen: [made(2, (frame) => frame.wrists.map(Boolean), Uint8Array), [1, window, 2]],
      valid: [made(1, (frame, k) => [frame.valid && k < seen], Uint8Array), [1, window]],
      size: [this.size, [1, this.size.length]],
      noise: [made(pose_size, (frame) => frame.noise), [1, window, pose_size]],
      joint_rotation: [made(9 * joints, (frame) => frame.local.flat()), [1, window, joints, 3, 3]],
      foot_contact: [made(2, (frame) => frame.contact), [1, window, 2]],
      is_final: [made(1, (_, k) => [k < isFinal], Uint8Array), [1, window]],
    });
    const width = 9 * joints + 2 + deviations;
    for (let k = Math.max(0, isFinal); k < seen; k++) {
      const row = output.subarray(k * width, (k + 1) * width);
      const local = [];
      for (let joint = 0; joint < joints; joint++) local.push(Array.from(row.subarray(9 * joint, 9 * joint + 9)));
      const [contact, std] = [row.slice(9 * joints, 9 * joints + 2), row.slice(9 * joints + 2)];
      this.frames[k] = { ...this.frames[k], local, contact: Array.from(contact), std };
    }
  }
}
