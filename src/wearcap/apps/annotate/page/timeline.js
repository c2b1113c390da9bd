// Both hands' contacts over time: seek by a click, move edges by dragging, zoom with the wheel.
import { HANDS } from "./labels.js";

const LEFT_PX = 52, RULER_PX = 22, LANE_PX = 32, GAP_PX = 4, MAP_PX = 14, EDGE_PX = 6, LEAST_SPAN_S = 1;

export class Timeline {
  /** `seek(time)`, `choose(hand, place)` (place -1: none). */
  constructor(canvas, seek, choose) {
    Object.assign(this, {canvas, seek, choose, context: canvas.getContext("2d"), chosen: null, drag: null, stale: true});
    canvas.addEventListener("pointerdown", event => this.press(event));
    canvas.addEventListener("pointermove", event => this.move(event));
    canvas.addEventListener("pointerup", event => this.release(event));
    canvas.addEventListener("pointercancel", () => this.forget());
    canvas.addEventListener("wheel", event => this.wheel(event), {passive: false});
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  open(take, labels) {
    Object.assign(this, {take, labels, chosen: null, drag: null});
    [this.from, this.to] = [take.times[0], take.header.stop_s];
    this.stale = true;
  }

  resize() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [box.width, box.height];
    [this.canvas.width, this.canvas.height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.stale = true;
  }

  get state() { return this.drag && this.drag.state ? this.drag.state : this.labels.state; }

  x(time) { return LEFT_PX + (time - this.from) / (this.to - this.from) * (this.width - LEFT_PX - 8); }
  timeAt(x) { return this.from + (x - LEFT_PX) / (this.width - LEFT_PX - 8) * (this.to - this.from); }
  laneTop(hand) { return RULER_PX + HANDS.indexOf(hand) * (LANE_PX + GAP_PX); }
  get mapTop() { return this.height - MAP_PX - 2; }
  laneAt(y) { return HANDS.find(hand => y >= this.laneTop(hand) && y < this.laneTop(hand) + LANE_PX) || null; }
  mapX(time) { return LEFT_PX + (time - this.take.times[0]) / (this.take.header.stop_s - this.take.times[0]) * (this.width - LEFT_PX - 8); }
  mapTime(x) { return this.take.times[0] + (x - LEFT_PX) / (this.width - LEFT_PX - 8) * (this.take.header.stop_s - this.take.times[0]); }

  /** The contact's edge under the pointer; of two that touch, the one whose contact the pointer is in. */
  edgeAt(x, y) {
    const hand = this.laneAt(y);
    if (!hand) return null;
    const found = [];
    this.labels.state[hand].forEach((label, place) => {
      for (const which of ["start", "stop"]) {
        const away = x - this.x(label[which]), inside = which === "start" ? away >= 0 : away <= 0;
        if (Math.abs(away) <= EDGE_PX) found.push({hand, place, which, rank: Math.abs(away) + (inside ? 0 : 0.5)});
      }
    });
    return found.sort((a, b) => a.rank - b.rank)[0] || null;
  }

  press(event) {
    if (!this.take) return;
    this.canvas.setPointerCapture(event.pointerId);
    const [x, y] = [event.offsetX, event.offsetY];
    if (y >= this.mapTop) {
      this.drag = {kind: "map"};
      return this.moveMap(x);
    }
    const edge = this.edgeAt(x, y);
    if (edge) {
      this.drag = {kind: "edge", ...edge, pressed: x};
      return this.choose(edge.hand, edge.place);
    }
    const hand = this.laneAt(y), time = this.timeAt(x);
    this.choose(hand, hand ? this.labels.at(hand, time) : -1);
    this.drag = {kind: "seek"};
    this.seek(time);
  }

  move(event) {
    const [x, y] = [event.offsetX, event.offsetY];
    if (!this.drag) {
      this.canvas.style.cursor = this.take && this.edgeAt(x, y) ? "ew-resize" : "default";
    } else if (this.drag.kind === "seek") {
      this.seek(this.timeAt(x));
    } else if (this.drag.kind === "map") {
      this.moveMap(x);
    } else if (this.drag.state || Math.abs(x - this.drag.pressed) > 2) {
      const {hand, place, which} = this.drag, time = this.timeAt(x) + 0.5 / this.take.fps;
      const frame = time < this.take.header.stop_s ? this.take.frameAt(time) : this.take.times.length;
      this.drag.state = this.labels.withEdge(hand, place, which, frame);
      const moved = this.drag.state[hand][place];
      this.seek(moved[which]);
      this.stale = true;
    }
  }

  release() {
    const drag = this.drag;
    this.drag = null;
    if (drag && drag.state) this.labels.become(drag.state);
    else if (drag && drag.kind === "edge") this.seek(this.labels.state[drag.hand][drag.place][drag.which]);
    this.stale = true;
  }

  forget() {
    this.drag = null;
    this.stale = true;
  }

  moveMap(x) {
    const span = this.to - this.from;
    this.show(this.mapTime(x) - span / 2, span);
    this.seek(this.mapTime(x));
  }

  wheel(event) {
    event.preventDefault();
    if (!this.take) return;
    const span = this.to - this.from;
    if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      return this.show(this.from + (event.deltaX || event.deltaY) / 800 * span, span);
    }
    const whole = this.take.header.stop_s - this.take.times[0], at = this.timeAt(event.offsetX);
    const wider = Math.max(Math.min(LEAST_SPAN_S, whole), Math.min(whole, span * Math.exp(event.deltaY * 0.0015)));
    this.show(at - (at - this.from) / span * wider, wider);
  }

