// A skeleton of named joints: forward kinematics, size, and limbs that reach. As wearcap.body.

import { add, dot, mul, norm, scale, sub, swing, transpose, turned, unit } from "./rotation.js";

const STRAIGHT = 0.97; // share of a leg's length from which a farther goal is approached ever more slowly
const SOFT = 0.025; // the share within which
const SURELY_M = 0.02; // displacement (m) of a foot from which a knee that was predicted to bend backwards bends forward
export const PATCHES = ["left_heel", "left_toe_tip", "right_heel", "right_toe_tip"];

export class Skeleton {
  constructor({ joint_names, parents, t_parent_joint, sites }) {
    Object.assign(this, { names: joint_names, parents, offsets: t_parent_joint, sites });
    this.head = this.index("head");
    this.rest = [[0, 0, 0]];
    for (let joint = 1; joint < parents.length; joint++) {
      this.rest.push(add(this.rest[parents[joint]], t_parent_joint[joint]));
    }
    const points = Object.values(sites).map(([joint, ...at]) => add(this.rest[this.index(joint)], at));
    const heights = [...this.rest, ...points].map((point) => point[2]);
    this.rootHeight = -Math.min(...heights);
    this.stature = Math.max(...heights) + this.rootHeight;
    this.headHeight = this.rest[this.head][2] + this.rootHeight;
  }

  index(name) {
    const joint = this.names.indexOf(name);
    if (joint < 0) throw new Error(`the skeleton has no joint ${name}`);
    return joint;
  }

  scaled(factor) {
    const sites = Object.entries(this.sites).map(([name, [joint, ...at]]) => [name, [joint, ...scale(at, factor)]]);
    const t_parent_joint = this.offsets.map((offset) => scale(offset, factor));
    return new Skeleton({
      joint_names: this.names, parents: this.parents, t_parent_joint, sites: Object.fromEntries(sites),
    });
  }

  // Measures (m) of the body's size by the chains of joints whose bones add up to each; the first is the head's height.
  size(limbs) {
    const lengths = Object.values(limbs).map((names) =>
      names.reduce((sum, name) => sum + norm(this.offsets[this.index(name)]), 0));
    return [this.headHeight, ...lengths.slice(1)];
  }

  // Rotations and places of all joints in the world; the root's local rotation is its world rotation.
  forward(local, root) {
    const R = [local[0]];
    const t = [root];
    for (let joint = 1; joint < this.parents.length; joint++) {
      const parent = this.parents[joint];
      R.push(mul(R[parent], local[joint]));
      t.push(add(t[parent], turned(R[parent], this.offsets[joint])));
    }
    return { R, t };
  }

  // Local rotations of world rotations.
  local(R) {
    return R.map((turn, joint) => (joint ? mul(transpose(R[this.parents[joint]]), turn) : turn));
  }

  // The pose with its head joint turned and placed as measured: the body is translated, the head's local rotation set.
  anchored(local, head) {
    const { R, t } = this.forward(local, [0, 0, 0]);
    const turned = local.slice();
    turned[this.head] = mul(transpose(R[this.parents[this.head]]), head.R);
    return { local: turned, root: sub(head.t, t[this.head]) };
  }

  // Heels and toe tips in the world, in the order of `PATCHES`.
  soles({ R, t }) {
    return PATCHES.map((name) => {
      const [joint, ...at] = this.sites[name];
      const k = this.index(joint);
      return add(t[k], turned(R[k], at));
    });
  }

  // World rotations with ankles moved by an offset (m) each: hips and knees follow, feet keep their turn.
  bendLegs({ R, t }, offsets) {
    const bent = R.slice();
    ["left", "right"].forEach((side, foot) => {
      const offset = offsets[foot];
      if (!offset || !offset.some((value) => value !== 0)) return;
      const joints = ["hip", "knee", "ankle"].map((name) => this.index(`${side}_${name}`));
      const [start, middle, end] = joints.map((joint) => t[joint]);
      const thigh = R[joints[0]];
      const forward = [thigh[0], thigh[3], thigh[6]];
      const distance = norm(offset);
      const backward = Math.max(0, dot(sub(scale(add(start, end), 0.5), middle), forward));
      const bias = scale(forward, distance + backward * Math.min(distance / SURELY_M, 1));
      const goal = withinReach(start, middle, end, add(end, offset));
      reach(start, middle, end, goal, bias).forEach((turn, k) => {
        bent[joints[k]] = mul(turn, R[joints[k]]);
      });
    });
    return bent;
  }

  // World rotations with wrists turned and placed as given, or as near as the arms reach; null: that arm stays.
  bendArms({ R, t }, wrists) {
    const bent = R.slice();
    ["left", "right"].forEach((side, hand) => {
      if (!wrists[hand]) return;
      const joints = ["shoulder", "elbow", "wrist"].map((name) => this.index(`${side}_${name}`));
      const [start, middle, end] = joints.map((joint) => t[joint]);
      reach(start, middle, end, wrists[hand].t, [0, 0, 0]).forEach((turn, k) => {
        bent[joints[k]] = mul(turn, R[joints[k]]);
      });
      bent[joints[2]] = wrists[hand].R;
    });
    return bent;
  }
}

// The goal, nearer to the hip where the leg would have to be stretched more than it is and more than softly.
function withinReach(start, middle, end, goal) {
  const length = norm(sub(middle, start)) + norm(sub(end, middle));
  const [now, wanted] = [end, goal].map((point) => norm(sub(point, start)) / length);
  if (wanted <= STRAIGHT) return goal;
  const soft = STRAIGHT + SOFT * (1 - Math.exp(-(wanted - STRAIGHT) / SOFT));
  const share = Math.max(Math.min(now, wanted), soft);
  return add(start, scale(sub(goal, start), share / Math.max(wanted, 1e-9)));
}

// World rotations to be multiplied from the left onto those of the upper and the lower bone, so that `end` reaches `goal`.
export function reach(start, middle, end, goal, bias) {
  const [upper, lower] = [norm(sub(middle, start)), norm(sub(end, middle))];
  const [near, far] = [Math.abs(upper - lower) * 1.001 + 1e-9, upper + lower];
  const aim = unit(sub(goal, start));
  const distance = Math.min(Math.max(norm(sub(goal, start)), near), far);
  const sideways = turned(swing(sub(end, start), aim), add(sub(middle, start), bias));
  const bend = unit(sub(sideways, scale(aim, dot(sideways, aim))));
  const along = (distance ** 2 + upper ** 2 - lower ** 2) / (2 * distance);
  const beside = Math.sqrt(Math.max(0, upper ** 2 - along ** 2));
  const elbow = add(start, add(scale(aim, along), scale(bend, beside)));
  const hand = add(start, scale(aim, distance));
  return [swing(sub(middle, start), sub(elbow, start)), swing(sub(end, middle), sub(hand, elbow))];
}
