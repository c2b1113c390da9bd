// A captured motion that grows while it is captured: rows of the worker, and the pose at any time.

import { slerp } from "./rotation.js";

const HOLD_S = 0.1; // a longer interval without frames is a gap, in which the last pose stays

export class Motion {
  constructor(joints) {
    this.joints = joints;
    this.width = 6 + 5 * joints;
    this.times = [];
    this.rows = [];
  }

  add(numbers) {
    for (let at = 0; at < numbers.length; at += this.width) {
      const row = numbers.subarray(at, at + this.width);
      this.times.push(row[0]);
      this.rows.push(row);
    }
  }

  get end() {
    return this.times.length ? this.times[this.times.length - 1] : -Infinity;
  }

  // Index of the last frame at or before a time.
  frame(time) {
    let [low, high] = [0, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return Math.max(0, low - 1);
  }

  // The pose at a time, between its two frames: {root, quats, contact, deviations}; null before anything was captured.
  at(time) {
    if (!this.rows.length) return null;
    const before = this.frame(time);
    const [a, b] = [this.rows[before], this.rows[before + 1] ?? this.rows[before]];
    const step = b[0] - a[0];
    const share = step > 0 && step < HOLD_S ? Math.min(Math.max((time - a[0]) / step, 0), 1) : 0;
    const quats = new Float32Array(4 * this.joints);
    for (let at = 0; at < quats.length; at += 4) {
      quats.set(slerp(Array.from(a.subarray(4 + at, 8 + at)), Array.from(b.subarray(4 + at, 8 + at)), share), at);
    }
    const root = [1, 2, 3].map((k) => a[k] + share * (b[k] - a[k]));
    const rest = 4 + quats.length;
    return { root, quats, contact: a.subarray(rest, rest + 2), deviations: a.subarray(rest + 2) };
  }
}
