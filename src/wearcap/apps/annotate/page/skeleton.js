// The body in three dimensions on a plain canvas: bones, floor, and hands that can be clicked.
import { HANDS } from "./labels.js";

const LEFT = "#3f78b4", RIGHT = "#cf7f33", MIDDLE = "#7b848c", CONTACT = "#2fae4e", CONTACT_EDGE = "#17692c";
const PALM_M = 0.075, LEAST_PX = 14, SLACK_PX = 7;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class SkeletonView {
  /** `onHand(hand)`: a hand was pressed. */
  constructor(canvas, onHand) {
    Object.assign(this, {canvas, onHand, context: canvas.getContext("2d")});
    this.pitch = 0.22;
    this.distance = 3.4;
    this.turn = false;
    this.hover = null;
    this.stale = true;
    canvas.addEventListener("pointerdown", event => this.press(event));
    canvas.addEventListener("pointermove", event => this.move(event));
    canvas.addEventListener("pointerup", () => { this.grabbed = null; });
    canvas.addEventListener("wheel", event => this.zoom(event), {passive: false});
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  open(take) {
    this.take = take;
    this.frame = 0;
    const {points, bones} = take.header;
    const side = name => name.startsWith("left_") ? LEFT : name.startsWith("right_") ? RIGHT : MIDDLE;
    this.bones = bones.filter(([, b]) => points[b] !== "nose").map(([a, b]) => ({a, b, color: side(points[b])}));
    this.yaw = take.heading(0) + 0.55;
    this.stale = true;
  }

  resize() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [box.width, box.height];
    [this.canvas.width, this.canvas.height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.stale = true;
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const hand = this.handAt(event.offsetX, event.offsetY);
    if (hand) return this.onHand(hand);
    this.grabbed = {x: event.clientX, y: event.clientY};
  }

  move(event) {
    if (!this.grabbed) {
      const hand = this.handAt(event.offsetX, event.offsetY);
      if (hand !== this.hover) this.stale = true;
      this.hover = hand;
      this.canvas.classList.toggle("hand", Boolean(hand));
      return;
    }
    this.yaw -= (event.clientX - this.grabbed.x) * 0.008;
    this.pitch = Math.max(-0.2, Math.min(1.5, this.pitch + (event.clientY - this.grabbed.y) * 0.006));
    this.grabbed = {x: event.clientX, y: event.clientY};
    this.stale = true;
  }

  zoom(event) {
    event.preventDefault();
    this.distance = Math.max(0.8, Math.min(12, this.distance * Math.exp(event.deltaY * 0.001)));
    this.stale = true;
  }

  /** Turning with the wearer keeps the view as it is now. */
  setTurn(turn) {
    if (turn !== this.turn) this.yaw += (turn ? -1 : 1) * this.take.heading(this.frame);
    this.turn = turn;
    this.stale = true;
  }

  lookAt(frame) {
    const yaw = this.yaw + (this.turn ? this.take.heading(frame) : 0);
    const away = [Math.cos(this.pitch) * Math.cos(yaw), Math.cos(this.pitch) * Math.sin(yaw), Math.sin(this.pitch)];
    const center = this.take.center(frame);
    this.forward = away.map(value => -value);
    this.right = [-Math.sin(yaw), Math.cos(yaw), 0];
    this.up = [-Math.sin(this.pitch) * Math.cos(yaw), -Math.sin(this.pitch) * Math.sin(yaw), Math.cos(this.pitch)];
    this.eye = center.map((value, axis) => value + this.distance * away[axis]);
    this.focal = 1.55 * Math.min(this.height, this.width * 1.2);
  }

  /** Pixels (x, y) and depth (m) of a position; depth ≤ 0 is behind the camera. */
  project(place) {
    const from = [place[0] - this.eye[0], place[1] - this.eye[1], place[2] - this.eye[2]];
    const depth = dot(from, this.forward), scale = this.focal / Math.max(depth, 0.05);
    return [this.width / 2 + scale * dot(from, this.right), this.height / 2 - scale * dot(from, this.up), depth];
  }

  handCircle(hand) {
    const [x, y, depth] = this.project(this.take.point(this.frame, this.take.header.hands[hand]));
    return {hand, x, y, depth, radius: Math.max(LEAST_PX, PALM_M * this.focal / Math.max(depth, 0.05))};
  }

  handAt(x, y) {
    if (!this.take || !this.eye) return null;
    const near = HANDS.map(hand => this.handCircle(hand))
      .map(circle => ({...circle, away: Math.hypot(circle.x - x, circle.y - y)}))
      .filter(circle => circle.away <= circle.radius + SLACK_PX).sort((a, b) => a.away - b.away);
    return near.length ? near[0].hand : null;
  }

  draw(frame, contact) {
    if (!this.take || !this.width) return;
    this.frame = frame;
    this.lookAt(frame);
    const c = this.context;
    c.clearRect(0, 0, this.width, this.height);
    c.lineCap = "round";
    this.drawFloor(frame);
    const floor = this.take.floor[frame];
    const places = this.take.header.points.map((_, index) => this.take.point(frame, index));
    c.strokeStyle = "rgba(30, 40, 50, 0.09)";
    for (const {a, b} of this.bones) this.line([...places[a].slice(0, 2), floor], [...places[b].slice(0, 2), floor], 0.07);
    const seen = places.map(place => this.project(place));
    const order = this.bones.map(bone => [bone, seen[bone.a][2] + seen[bone.b][2]]).sort((p, q) => q[1] - p[1]);
    for (const [{a, b, color}] of order) {
      c.strokeStyle = color;
      this.line(places[a], places[b], 0.045);
    }
    this.drawHead(places);
    for (const circle of HANDS.map(hand => this.handCircle(hand)).sort((p, q) => q.depth - p.depth)) {
      this.drawHand(circle, contact[circle.hand]);
    }
    this.stale = false;
  }

  line(from, to, thick) {
    const [x0, y0, near] = this.project(from), [x1, y1, far] = this.project(to);
    if (near < 0.1 || far < 0.1) return;
    this.context.lineWidth = Math.max(2, thick * this.focal * 2 / (near + far));
    this.context.beginPath();
    this.context.moveTo(x0, y0);
    this.context.lineTo(x1, y1);
    this.context.stroke();
  }

  drawFloor(frame) {
    const [x, y] = this.take.center(frame), z = this.take.floor[frame], reach = 3, step = 0.5, c = this.context;
    const x0 = Math.round(x / step) * step, y0 = Math.round(y / step) * step;
    for (let shift = -reach; shift <= reach + 1e-9; shift += step) {
      const whole = value => Math.abs(value - Math.round(value)) < 1e-6;
      c.strokeStyle = whole(x0 + shift) ? "#d5dade" : "#e9ecee";
      this.floorLine([x0 + shift, y0 - reach, z], [x0 + shift, y0 + reach, z]);
      c.strokeStyle = whole(y0 + shift) ? "#d5dade" : "#e9ecee";
      this.floorLine([x0 - reach, y0 + shift, z], [x0 + reach, y0 + shift, z]);
    }
  }

  /** A thin line, cut where it would pass behind the eye. */
  floorLine(from, to) {
    const depth = place => dot(place.map((value, axis) => value - this.eye[axis]), this.forward);
    let a = depth(from), b = depth(to);
    if (a < 0.2 && b < 0.2) return;
    const between = t => from.map((value, axis) => value + t * (to[axis] - value));
    const cut = (0.2 - a) / (b - a);
    const [p, q] = [a < 0.2 ? between(cut) : from, b < 0.2 ? between(cut) : to].map(place => this.project(place));
    this.context.lineWidth = 1;
    this.context.beginPath();
    this.context.moveTo(p[0], p[1]);
    this.context.lineTo(q[0], q[1]);
    this.context.stroke();
  }

  drawHead(places) {
    const names = this.take.header.points, head = names.indexOf("head"), crown = names.indexOf("crown");
    if (head < 0) return;
    const top = crown < 0 ? places[head] : places[crown];
    const [x, y, depth] = this.project(places[head].map((value, axis) => 0.45 * value + 0.55 * top[axis]));
    if (depth < 0.1) return;
    const nose = names.includes("nose") ? this.project(places[names.indexOf("nose")]) : null;
    const shapes = [[x, y, depth, 0.095, MIDDLE]];
    if (nose) shapes.push([...nose, 0.028, "#4d555c"]);
    // The nose hides behind the head when the wearer looks away.
    for (const [u, v, far, radius, color] of shapes.sort((p, q) => q[2] - p[2])) {
      this.context.fillStyle = color;
      this.context.beginPath();
      this.context.arc(u, v, radius * this.focal / Math.max(far, 0.1), 0, 2 * Math.PI);
      this.context.fill();
    }
  }

  drawHand({hand, x, y, depth, radius}, contact) {
    if (depth < 0.1) return;
    const c = this.context, color = hand === "left" ? LEFT : RIGHT;
    c.beginPath();
    c.arc(x, y, radius + (this.hover === hand ? 3 : 0), 0, 2 * Math.PI);
    c.fillStyle = contact ? CONTACT : "rgba(255, 255, 255, 0.88)";
    c.strokeStyle = contact ? CONTACT_EDGE : color;
    c.lineWidth = 3;
    c.fill();
    c.stroke();
    c.fillStyle = contact ? "#fff" : color;
    c.font = `bold ${Math.round(radius)}px sans-serif`;
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(hand === "left" ? "L" : "R", x, y + 1);
  }
}
