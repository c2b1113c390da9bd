// The page: opens a recording, wires clock, pose, timeline, labels and saving together, and listens to keys.
import { HANDS, Labels } from "./labels.js";
import { Player, SPEEDS } from "./player.js";
import { Saver } from "./saver.js";
import { SkeletonView } from "./skeleton.js";
import { answer, fetchTake } from "./take.js";
import { clock, Timeline } from "./timeline.js";

const $ = id => document.getElementById(id);

class Annotator {
  constructor() {
    this.player = new Player($("video"), () => this.showClockControls(), text => { $("film-note").textContent = text; });
    this.view = new SkeletonView($("skeleton"), hand => this.toggle(hand));
    this.timeline = new Timeline($("timeline"), time => this.seek(time), (hand, place) => this.choose(hand, place));
    this.drawn = [];
    this.shown = -1;
    this.ready = this.opening = false;
    this.wire();
    this.listen();
  }

  async start() {
    try {
      this.recordings = await answer(await fetch("/recordings"));
      const names = this.recordings.map((each, index) => new Option(each.annotated ? `${each.name}  ✓` : each.name, index));
      $("recordings").replaceChildren(...names);
      const wished = this.recordings.findIndex(each => each.name === decodeURIComponent(location.hash.slice(1)));
      await this.open(Math.max(0, wished));
    } catch (error) {
      this.notify(error.message, true);
    }
    requestAnimationFrame(now => this.tick(now));
  }

  async open(index) {
    if (index < 0 || index >= this.recordings.length) return;
    this.wished = index;
    if (this.opening) return; // comes next
    this.opening = true;
    try {
      this.player.stop();
      if (this.saver) await this.saver.finish();
      this.ready = false;
      this.saver = null;
      this.index = index;
      [$("recordings").value, $("previous").disabled, $("next").disabled] = [index, index === 0, index === this.recordings.length - 1];
      history.replaceState(null, "", `#${encodeURIComponent(this.recordings[index].name)}`);
      this.notify("");
      this.showSaved("", "opening …");
      this.take = await fetchTake(index);
      this.begin();
    } catch (error) {
      this.showSaved("failed", "not opened");
      this.notify(error.message, true);
    }
    this.opening = false;
    if (this.wished !== index) await this.open(this.wished);
  }

  begin() {
    const {header} = this.take;
    document.title = `${header.name} – wearcap annotate`;
    $("film").hidden = !header.video;
    $("objects").replaceChildren(...Object.keys(header.objects).map(name => new Option(name, name)));
    if (header.notice) this.notify(header.notice);
    this.labels = new Labels(this.take);
    this.player.open(this.take);
    this.view.open(this.take);
    this.timeline.open(this.take, this.labels);
    this.choose(null, -1);
    this.saver = new Saver(this.index, this.take, this.labels, (state, text) => this.showSaved(state, text), asked => this.ask(asked));
    this.labels.changed = () => {
      this.saver.change();
      this.refresh();
    };
    if (this.restored) this.labels.become(this.restored);
    this.restored = null;
    this.ready = true;
    this.refresh();
    this.showClockControls();
  }

  tick(now) {
    const elapsed = Math.min(0.25, (now - (this.before ?? now)) / 1000);
    this.before = now;
    if (this.ready) {
      this.player.advance(elapsed);
      const frame = this.player.frame;
      if (frame !== this.shown || this.view.stale || this.timeline.stale) this.draw(frame, now);
    }
    requestAnimationFrame(next => this.tick(next));
  }

  draw(frame, now) {
    this.shown = frame;
    const time = this.take.times[frame], at = this.player.playing ? this.player.time : time;
    if (this.player.playing) this.timeline.keepInView(at);
    this.view.draw(frame, this.contact(time));
    this.timeline.draw(at);
    const origin = this.take.times[0];
    $("clock").textContent = `${clock(time - origin)} / ${clock(this.take.header.stop_s - origin)} s`;
    $("frame").textContent = `frame ${frame}`;
    this.drawn.push(now);
    if (this.drawn.length > 240) this.drawn.splice(0, 120);
  }

  contact(time) {
    return Object.fromEntries(HANDS.map(hand => [hand, this.labels.at(hand, time) >= 0]));
  }

