// Files that people drag into the page, as recordings {head, wrists, mount, floor}: a headset's log, Aria's closed loop, TUM's
// or EuRoC's trajectories, a page's own sample. They may hold anything: what is wrong is said in one line.

import { add, column, dot, mul, norm, ofQuat, sub, toQuat, transpose, turned, unit } from "./rotation.js";
import { quantile } from "./session.js";

const MAX_BYTES = 256 * 2 ** 20;
const MAX_ROWS = 1_000_000;
const MAX_M = 100_000; // farthest place from the origin
const STEP_S = [0.001, 0.2]; // plausible time between two poses
const UNITS_S = { s: 1, ms: 1e-3, "µs": 1e-6, ns: 1e-9 };
const WRISTS = ["left_wrist", "right_wrist"];
const WORDS = {
  head: ["head", "hmd", "headset", "camera", "cam", "center", "centre"],
  left: ["left", "l"],
  right: ["right", "r"],
  place: ["pos", "position", "p", "location", "translation", "t"],
  turn: ["rot", "rotation", "q", "quat", "quaternion", "orientation"],
  time: ["time", "timestamp", "seconds", "t", "ts"],
};

const refuse = (text) => {
  throw new Error(text);
};

// Raises an Error whose message is a line for people; `how`: {axes, hands}, "auto" or as the page's menus name them.
export function readRecording(name, bytes, about, how = {}) {
  if (bytes.byteLength > MAX_BYTES) refuse("The file is larger than 256 MiB: cut a few minutes out of it.");
  let text;
  try {
    text = new TextDecoder("utf-8", { fatal: true }).decode(bytes);
  } catch {
    refuse("The file is no text. CSV, a trajectory's text and a page's sample.json are read here.");
  }
  if (text.trimStart().startsWith("{")) return ofSample(text);
  const lines = text.split(/\r?\n/).filter((line) => line.trim());
  if (lines.length < 3) refuse("The file holds no rows of poses.");
  if (lines.length > MAX_ROWS) refuse("The file has more than a million rows: cut a few minutes out of it.");
  const header = lines[0].split(",").map((word) => word.trim());
  if (header.includes("tx_world_device")) return ofAria(header, lines, about);
  const plain = lines.filter((line) => !line.startsWith("#"));
  if (plain.length > 2 && !/[a-df-z]/i.test(plain[0])) return ofTrajectory(plain, about);
  return ofHeadset(header, lines, about, how);
}

function ofSample(text) {
  let tree;
  try {
    tree = JSON.parse(text);
  } catch {
    refuse("The file is no whole JSON.");
  }
  const path = (track, what) => {
    const whole = Array.isArray(track?.times) && Array.isArray(track.poses) && track.times.length === track.poses.length;
    if (!whole || !track.poses.every((pose) => Array.isArray(pose) && pose.length === 7)) refuse(`${what} lacks times or poses.`);
    return checked(track.times, track.poses, what);
  };
  const wrists = {};
  for (const joint of WRISTS) if (tree.wrists?.[joint]) wrists[joint] = path(tree.wrists[joint], joint);
  return { head: path(tree.head, "The head"), wrists, mount: mountOf(tree.mount), note: "a page's sample" };
}

function mountOf(mount) {
  if (mount === undefined) return undefined;
  const whole = [[mount.R, 9], [mount.t, 3]].every(([values, count]) =>
    Array.isArray(values) && values.length === count && values.every(Number.isFinite));
  return whole ? { R: mount.R, t: mount.t } : refuse("The mount of the head's device is no pose.");
}

// Rows of finite numbers whose times rise. Raises as `readRecording` does.
function checked(times, poses, what) {
  const kept = { times: [], poses: [] };
  for (let k = 0; k < times.length; k++) {
    const row = poses[k];
    if (![times[k], ...row].every((value) => typeof value === "number" && Number.isFinite(value))) continue;
    const length = Math.hypot(...row.slice(3));
    if (Math.abs(length - 1) > 0.05 || Math.max(...row.slice(0, 3).map(Math.abs)) > MAX_M) continue;
    if (kept.times.length && times[k] <= kept.times[kept.times.length - 1]) continue;
    kept.times.push(times[k]);
    kept.poses.push(row);
  }
  if (kept.times.length < Math.max(2, 0.5 * times.length)) {
    refuse(`${what}: ${kept.times.length} of ${times.length} rows are poses in order of time, with unit quaternions.`);
  }
  return kept;
}

