// The clock: plays, stops, seeks; the film and the pose show the same moment.
import { along } from "./take.js";

export const SPEEDS = [0.25, 0.5, 0.75, 1, 1.25, 1.5, 2];
// A picture of the film begins at its time; a little later one is surely past a rounded edge.
const INSIDE_S = 0.002;

export class Player {
  /** `onPlay()`: it started or stopped; `onNote(text)`: messages about the video. */
  constructor(video, onPlay, onNote) {
    Object.assign(this, {video, onPlay, onNote, playing: false, speed: 1, time: 0, usable: false});
    video.addEventListener("seeked", () => this.follow());
    video.addEventListener("loadeddata", () => { this.usable = true; this.wanted = this.filmTime(); this.follow(); });
    video.addEventListener("error", () => {
      if (!this.take || !this.take.header.video) return;
      this.usable = false;
      onNote(`This browser cannot play ${this.take.header.video.file}: H.264 in .mp4, or VP9 in .webm, always works.`);
    });
  }

  open(take) {
    this.stop();
    this.take = take;
    this.usable = false;
    this.wanted = null;
    this.time = take.times[0];
    this.onNote("");
    if (take.header.video) this.video.src = `/recordings/${take.index}/video`;
    else this.video.removeAttribute("src");
    this.video.load();
  }

  get frame() { return this.take.frameAt(this.time); }
  get last() { return this.take.times[this.take.times.length - 1]; }

  filmTime(time = this.time) { return along(this.take.header.video.times, time, 0); }

  /** Whether the film has a picture of this moment. */
  filmed() {
    if (!this.usable) return false;
    const at = this.filmTime();
    return at >= 0 && at < this.video.duration - 0.02;
  }

  toggle() { if (this.playing) this.stop(); else this.play(); }

  play() {
    if (this.time >= this.last) this.seek(this.take.times[0]);
    this.playing = true;
    this.wanted = null;
    this.onPlay();
  }

  stop() {
    if (!this.playing) return;
    this.playing = false;
    this.video.pause();
    this.seek(this.time);
    this.onPlay();
  }

  setSpeed(speed) {
    this.speed = speed;
    this.video.playbackRate = speed;
    this.onPlay();
  }

  /** Show a moment; the frame that has begun by then is the one that labels go to. */
  seek(time) {
    this.time = Math.min(Math.max(time, this.take.times[0]), this.last);
    if (!this.usable) return;
    this.wanted = Math.max(0, Math.min(this.filmTime() + INSIDE_S, this.video.duration - 0.001));
    this.follow();
  }

  /** One seek at a time: browsers that are sent more show none of them. */
  follow() {
    if (this.wanted === null || this.video.seeking || !this.usable) return;
    const wanted = this.wanted;
    this.wanted = null;
    if (Math.abs(this.video.currentTime - wanted) > 1e-4) this.video.currentTime = wanted;
  }

  /** Advance by wall time (s). While the video plays it is the clock; if it buffers, the pose waits too. */
  advance(elapsed) {
    if (!this.playing) return;
    if (!this.filmed()) {
      if (!this.video.paused) this.video.pause();
      this.time += elapsed * this.speed;
    } else if (this.video.seeking || this.wanted !== null) {
      this.follow();
    } else if (this.video.paused) {
      const at = this.filmTime();
      if (Math.abs(this.video.currentTime - at) > 0.05) this.video.currentTime = at;
      this.video.playbackRate = this.speed;
      this.video.play().catch(() => {});
    } else if (this.video.readyState >= 2) {
      this.time = Math.max(this.time, along(this.take.header.video.times, this.video.currentTime, 1));
    }
    if (this.time >= this.last) {
      this.time = this.last;
      this.stop();
    }
  }
}