  refresh() {
    const chosen = this.timeline.chosen;
    if (chosen && !this.labels.state[chosen.hand][chosen.place]) this.choose(null, -1);
    else this.showChosen();
    [$("undo").disabled, $("redo").disabled] = [!this.labels.before.length, !this.labels.after.length];
    this.view.stale = this.timeline.stale = true;
  }

  toggle(hand) {
    if (!this.ready) return;
    const frame = this.player.frame;
    this.labels.toggle(hand, frame);
    this.choose(hand, this.labels.at(hand, this.take.times[frame]));
  }

  choose(hand, place) {
    this.timeline.chosen = hand && place >= 0 ? {hand, place} : null;
    this.timeline.stale = true;
    this.showChosen();
  }

  showChosen() {
    const chosen = this.timeline.chosen;
    [$("chosen").hidden, $("unchosen").hidden] = [!chosen, Boolean(chosen)];
    if (!chosen) return;
    const label = this.labels.state[chosen.hand][chosen.place], origin = this.take.times[0];
    const stop = label.stop >= this.take.header.stop_s ? "end" : `${(label.stop - origin).toFixed(2)} s`;
    $("chosen-label").textContent = `${chosen.hand} hand, ${(label.start - origin).toFixed(2)} – ${stop}`;
    [$("object").value, $("class").value] = [label.object, label.kind];
  }

  /** Object of the chosen contact; an object of the recording has its own contact class. */
  describe(about) {
    const chosen = this.timeline.chosen;
    if (!chosen) return;
    const kind = this.take.header.objects[about.object];
    this.labels.describe(chosen.hand, chosen.place, kind ? {...about, kind} : about);
  }

  remove() {
    const chosen = this.timeline.chosen;
    if (!chosen) return;
    this.choose(null, -1);
    this.labels.remove(chosen.hand, chosen.place);
  }

  seek(time) {
    if (!this.ready) return;
    this.player.stop();
    this.player.seek(this.take.times[this.take.frameAt(time)]);
    this.timeline.stale = true;
  }

  step(frames) {
    const frame = this.player.frame + frames, last = this.take.times.length - 1;
    this.seek(this.take.times[Math.max(0, Math.min(frame, last))]);
    this.timeline.keepInView(this.player.time);
  }

  /** To the next edge of a contact in a direction (±1). */
  jump(direction) {
    const now = this.take.times[this.player.frame], near = 0.5 / this.take.fps;
    const edges = this.labels.edges().filter(edge => (edge - now) * direction > near);
    if (!edges.length) return;
    this.seek(direction > 0 ? edges[0] : edges[edges.length - 1]);
    this.timeline.keepInView(this.player.time);
  }

  faster(steps) {
    const place = SPEEDS.indexOf(this.player.speed) + steps;
    this.player.setSpeed(SPEEDS[Math.max(0, Math.min(place, SPEEDS.length - 1))]);
  }

  setTurn(turn) {
    $("turn").checked = turn;
    if (this.ready) this.view.setTurn(turn);
  }

  async export() {
    await this.saver.save();
    if (this.saver.dirty) return this.notify("Not exported: the labels are not saved yet.", true);
    const link = document.createElement("a");
    link.href = `/recordings/${this.index}/export`;
    link.download = "";
    link.click();
  }

  showClockControls() {
    $("play").textContent = this.player.playing ? "Pause" : "Play";
    $("speed").value = this.player.speed;
  }

  showSaved(state, text) {
    [$("saved").className, $("saved").textContent] = [state, text];
    if (state === "saved" && this.message === "not saved") this.notify("");
  }

  notify(text, failed = false) {
    const box = $("message");
    [box.hidden, box.className] = [!text, failed ? "failed" : ""];
    box.querySelector("span").textContent = text;
    [$("mine").hidden, $("theirs").hidden] = [true, true];
    this.message = "";
  }

