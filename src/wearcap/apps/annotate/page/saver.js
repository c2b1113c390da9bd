// Saves a while after each change, tries again while the server is away, and keeps what is not saved in the browser.
import { same } from "./labels.js";

const WAIT_MS = 400, RETRY_MS = 2000;
// One page's name for itself: a reply that was lost is no conflict with oneself.
const CLIENT = crypto.randomUUID();

export class Saver {
  /** `show(state, text)`: "saved", "unsaved" or "failed"; `ask(conflict)`: labels that must be chosen between. */
  constructor(index, take, labels, show, ask) {
    Object.assign(this, {index, labels, show, ask});
    const {name, frames, start_s, revision} = take.header;
    this.key = `wearcap annotate ${name} ${frames} ${start_s}`;
    this.base = revision;
    this.dirty = this.busy = this.closed = this.failed = false;
    this.version = 0;
    this.refused = null;
    this.recover(take.header.labels);
  }

  /** What an earlier page could not save, unless it was saved after all. */
  recover(stored) {
    let kept = null;
    try { kept = JSON.parse(localStorage.getItem(this.key)); } catch { /* written by nobody we know */ }
    if (!kept || !kept.labels || same(kept.labels, stored)) {
      localStorage.removeItem(this.key);
      return this.show("saved", "saved");
    }
    if (kept.base === this.base) {
      this.ask({kind: "restored", labels: kept.labels});
    } else {
      this.show("unsaved", "unsaved labels found");
      this.ask({kind: "kept", labels: kept.labels});
    }
  }

  change() {
    this.dirty = true;
    this.version += 1;
    this.refused = null;
    this.keep();
    this.show("unsaved", "unsaved …");
    this.plan(WAIT_MS);
  }

  keep() {
    try {
      localStorage.setItem(this.key, JSON.stringify({labels: this.labels.toFile(), base: this.base}));
    } catch { /* no room: the server still gets it */ }
  }

  plan(wait) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.save(), wait);
  }

  async save(force = false) {
    clearTimeout(this.timer);
    if (this.busy || (!this.dirty && !force)) return;
    this.busy = true;
    const version = this.version;
    try {
      const reply = await this.post(force, false);
      const answer = await reply.json();
      if (reply.ok) {
        this.base = answer.revision;
        if (version === this.version) this.done(); else this.keep();
      } else if (reply.status === 403) { // another start has another token; its page brings it to this one too
        this.later("not saved: the server was restarted, open the address that it printed");
      } else {
        this.refuse(reply.status, answer.error);
      }
    } catch {
      this.later("not saved: the server does not answer, trying again");
    }
    this.busy = false;
    if (this.dirty && version !== this.version && !this.closed) this.plan(WAIT_MS);
  }

  done() {
    this.dirty = this.failed = false;
    localStorage.removeItem(this.key);
    this.show("saved", "saved");
  }

  later(text) {
    this.failed = true;
    this.show("failed", text);
    if (!this.closed) this.plan(RETRY_MS);
  }

  refuse(status, error) {
    this.refused = error;
    this.failed = true;
    this.show("failed", "not saved");
    this.ask({kind: status === 409 ? "conflict" : "refused", error});
  }

  post(force, leaving) {
    const body = JSON.stringify({labels: this.labels.toFile(), base: this.base, client: CLIENT, force});
    return fetch(`/recordings/${this.index}/labels`, {
      method: "POST", headers: {"Content-Type": "application/json"}, body,
      // A browser sends 64 kB after a page has closed; longer requests stay in its storage.
      keepalive: leaving && body.length < 60000,
    });
  }

  /** The page closes: send the remaining changes without waiting. */
  leave() {
    if (this.dirty && !this.refused) this.post(false, true).catch(() => {});
  }

  /** Another recording is opened: save first, however long it takes. */
  async finish() {
    while (this.dirty && !this.refused) {
      await this.save();
      if (this.dirty) await new Promise(resume => setTimeout(resume, 200));
    }
    this.closed = true;
    clearTimeout(this.timer);
  }
}
