// The contacts of each hand on the recording's clock, with undo. States are never changed in place.
export const HANDS = ["left", "right"];
const NEAR = 1e-6;

export class Labels {
  constructor(take) {
    this.take = take;
    this.state = fromFile(take.header.labels, take.header.stop_s);
    this.before = [];
    this.after = [];
    this.changed = () => {};
  }

  /** Time (s) at which a frame begins; the one after the last is the recording's end. */
  edge(frame) {
    return frame >= this.take.times.length ? this.take.header.stop_s : this.take.times[Math.max(frame, 0)];
  }

  /** Place of the contact that holds at a time, or -1. */
  at(hand, time) {
    return this.state[hand].findIndex(label => label.start <= time + NEAR && time + NEAR < label.stop);
  }

  /** A contact that holds at this frame ends here; else one starts, and lasts to the next one or to the end. */
  toggle(hand, frame) {
    const list = this.state[hand].slice(), time = this.edge(frame), place = this.at(hand, time);
    if (place < 0) {
      const following = list.findIndex(label => label.start > time);
      const stop = following < 0 ? this.take.header.stop_s : list[following].start;
      list.splice(following < 0 ? list.length : following, 0, {start: time, stop, object: "", kind: ""});
    } else if (list[place].start > time - NEAR) {
      list.splice(place, 1);
    } else {
      list[place] = {...list[place], stop: time};
    }
    this.become({...this.state, [hand]: list});
  }

  /** The state with one edge ("start" or "stop") moved to a frame, kept between the neighbours and one frame long. */
  withEdge(hand, place, which, frame) {
    const list = this.state[hand].slice(), label = list[place];
    let time = this.edge(frame);
    if (which === "start") {
      const least = place ? list[place - 1].stop : this.take.times[0];
      time = Math.max(least, Math.min(time, this.edge(this.take.frameAt(label.stop - NEAR))));
    } else {
      const most = place + 1 < list.length ? list[place + 1].start : this.take.header.stop_s;
      time = Math.min(most, Math.max(time, this.edge(this.take.frameAt(label.start + NEAR) + 1)));
    }
    list[place] = {...label, [which]: time};
    return {...this.state, [hand]: list};
  }

  describe(hand, place, about) {
    const list = this.state[hand].slice();
    list[place] = {...list[place], ...about};
    this.become({...this.state, [hand]: list});
  }

  remove(hand, place) {
    this.become({...this.state, [hand]: this.state[hand].filter((_, other) => other !== place)});
  }

  /** All edges in order (s). */
  edges() {
    return HANDS.flatMap(hand => this.state[hand].flatMap(label => [label.start, label.stop])).sort((a, b) => a - b);
  }

  become(state) {
    if (JSON.stringify(state) === JSON.stringify(this.state)) return;
    this.before.push(this.state);
    this.after = [];
    this.state = state;
    this.changed();
  }

  undo() { this.step(this.before, this.after); }
  redo() { this.step(this.after, this.before); }

  step(taken, given) {
    if (!taken.length) return;
    given.push(this.state);
    this.state = taken.pop();
    this.changed();
  }

  /** What is stored: H-contact's pairs (end < start: to the end of the recording), objects and classes beside them. */
  toFile() {
    const end = this.take.header.stop_s, file = {contacts: {}, objects: {}, classes: {}};
    for (const hand of HANDS) {
      const list = this.state[hand], name = `${hand}_hand`;
      file.contacts[name] = list.map(label => [label.start, label.stop < end ? label.stop : Math.min(-1, label.start - 1)]);
      file.objects[name] = list.map(label => label.object);
      file.classes[name] = list.map(label => label.kind);
    }
    return file;
  }
}

export function fromFile(file, end) {
  const state = {};
  for (const hand of HANDS) {
    const name = `${hand}_hand`;
    state[hand] = file.contacts[name].map(([start, stop], place) => (
      {start, stop: stop < start ? end : stop, object: file.objects[name][place], kind: file.classes[name][place]}));
  }
  return state;
}

/** Whether two stored states are equal. */
export function same(one, other) {
  return ["contacts", "objects", "classes"].every(key => HANDS.every(hand =>
    JSON.stringify(one[key][`${hand}_hand`]) === JSON.stringify(other[key][`${hand}_hand`])));
}