  /** Two states of the labels, or a refused save: show it, and let the annotator choose. */
  ask({kind, labels, error}) {
    if (kind === "restored") {
      this.restored = this.read(labels);
      return;
    }
    if (kind === "refused") {
      this.notify(`Not saved: ${error} The labels stay here, and in this browser.`, true);
      this.message = "not saved";
      return;
    }
    const found = kind === "kept";
    this.notify(found ? "This browser keeps labels that were never saved, and the file has changed since." : `Not saved: ${error}`, true);
    this.offer("mine", found ? "Use this browser's" : "Save mine (the other file is kept in backups)", () => {
      if (found) this.labels.become(this.read(labels)); else this.saver.save(true);
    });
    this.offer("theirs", found ? "Use the file's" : "Load the file's", () => this.reload());
  }

  offer(id, text, action) {
    [$(id).hidden, $(id).textContent] = [false, text];
    $(id).onclick = () => {
      this.notify("");
      action();
    };
  }

  read(labels) {
    return new Labels({...this.take, header: {...this.take.header, labels}}).state;
  }

  reload() {
    localStorage.removeItem(this.saver.key);
    this.saver.dirty = false;
    this.open(this.index);
  }

  wire() {
    $("speed").replaceChildren(...SPEEDS.map(speed => new Option(`${speed}×`, speed)));
    const clicks = {
      play: () => this.player.toggle(), undo: () => this.labels.undo(), redo: () => this.labels.redo(),
      export: () => this.export(), delete: () => this.remove(), previous: () => this.open(this.index - 1),
      next: () => this.open(this.index + 1),
    };
    for (const [id, action] of Object.entries(clicks)) {
      $(id).addEventListener("click", () => {
        $(id).blur(); // space plays, whatever was clicked last
        if (this.ready || id === "previous" || id === "next") action();
      });
    }
    const released = (id, action) => $(id).addEventListener("change", event => { action(event.target); event.target.blur(); });
    released("recordings", target => this.open(Number(target.value)));
    released("speed", target => this.player.setSpeed(Number(target.value)));
    released("turn", target => this.setTurn(target.checked));
    released("object", target => this.describe({object: target.value.trim()}));
    released("class", target => this.describe({kind: target.value}));
    window.addEventListener("pagehide", () => this.saver && this.saver.leave());
    window.addEventListener("beforeunload", event => {
      if (this.saver && this.saver.failed) event.preventDefault(); // pending changes are sent on leaving
    });
  }

  listen() {
    const once = {
      " ": () => this.player.toggle(), a: () => this.toggle("left"), l: () => this.toggle("right"),
      f: () => this.setTurn(!$("turn").checked), Delete: () => this.remove(), Backspace: () => this.remove(),
      Home: () => this.seek(this.take.times[0]), End: () => this.seek(this.player.last), Escape: () => this.choose(null, -1),
      PageUp: () => this.open(this.index - 1), PageDown: () => this.open(this.index + 1),
    };
    const repeated = {
      ArrowLeft: event => this.step(event.shiftKey ? -Math.round(this.take.fps) : -1),
      ArrowRight: event => this.step(event.shiftKey ? Math.round(this.take.fps) : 1),
      ArrowUp: () => this.faster(1), ArrowDown: () => this.faster(-1),
      z: event => event.shiftKey ? this.labels.redo() : this.labels.undo(),
      "[": () => this.jump(-1), "]": () => this.jump(1),
    };
    window.addEventListener("keydown", event => {
      if (event.target.matches("input:not([type=checkbox]), select") || event.altKey) return;
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() !== "z") return;
      const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
      const action = repeated[key] || (event.repeat ? null : once[key]);
      if (once[key] || repeated[key]) event.preventDefault();
      if (action && (this.ready || key.startsWith("Page"))) action(event);
    });
  }

  // For scripts that drive the page.

  /** Where a hand's circle is on the page (pixels). */
  handPosition(hand) {
    const box = $("skeleton").getBoundingClientRect(), {x, y} = this.view.handCircle(hand);
    return [box.x + x, box.y + y];
  }

  /** Position of a time in a hand's row (pixels). */
  lanePosition(hand, time) {
    const box = $("timeline").getBoundingClientRect();
    return [box.x + this.timeline.x(time), box.y + this.timeline.laneTop(hand) + 16];
  }

  /** Draws in the last second that was drawn. */
  get framesPerSecond() {
    const last = this.drawn[this.drawn.length - 1];
    return this.drawn.filter(time => time > last - 1000).length;
  }
}

window.annotator = new Annotator();
window.annotator.start();