// Times in seconds, from 0 on, in the unit in which poses follow each other as those of devices do.
function inSeconds(times, unit) {
  const finite = times.filter(Number.isFinite);
  const steps = finite.slice(1).map((time, k) => time - finite[k]).filter((step) => step > 0);
  if (!steps.length) refuse("The times do not rise.");
  const step = quantile(steps, 0.5);
  const found = unit ?? Object.keys(UNITS_S).find((name) => step * UNITS_S[name] >= STEP_S[0] && step * UNITS_S[name] <= STEP_S[1]);
  if (!found) refuse(`The times step by ${step.toPrecision(3)}, which is no plausible time in s, ms, µs or ns.`);
  return times.map((time) => (time - finite[0]) * UNITS_S[found]);
}

const numbers = (line, between = ",") =>
  line.trim().split(between).map((cell) => (cell.trim() === "" ? NaN : Number(cell)));

function ofAria(header, lines, about) {
  const names = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"].map((part) => `${part}_world_device`);
  const places = ["tracking_timestamp_us", ...names].map((name) => header.indexOf(name));
  if (places.includes(-1)) refuse("The closed-loop trajectory lacks columns of MPS.");
  const rows = lines.slice(1).map((line) => numbers(line));
  const gravity = ["y", "z"].map((axis) => header.indexOf(`gravity_${axis}_world`)).map((at) => (at < 0 ? 0 : rows[0][at]));
  const up = Math.abs(gravity[0]) > Math.abs(gravity[1]) ? "y" : "z";
  const picked = rows.map((row) => places.map((at) => row[at]));
  const times = inSeconds(picked.map((row) => row[0]), "µs");
  const { times: kept, poses } = checked(times, picked.map((row) => row.slice(1)), "The trajectory");
  const world = about.worlds[up];
  const turnedPoses = poses.map(([x, y, z, ...quat]) => {
    const R = mul(world, ofQuat(quat));
    return [...add(turned(world, [x, y, z]), turned(R, about.aria.t)), ...toQuat(mul(R, about.aria.R))];
  });
  return { head: { times: kept, poses: turnedPoses }, wrists: {}, note: "Aria's closed loop; the height is not known" };
}

function ofTrajectory(lines, about) {
  const between = lines[0].includes(",") ? "," : /\s+/;
  const rows = lines.map((line) => numbers(line, between));
  if (rows.some((row) => row.length < 8)) refuse("Rows of a trajectory have a time, a place and a quaternion: eight numbers.");
  const times = inSeconds(rows.map((row) => row[0]));
  // EuRoC writes commas and the scalar first, TUM spaces and the scalar last.
  const ordered = rows.map(([, x, y, z, a, b, c, d]) => (between === "," ? [x, y, z, b, c, d, a] : [x, y, z, a, b, c, d]));
  const { times: kept, poses } = checked(times, ordered, "The trajectory");
  const { world, device, note } = axesOf(kept, poses, about);
  const upright = poses.map(([x, y, z, ...quat]) => {
    const R = mul(mul(about.worlds[world], ofQuat(quat)), transpose(about.devices[device]));
    return [...turned(about.worlds[world], [x, y, z]), ...toQuat(R)];
  });
  return { head: { times: kept, poses: upright }, wrists: {}, note: `${note}; the height is not known` };
}

// The axes in which a worn device stays upright and walks ahead.
function axesOf(times, poses, about) {
  const every = Math.max(1, Math.floor(poses.length / 500));
  const some = poses.filter((_, k) => k % every === 0).map(([x, y, z, ...quat]) => ({ t: [x, y, z], R: ofQuat(quat) }));
  let best = null;
  for (const world of ["z", "y", "-y"]) {
    for (const device of Object.keys(about.devices)) {
      const up = about.worlds[world];
      const R = some.map((pose) => mul(mul(up, pose.R), transpose(about.devices[device])));
      const upright = R.reduce((sum, turn) => sum + turn[8], 0) / R.length;
      const score = upright + 0.2 * ahead(R, some.map((pose) => turned(up, pose.t)));
      if (!best || score > best.score) best = { score, upright, world, device };
    }
  }
  if (best.upright < about.upright_axis) refuse("Nothing in this trajectory stays upright as a head does.");
  return { ...best, note: `axes: world ${best.world} up, device ${best.device}` };
}

// Mean cosine between where a device looks and where it goes.
function ahead(R, t) {
  let [sum, weight] = [0, 1e-9];
  for (let k = 1; k < t.length; k++) {
    const step = sub(t[k], t[k - 1]);
    sum += dot(step, column(R[k], 0));
    weight += norm(step);
  }
  return sum / weight;
}

// Words of a column's name: headPosX, Left_Hand.rotation.w.
const wordsOf = (name) =>
  name.replace(/([a-z0-9])([A-Z])/g, "$1 $2").toLowerCase().split(/[^a-z0-9]+/).filter(Boolean);

