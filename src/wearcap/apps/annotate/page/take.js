// One recording as the server sent it: what it is, and its numbers per frame.

export async function fetchTake(index) {
  const header = await answer(await fetch(`/recordings/${index}`));
  const reply = await fetch(`/recordings/${index}/numbers`);
  if (!reply.ok) await answer(reply);
  return new Take(index, header, await reply.arrayBuffer());
}

/** A reply's JSON; what the server refused becomes an exception with its words. */
export async function answer(reply) {
  const content = await reply.json().catch(() => ({error: `the server answered ${reply.status}`}));
  if (!reply.ok) throw new Error(content.error);
  return content;
}

export class Take {
  constructor(index, header, numbers) {
    Object.assign(this, {index, header});
    const frames = header.frames;
    this.times = new Float64Array(numbers, 0, frames);
    this.floor = new Float32Array(numbers, 8 * frames, frames);
    this.places = new Float32Array(numbers, 12 * frames);
    this.count = header.points.length;
    this.fps = (frames - 1) / (this.times[frames - 1] - this.times[0]);
    this.sum();
  }

  /** Running sums over time of the root's place and of the hips' direction, for smooth averages at any frame. */
  sum() {
    const frames = this.times.length, names = this.header.points;
    const pair = [["left_hip", "right_hip"], ["left_shoulder", "right_shoulder"]]
      .find(([left, right]) => names.includes(left) && names.includes(right));
    const [left, right] = pair ? pair.map(name => names.indexOf(name)) : [0, 0];
    this.sums = Array.from({length: 5}, () => new Float64Array(frames + 1));
    for (let frame = 0; frame < frames; frame++) {
      const root = this.point(frame, 0), a = this.point(frame, left), b = this.point(frame, right);
      const x = a[1] - b[1], y = b[0] - a[0], size = Math.hypot(x, y) || 1;
      [...root, x / size, y / size].forEach((value, row) => { this.sums[row][frame + 1] = this.sums[row][frame] + value; });
    }
  }

  average(frame, seconds) {
    const half = Math.max(1, Math.round(seconds * this.fps / 2));
    const from = Math.max(0, frame - half), to = Math.min(this.times.length, frame + half + 1);
    return this.sums.map(sum => (sum[to] - sum[from]) / (to - from));
  }

  point(frame, index) {
    const at = 3 * (frame * this.count + index);
    return [this.places[at], this.places[at + 1], this.places[at + 2]];
  }

  /** Where to look (m): the root, without its bobbing. */
  center(frame) {
    const [x, y, z] = this.average(frame, 0.5);
    return [x, y, z - 0.05];
  }

  /** Direction (rad) in which the wearer faces, without swaying. */
  heading(frame) {
    const [, , , x, y] = this.average(frame, 1.5);
    return x || y ? Math.atan2(y, x) : 0;
  }

  /** The frame that is shown at a time: the last one that has begun. */
  frameAt(time) {
    return Math.max(0, rank(this.times, time + 1e-7) - 1);
  }
}

/** How many of rising numbers are ≤ a value. */
function rank(numbers, value, of = number => number) {
  let low = 0, high = numbers.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (of(numbers[middle]) <= value) low = middle + 1; else high = middle;
  }
  return low;
}

/** Straight lines between pairs, and on beyond them at real time: from column `from` to the other. */
export function along(pairs, value, from) {
  const to = 1 - from, last = pairs.length - 1;
  if (last < 1 || value <= pairs[0][from]) return pairs[0][to] + value - pairs[0][from];
  if (value >= pairs[last][from]) return pairs[last][to] + value - pairs[last][from];
  const after = rank(pairs, value, pair => pair[from]);
  const [p, q] = [pairs[after - 1], pairs[after]];
  return p[to] + (value - p[from]) / (q[from] - p[from]) * (q[to] - p[to]);
}
