// Live in a headset (WebXR): head and controllers or hands go to the worker, the body comes back a moment later, and is put on
// the head and wrists of now in every frame of the headset. It stands before its wearer as in a mirror.

import * as THREE from "three";
import { Skeleton } from "./body.js";
import { Motion } from "./motion.js";
import { wristOf } from "./recordings.js";
import { Body } from "./scene.js";
import { aboutZ, mul, ofQuat, sub, toQuat, transpose, turned, yaw } from "./rotation.js";

const MIRROR_M = 1.1; // distance of the mirror before the wearer
const FEET = ["left_ankle", "left_toe", "right_ankle", "right_toe"];
const SIDES = ["left", "right"];

export class Headset {
  constructor(page) {
    Object.assign(this, { page, session: null, job: null });
  }

  // Show the button where a headset is there.
  async offer() {
    const there = await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
    document.getElementById("enter").hidden = !there;
  }

  async enter() {
    const { page } = this;
    const options = { requiredFeatures: ["local-floor"], optionalFeatures: ["hand-tracking"] };
    const session = await navigator.xr.requestSession("immersive-vr", options);
    const { renderer } = page.scene;
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType("local-floor");
    page.clear();
    this.body = await Body.load("body.glb", "", 0x3f7fc4);
    page.scene.stage.add(this.body.group);
    page.scene.stage.visible = false; // until the wearer's height is known
    await renderer.xr.setSession(session);
    Object.assign(this, { motion: null, skeleton: null, mirrored: false, last: [null, null], session });
    session.addEventListener("end", () => this.#left());
    page.ask("live").catch((error) => page.refuse(error.message));
    this.job = page.jobs;
    page.job = null;
  }

  #left() {
    const { page } = this;
    Object.assign(this, { session: null, job: null });
    page.scene.renderer.xr.enabled = false;
    this.body.remove();
    page.scene.stage.matrixAutoUpdate = true;
    page.scene.stage.visible = true;
    page.scene.resize();
    page.show(page.recording).catch((error) => page.refuse(error.message));
  }

  hear({ kind, rows, height }) {
    const { about } = this.page;
    if (kind === "begun") {
      this.skeleton = new Skeleton(about.skeleton).scaled(height / about.stature);
      this.body.scale(height / about.stature);
      this.motion = new Motion(about.skeleton.joint_names.length);
      this.mirrored = false;
    } else if (kind === "frames") {
      this.motion.add(rows);
      if (this.motion.times.length > 3000) [this.motion.times, this.motion.rows].forEach((list) => list.splice(0, 1000));
    }
  }

  draw(now, frame) {
    const space = this.page.scene.renderer.xr.getReferenceSpace();
    const viewer = frame.getViewerPose(space);
    if (!viewer) return;
    const head = this.#pose(viewer.transform);
    const wrists = SIDES.map((side, hand) => this.#moving(this.#wrist(frame, space, side), hand, now / 1000));
    this.page.worker.postMessage({ kind: "sample", id: this.job, sample: { time: now / 1000, head, wrists } });
    if (!this.motion?.times.length) return;
    if (!this.mirrored) this.#mirror(head);
    this.page.scene.stage.visible = true;
    const pose = this.posed(head, wrists);
    this.body.pose(pose.root, pose.local.flatMap(toQuat), pose.deviations);
    this.page.scene.light(this.body.place.applyMatrix4(this.page.scene.stage.matrixWorld));
  }

  // The newest captured pose, moved to where head and wrists are now; feet stay where they were captured.
  posed(device, wrists) {
    const { skeleton, motion } = this;
    const { mount } = this.page.about;
    const captured = motion.at(motion.end);
    const before = Array.from({ length: motion.joints }, (_, k) => ofQuat(captured.quats.slice(4 * k, 4 * k + 4)));
    const then = skeleton.forward(before, captured.root);
    const R = mul(device.R, transpose(mount.R));
    const head = { R, t: sub(device.t, turned(R, mount.t)) };
    const turn = aboutZ(yaw(head.R) - yaw(then.R[skeleton.head]));
    const anchored = skeleton.anchored([mul(turn, before[0]), ...before.slice(1)], head);
    const now = skeleton.forward(anchored.local, anchored.root);
    const ankles = ["left_ankle", "right_ankle"].map((name) => skeleton.index(name));
    const bent = skeleton.bendLegs(now, ankles.map((joint) => sub(then.t[joint], now.t[joint])));
    FEET.forEach((name) => {
      bent[skeleton.index(name)] = then.R[skeleton.index(name)];
    });
    const arms = skeleton.bendArms(now, wrists);
    ["shoulder", "elbow", "wrist"].forEach((name) => SIDES.forEach((side) => {
      const joint = skeleton.index(`${side}_${name}`);
      bent[joint] = arms[joint];
    }));
    return { local: skeleton.local(bent), root: anchored.root, deviations: captured.deviations };
  }

  #wrist(frame, space, side) {
    const source = [...this.session.inputSources].find((each) => each.handedness === side);
    const joint = source?.hand?.get("wrist");
    const found = joint ? frame.getJointPose(joint, space) : source?.gripSpace && frame.getPose(source.gripSpace, space);
    if (!found) return null;
    return wristOf(this.#pose(found.transform), this.page.about.seats[joint ? "wrist" : "grip"][`${side}_wrist`]);
  }

  // The wrist, null where it stands still to the last digit: it is lost, and its last place is reported.
  #moving(wrist, hand, time) {
    const last = this.last[hand];
    if (!wrist || !last || wrist.t.some((value, k) => value !== last.t[k])) this.last[hand] = wrist && { t: wrist.t, time };
    return wrist && time - this.last[hand].time < this.page.about.frozen_s ? wrist : null;
  }

  // A pose of WebXR in the body's axes.
  #pose({ position, orientation }) {
    const axes = this.page.about.axes.openxr;
    const { x, y, z, w } = orientation;
    const R = mul(mul(axes, ofQuat([x, y, z, w])), transpose(axes));
    return { R, t: turned(axes, [position.x, position.y, position.z]) };
  }

  // Put the stage behind a mirror, straight before the wearer.
  #mirror(head) {
    const { stage } = this.page.scene;
    const heading = yaw(head.R);
    // The body's x, y, z are three's x, z, -y; WebXR's are -y, z, -x of the body's.
    const axes = new THREE.Matrix4().makeRotationY(Math.PI / 2);
    const ahead = new THREE.Vector3(-Math.sin(heading), 0, -Math.cos(heading));
    const at = new THREE.Vector3(-head.t[1], 0, -head.t[0]).addScaledVector(ahead, MIRROR_M);
    const { x, z } = ahead;
    const through = 2 * at.dot(ahead);
    stage.matrixAutoUpdate = false;
    stage.matrix.set(
      1 - 2 * x * x, 0, -2 * x * z, through * x,
      0, 1, 0, 0,
      -2 * x * z, 0, 1 - 2 * z * z, through * z,
      0, 0, 0, 1,
    ).multiply(axes);
    this.mirrored = true;
  }
}