function ofHeadset(header, lines, about, how) {
  const columns = {};
  let clock = -1;
  const said = new Set();
  header.forEach((name, at) => {
    const words = wordsOf(name);
    words.forEach((word) => said.add(word));
    const has = (kind) => words.some((word) => WORDS[kind].includes(word));
    const axis = words[words.length - 1];
    const device = has("left") ? "left" : has("right") ? "right" : has("head") ? "head" : null;
    if (device && ["x", "y", "z", "w"].includes(axis)) {
      const part = has("turn") || axis === "w" ? "turn" : has("place") ? "place" : null;
      if (part) columns[`${device} ${part} ${axis}`] ??= at;
    } else if (clock < 0 && words.some((word) => WORDS.time.includes(word))) clock = at;
  });
  const parts = ["place x", "place y", "place z", "turn x", "turn y", "turn z", "turn w"];
  const of = (device) => parts.map((part) => columns[`${device} ${part}`] ?? -1);
  if (clock < 0) refuse("No column of times. A headset's log has time, head_pos_x … head_rot_w, left_hand_pos_x …");
  if (of("head").includes(-1)) refuse("No columns of the head's place and quaternion: head_pos_x … head_rot_w.");
  const rows = lines.slice(1).map((line) => numbers(line));
  const times = inSeconds(rows.map((row) => row[clock]));
  const pick = (device) => rows.map((row) => of(device).map((at) => row[at]));
  const raw = { head: checked(times, pick("head"), "The head") };
  for (const side of ["left", "right"]) {
    if (of(side).includes(-1)) continue;
    const seen = pick(side).map((row, k) => [times[k], row]).filter(([, row]) => row.every(Number.isFinite));
    if (seen.length > 1) raw[side] = checked(seen.map(([time]) => time), seen.map(([, row]) => row), `The ${side} hand`);
  }
  const axes = how.axes in about.axes ? how.axes : likelyAxes(raw, about);
  const family = how.hands in about.seats ? how.hands : Object.keys(about.seats).find((name) => said.has(name)) ?? "grip";
  const head = inAxes(raw.head, about.axes[axes]);
  const high = quantile(head.poses.map((pose) => pose[2]), 0.9);
  const wrists = {};
  for (const side of ["left", "right"]) {
    if (raw[side]) wrists[`${side}_wrist`] = seated(inAxes(raw[side], about.axes[axes]), about.seats[family][`${side}_wrist`]);
  }
  const floor = high > about.floor_m[0] && high < about.floor_m[1] ? 0 : null;
  return { head, wrists, floor, axes, family, note: `axes ${axes}, hands ${family}` };
}

function inAxes({ times, poses }, axes) {
  const back = transpose(axes);
  const moved = poses.map(([x, y, z, ...quat]) => [...turned(axes, [x, y, z]), ...toQuat(mul(mul(axes, ofQuat(quat)), back))]);
  return { times, poses: moved };
}

// The wrists that hold devices at these poses.
export function seated({ times, poses }, seat) {
  return { times, poses: poses.map(([x, y, z, ...quat]) => {
    const { R, t } = wristOf({ R: ofQuat(quat), t: [x, y, z] }, seat);
    return [...t, ...toQuat(R)];
  }) };
}

export function wristOf(device, seat) {
  const R = mul(device.R, seat.R);
  return { R, t: sub(device.t, turned(R, seat.t)) };
}

// Unity's z points ahead, OpenXR's back: heads walk ahead and see their hands.
function likelyAxes(raw, about) {
  const scores = Object.entries(about.axes).map(([name, axes]) => {
    const head = inAxes(raw.head, axes);
    const every = Math.max(1, Math.floor(head.poses.length / 500));
    const some = head.poses.filter((_, k) => k % every === 0);
    const R = some.map((pose) => ofQuat(pose.slice(3)));
    let score = 0.3 * ahead(R, some.map((pose) => pose.slice(0, 3)));
    for (const side of ["left", "right"]) {
      if (!raw[side]) continue;
      const hand = inAxes(raw[side], axes);
      let at = 0;
      const before = some.map((pose, k) => {
        while (at + 1 < hand.times.length && hand.times[at + 1] <= head.times[k * every]) at++;
        const [x, y] = sub(hand.poses[at], pose);
        const sideways = column(R[k], 1);
        const [forward, aside] = [unit([x, y, 0]), side === "left" ? 1 : -1];
        return dot(forward, column(R[k], 0)) + aside * dot(forward, sideways);
      });
      score += before.reduce((sum, value) => sum + value, 0) / before.length;
    }
    return { name, score };
  });
  return scores.sort((a, b) => b.score - a.score)[0].name;
}