  show(from, span) {
    this.from = Math.max(this.take.times[0], Math.min(from, this.take.header.stop_s - span));
    this.to = this.from + span;
    this.stale = true;
  }

  /** Turn the page when the moment that plays leaves it. */
  keepInView(time) {
    if (this.drag) return;
    const span = this.to - this.from;
    if (time < this.from || time > this.to) this.show(time - 0.1 * span, span);
  }

  draw(time) {
    if (!this.take || !this.width) return;
    const c = this.context;
    c.clearRect(0, 0, this.width, this.height);
    c.font = "12px sans-serif";
    c.textBaseline = "middle";
    this.drawRuler();
    for (const hand of HANDS) this.drawLane(hand, time);
    this.drawMap(time);
    const x = this.x(time);
    if (x >= LEFT_PX - 1) {
      c.fillStyle = "#c0392b";
      c.fillRect(x - 0.75, 0, 1.5, this.mapTop - 3);
      c.beginPath();
      c.moveTo(x - 6, 0); c.lineTo(x + 6, 0); c.lineTo(x, 8);
      c.fill();
    }
    this.stale = false;
  }

  drawRuler() {
    const c = this.context, span = this.to - this.from, origin = this.take.times[0];
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800]
      .find(size => size / span * (this.width - LEFT_PX) > 60) || 3600;
    c.fillStyle = "#6a7177";
    c.textAlign = "center";
    for (let mark = Math.ceil((this.from - origin) / step - 1e-9) * step; mark <= this.to - origin; mark += step) {
      const x = this.x(origin + mark);
      c.fillRect(x, RULER_PX - 6, 1, 4);
      c.fillText(clock(mark, step), x, 9);
    }
  }

  drawLane(hand, time) {
    const c = this.context, top = this.laneTop(hand);
    c.fillStyle = "#f0f2f3";
    c.fillRect(LEFT_PX, top, this.width - LEFT_PX - 8, LANE_PX);
    c.textAlign = "left";
    c.fillStyle = this.labels.at(hand, time) >= 0 ? "#1d7a36" : "#25292d";
    c.fillText(hand, 10, top + LANE_PX / 2);
    c.save();
    c.beginPath();
    c.rect(LEFT_PX, top, this.width - LEFT_PX - 8, LANE_PX);
    c.clip();
    this.state[hand].forEach((label, place) => this.drawLabel(hand, label, place, top));
    c.restore();
  }

  drawLabel(hand, label, place, top) {
    const c = this.context, x = this.x(label.start), wide = Math.max(2, this.x(label.stop) - x);
    const open = label.stop >= this.take.header.stop_s;
    const chosen = this.chosen && this.chosen.hand === hand && this.chosen.place === place;
    c.fillStyle = chosen ? "#5fc67a" : "#9bdbab";
    c.fillRect(x, top + 2, wide, LANE_PX - 4);
    c.fillStyle = chosen ? "#17692c" : "#2fae4e";
    c.fillRect(x, top + 2, 2.5, LANE_PX - 4);
    if (!open) c.fillRect(x + wide - 2.5, top + 2, 2.5, LANE_PX - 4);
    const text = [label.object, label.kind].filter(Boolean).join(", ") || (open ? "to the end" : "");
    const from = Math.max(x, LEFT_PX);
    if (!text || x + wide - from < 30) return;
    c.save();
    c.beginPath();
    c.rect(x, top, wide - 4, LANE_PX);
    c.clip();
    c.fillStyle = "#17422a";
    c.fillText(text, from + 7, top + LANE_PX / 2);
    c.restore();
  }

  drawMap(time) {
    const c = this.context, top = this.mapTop;
    c.fillStyle = "#f0f2f3";
    c.fillRect(LEFT_PX, top, this.width - LEFT_PX - 8, MAP_PX);
    HANDS.forEach((hand, row) => {
      c.fillStyle = "#2fae4e";
      for (const label of this.state[hand]) {
        const x = this.mapX(label.start);
        c.fillRect(x, top + 2 + row * 6, Math.max(1, this.mapX(label.stop) - x), 4);
      }
    });
    c.strokeStyle = "#6a7177";
    c.lineWidth = 1;
    c.strokeRect(this.mapX(this.from) + 0.5, top + 0.5, Math.max(4, this.mapX(this.to) - this.mapX(this.from) - 1), MAP_PX - 1);
    c.fillStyle = "#c0392b";
    c.fillRect(this.mapX(time) - 0.75, top, 1.5, MAP_PX);
  }
}

/** Minutes and seconds, with as many decimals as marks `step` seconds apart need. */
export function clock(seconds, step = 0.01) {
  const places = step >= 1 ? 0 : step >= 0.1 ? 1 : 2, rounded = Number(seconds.toFixed(places));
  const minutes = Math.floor(rounded / 60), rest = (rounded - 60 * minutes).toFixed(places);
  return minutes ? `${minutes}:${rest.padStart(places ? places + 3 : 2, "0")}` : `${rest}`;
}
