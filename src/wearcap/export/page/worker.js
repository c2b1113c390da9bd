// The network's own thread: reads files and captures, so that the picture never waits. It has no more rights than the page:
// no connection to another host.

import * as ort from "./libraries/onnxruntime-web/dist/ort.wasm.bundle.min.mjs";
import { Skeleton } from "./body.js";
import { readRecording } from "./recordings.js";
import { mul, ofQuat, sub, toQuat, transpose, turned } from "./rotation.js";
import { Session, quantile } from "./session.js";

const WRISTS = ["left_wrist", "right_wrist"];
const LIVE_LOOKAHEAD = 4; // frames: a body that moves with its wearer may not be half a second late
const STANDING_S = 1; // time in which a height is looked for, again and again
const TALLER_M = 0.03; // change of the wearer's height from which the body is made anew
let about, network, body;
let newest = 0; // number of the newest job: older ones stop
let live = null;

ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmPaths = {
  wasm: new URL("./libraries/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm", import.meta.url).href,
};

async function open() {
  const [json, onnx] = await Promise.all(["network.json", "network.onnx"].map(async (name) => {
    const reply = await fetch(new URL(name, import.meta.url));
    if (!reply.ok) throw new Error(`${name} is missing: copy the whole folder`);
    return reply;
  }));
  about = await json.json();
  body = new Skeleton(about.skeleton);
  about.stature = body.stature;
  network = await ort.InferenceSession.create(new Uint8Array(await onnx.arrayBuffer()), { executionProviders: ["wasm"] });
  return { about };
}

async function run(inputs) {
  const feeds = {};
  for (const [name, [values, shape]] of Object.entries(inputs)) {
    feeds[name] = new ort.Tensor(values instanceof Uint8Array ? "bool" : "float32", values, shape);
  }
  const started = performance.now();
  const outputs = await network.run(feeds);
  spent.push(performance.now() - started);
  return outputs[network.outputNames[0]].data;
}
let spent = []; // milliseconds of each run

// Frames as rows of numbers: time, root, quaternions of the joints (x, y, z, w), contacts of the feet, deviations of the joints.
function packed(frames) {
  if (!frames.length) return new Float64Array(0);
  const joints = frames[0].local.length;
  const width = 6 + 5 * joints;
  const rows = new Float64Array(frames.length * width);
  frames.forEach((frame, k) => {
    rows.set([frame.time, ...frame.root, ...frame.local.flatMap(toQuat), ...frame.contact, ...frame.std], k * width);
  });
  return rows;
}

const posed = ([x, y, z, ...quat]) => ({ R: ofQuat(quat), t: [x, y, z] });

// The height (m) of a wearer by how high the head is carried; null where nobody stands like that.
function heightOf(heights) {
  const above = quantile(heights, about.upright);
  const height = (above * body.stature) / (about.carried * body.headHeight);
  return height >= about.heights_m[0] && height <= about.heights_m[1] ? height : null;
}

const ofHeight = (height) => (height ? body.scaled(height / body.stature) : body);

async function capture({ recording, hands, height, id }) {
  const { head, wrists, mount = about.mount, floor = null } = recording;
  const poses = head.poses.map(posed);
  let skeleton = recording.skeleton && !height ? new Skeleton(recording.skeleton) : null;
  let standing = height;
  if (!skeleton) {
    if (!standing && floor !== null) standing = heightOf(poses.map(({ R, t }) => jointOf({ R, t }, mount)[2] - floor));
    skeleton = ofHeight(standing);
  }
  const session = new Session(about, run, { skeleton, mount, floor });
  const tracks = WRISTS.map((joint) => (hands && wrists?.[joint]) || { times: [], poses: [] });
  const next = [0, 0];
  spent = [];
  const started = performance.now();
  self.postMessage({ kind: "begun", id, height: skeleton.stature, known: Boolean(recording.skeleton || standing) });
  for (let k = 0; k < poses.length && id === newest; k++) {
    const time = head.times[k];
    tracks.forEach((track, hand) => {
      while (next[hand] < track.times.length && (track.times[next[hand]] <= time + about.unseen_s || k === poses.length - 1)) {
        const number = next[hand]++;
        session.wrists[hand].push({ time: track.times[number], ...posed(track.poses[number]) });
      }
    });
    session.push({ time, head: poses[k] });
    if (k % about.stride && k < poses.length - 1) continue;
    const frames = await session.advance(k === poses.length - 1);
    if (frames.length && id === newest) self.postMessage({ kind: "frames", id, rows: packed(frames), spent: quantile(spent, 0.5) });
    await new Promise((resolve) => setTimeout(resolve)); // other messages first
  }
  if (id === newest) self.postMessage({ kind: "done", id, took: performance.now() - started });
}

// Place of the head joint.
const jointOf = ({ R, t }, mount) => sub(t, turned(mul(R, transpose(mount.R)), mount.t));

// Samples of a wearer who moves now, on a floor at height 0.
class Live {
  constructor(id) {
    Object.assign(this, { id, heights: [], used: null, since: null, waiting: [], busy: false, session: null });
  }

  push(sample) {
    const { time, head } = sample;
    this.since ??= time;
    this.heights.push(jointOf(head, about.mount)[2]);
    if (this.heights.length > 3000) this.heights.splice(0, 1000);
    if (time - this.since >= STANDING_S) {
      this.since = time;
      const height = heightOf(this.heights);
      if (!this.session || (height && Math.abs(height - (this.used ?? 0)) > TALLER_M)) this.#begin(height);
    }
    this.session?.push(sample);
    this.#advance();
  }

  #begin(height) {
    this.used = height;
    const skeleton = ofHeight(height);
    this.session = new Session(about, run, { skeleton, mount: about.mount, floor: 0, lookahead: LIVE_LOOKAHEAD });
    self.postMessage({ kind: "begun", id: this.id, height: skeleton.stature, known: Boolean(height) });
  }

  async #advance() {
    if (this.busy || !this.session) return;
    this.busy = true;
    const { session } = this;
    try {
      const frames = await session.advance();
      if (session === this.session && frames.length) {
        self.postMessage({ kind: "frames", id: this.id, rows: packed(frames), spent: quantile(spent.splice(0), 0.5) });
      }
    } finally {
      this.busy = false;
    }
  }
}

const JOBS = {
  open,
  read: ({ name, bytes, how }) => ({ recording: readRecording(name, bytes, about, how) }),
  capture,
  live: ({ id }) => void (live = new Live(id)),
  sample: ({ id, sample }) => void (live?.id === id && live.push(sample)),
};

self.onmessage = async ({ data }) => {
  if (data.kind !== "sample") newest = Math.max(newest, data.id);
  try {
    const found = await JOBS[data.kind](data);
    if (found) self.postMessage({ kind: data.kind, id: data.id, ...found });
  } catch (error) {
    self.postMessage({ kind: "refused", id: data.id, text: String(error.message ?? error) });
  }
};
