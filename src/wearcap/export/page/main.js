// The page: what is captured, what is shown, and what its buttons do.

import { Headset } from "./headset.js";
import { Motion } from "./motion.js";
import { Body, Scene } from "./scene.js";

const COLORS = { capture: 0x3f7fc4, truth: 0xd8924a };
const BESIDE_M = 1.1; // distance of the truth from what was captured
const JUMP_S = 1;
const get = (id) => document.getElementById(id);

class Page {
  constructor() {
    this.scene = new Scene(get("view"));
    this.jobs = 0;
    this.clock = { time: 0, playing: true, start: 0, end: 0 };
    this.frames = [];
    this.bodies = {};
    this.errors = [];
    // A worker made from a blob has the page's rights: no other host. One from a file would have its own.
    const source = `import ${JSON.stringify(new URL("worker.js", location.href).href)};`;
    this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })), { type: "module" });
    this.worker.onmessage = ({ data }) => this.#hear(data);
    this.worker.onerror = () => this.refuse("The network's thread did not start: this browser is too old.");
    this.waiting = new Map();
    this.headset = new Headset(this);
    this.#connect();
  }

  async start() {
    this.say("Loading the network …");
    ({ about: this.about } = await this.ask("open"));
    const sample = await (await fetch("sample.json")).json();
    this.sample = sample;
    await this.show({ ...sample, name: sample.name });
    this.scene.renderer.setAnimationLoop((now, frame) => this.#frame(now, frame));
    await this.headset.offer();
  }

  // Send a job to the worker; resolves with its answer, rejects with what it refuses.
  ask(kind, about = {}, transfer = []) {
    const id = ++this.jobs;
    this.worker.postMessage({ kind, id, ...about }, transfer);
    return new Promise((resolve, reject) => this.waiting.set(id, { kind, resolve, reject }));
  }

  // Show a recording: the sample with its truth, or a file's.
  async show(recording) {
    this.recording = recording;
    this.clear();
    const own = recording === this.recording && recording.skeleton;
    const made = [Body.load(own ? "sample.glb" : "body.glb", "captured", COLORS.capture)];
    if (own && recording.truth) made.push(Body.load("sample.glb", "truth", COLORS.truth));
    const [capture, truth] = await Promise.all(made);
    this.bodies = { capture, ...(truth && { truth }) };
    Object.values(this.bodies).forEach((body) => this.scene.stage.add(body.group));
    if (truth) truth.group.position.set(...this.#beside(recording.head.poses));
    const { times } = recording.head;
    Object.assign(this.clock, { time: times[0], start: times[0], end: times[times.length - 1], playing: true });
    get("legend-truth").hidden = !truth;
    get("title").textContent = recording.name;
    get("hands").disabled = !Object.keys(recording.wrists ?? {}).length;
    get("height-box").hidden = Boolean(own);
    get("seat-box").hidden = !recording.family;
    this.capture();
  }

  // Capture what is shown, anew.
  capture() {
    this.motion = new Motion(this.about.skeleton.joint_names.length);
    this.begun = false;
    const height = this.recording.skeleton ? null : Number(get("height").value) / 100 || null;
    const job = this.ask("capture", { recording: this.recording, hands: get("hands").checked, height });
    this.job = this.jobs;
    job.catch((error) => this.refuse(error.message));
  }

  clear() {
    Object.values(this.bodies).forEach((body) => body.remove());
    this.bodies = {};
  }

  async open(file) {
    if (!file) return;
    this.say(`Reading ${file.name} …`);
    try {
      this.file = { name: file.name, bytes: await file.arrayBuffer() };
      await this.read();
    } catch (error) {
      this.refuse(error.message);
    }
  }

  async read() {
    const how = { hands: get("seat").value };
    const { recording } = await this.ask("read", { ...this.file, how });
    get("error").hidden = true;
    await this.show({ ...recording, name: this.file.name });
    if (recording.family) get("seat").value = recording.family;
  }

  say(text) {
    get("status").textContent = text;
  }

  refuse(text) {
    this.errors.push(text);
    get("error").textContent = text;
    get("error").hidden = false;
    this.say("");
  }

  #hear(data) {
    const { kind, id } = data;
    const wait = this.waiting.get(id);
    if (wait && (kind === wait.kind || kind === "refused" || kind === "done")) {
      this.waiting.delete(id);
      if (kind === "refused") wait.reject(new Error(data.text));
      else wait.resolve(data);
    }
    if (id === this.headset.job) this.headset.hear(data);
    if (id !== this.job) return;
    if (kind === "begun") {
      this.bodies.capture?.scale(this.recording.skeleton ? 1 : data.height / this.about.stature);
      this.height = data;
      this.#report();
    } else if (kind === "frames") {
      this.motion.add(data.rows);
      this.spent = data.spent;
      this.#report();
    } else if (kind === "done") this.#report((this.took = data.took));
  }

  #report(took) {
    const { start, end } = this.clock;
    const size = this.height ? `${this.height.known ? "" : "assumed "}${(100 * this.height.height).toFixed(0)} cm` : "";
    const speed = this.spent ? `, ${this.spent.toFixed(0)} ms a window` : "";
    const done = took ? `, ${((1000 * (end - start)) / took).toFixed(1)} × real time` : "";
    this.say(`${this.recording.note ? `${this.recording.note}; ` : ""}${size}${speed}${done}`);
  }

  #beside(poses) {
    const [first, last] = [poses[0], poses[poses.length - 1]];
    const way = [last[0] - first[0], last[1] - first[1]];
    const length = Math.hypot(...way);
    const [x, y] = length > 0.5 ? [-way[1] / length, way[0] / length] : [0, 1];
    return [BESIDE_M * x, 0, -BESIDE_M * y];
  }

  #frame(now, frame) {
    const elapsed = Math.min((now - (this.before ?? now)) / 1000, 0.1);
    this.before = now;
    this.frames.push(now);
    while (this.frames[0] < now - 1000) this.frames.shift();
    if (frame && this.headset.session) this.headset.draw(now, frame);
    else this.#replay(elapsed);
    this.scene.draw();
    this.told ??= now;
    if (now - this.told < 1000) return;
    get("rate").textContent = `${this.frames.length} frames/s`;
    this.scene.adapt(this.frames.length);
    this.told = now;
  }

  #replay(elapsed) {
    const { clock, motion, bodies } = this;
    if (!motion?.times.length || !bodies.capture) return;
    if (clock.playing) clock.time += elapsed;
    if (clock.time > clock.end) clock.time = clock.start;
    const time = Math.min(clock.time, motion.end); // not faster than it is captured
    if (clock.playing) clock.time = time;
    const { root, quats, deviations } = motion.at(time);
    bodies.capture.pose(root, quats, deviations);
    if (this.recording.truth) bodies.truth?.play(time - this.recording.truth_start_s);
    const middle = bodies.truth ? bodies.capture.place.lerp(bodies.truth.place, 0.5) : bodies.capture.place;
    this.scene.track(middle, this.begun ? elapsed : Infinity);
    this.begun = true;
    if (!this.scrubbing) get("scrub").value = (1000 * (time - clock.start)) / Math.max(clock.end - clock.start, 1e-6);
    get("time").textContent = `${(time - clock.start).toFixed(1)} / ${(clock.end - clock.start).toFixed(1)} s`;
    get("play").textContent = clock.playing ? "Pause" : "Play";
  }

  seek(time) {
    const { start, end } = this.clock;
    this.clock.time = Math.min(Math.max(time, start), end);
  }

  #connect() {
    const resize = () => this.scene.resize();
    new ResizeObserver(resize).observe(get("view"));
    const toggle = () => (this.clock.playing = !this.clock.playing);
    get("play").onclick = toggle;
    get("scrub").oninput = ({ target }) => {
      this.scrubbing = true;
      this.clock.playing = false;
      this.seek(this.clock.start + (target.value / 1000) * (this.clock.end - this.clock.start));
    };
    get("scrub").onchange = () => (this.scrubbing = false);
    get("follow").onchange = ({ target }) => (this.scene.follow = target.checked);
    get("hands").onchange = () => this.capture();
    get("height").onchange = () => this.capture();
    get("seat").onchange = () => this.read().catch((error) => this.refuse(error.message));
    get("file").onchange = ({ target }) => this.open(target.files[0]).finally(() => (target.value = ""));
    get("open").onclick = () => get("file").click();
    get("error").onclick = ({ target }) => (target.hidden = true);
    get("sample").onclick = () => this.show(this.sample);
    get("enter").onclick = () => this.headset.enter().catch((error) => this.refuse(error.message));
    const keys = {
      " ": toggle,
      ArrowLeft: () => this.seek(this.clock.time - JUMP_S),
      ArrowRight: () => this.seek(this.clock.time + JUMP_S),
      Home: () => this.seek(this.clock.start),
      f: () => get("follow").click(),
      h: () => get("hands").click(),
      o: () => get("open").click(),
    };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
    addEventListener("dragover", (event) => {
      event.preventDefault();
      document.body.classList.add("over");
    });
    addEventListener("dragleave", (event) => event.relatedTarget ?? document.body.classList.remove("over"));
    addEventListener("drop", (event) => {
      event.preventDefault();
      document.body.classList.remove("over");
      this.open(event.dataTransfer.files[0]);
    });
  }
}

const page = new Page();
globalThis.wearcap = page; // for the console
page.start().catch((error) => page.refuse(error.message));

// Keep all files, named after the folder's contents, so that another export is noticed.
async function keep() {
  const { version } = await (await fetch("files.json", { cache: "no-cache" })).json();
  await navigator.serviceWorker.register(`sw.js?${version}`);
  await navigator.serviceWorker.ready;
  get("offline").hidden = false;
}

if ("serviceWorker" in navigator && isSecureContext) keep().catch(console.warn);
