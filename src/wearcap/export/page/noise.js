// Normally distributed numbers as PyTorch's generator on the CPU draws them, so that a seed means the same in both: the
// Mersenne Twister (Matsumoto & Nishimura 1998), and Box and Muller's transform in blocks of sixteen.

const [SIZE, MIDDLE, BLOCK] = [624, 397, 16];

export class Generator {
  constructor(seed) {
    this.state = new Uint32Array(SIZE);
    this.state[0] = seed >>> 0;
    for (let k = 1; k < SIZE; k++) {
      const before = this.state[k - 1] ^ (this.state[k - 1] >>> 30);
      this.state[k] = Math.imul(before, 1812433253) + k;
    }
    this.next = SIZE;
  }

  #word() {
    const { state } = this;
    if (this.next === SIZE) {
      for (let k = 0; k < SIZE; k++) {
        const y = (state[k] & 0x80000000) | (state[(k + 1) % SIZE] & 0x7fffffff);
        state[k] = state[(k + MIDDLE) % SIZE] ^ (y >>> 1) ^ (y & 1 ? 0x9908b0df : 0);
      }
      this.next = 0;
    }
    let y = state[this.next++];
    y ^= y >>> 11;
    y ^= (y << 7) & 0x9d2c5680;
    y ^= (y << 15) & 0xefc60000;
    return (y ^ (y >>> 18)) >>> 0;
  }

  #uniform() {
    return (this.#word() & 0xffffff) / 0x1000000;
  }

  // `count` values, sixteen or more: the last block of another count overlaps the one before.
  randn(count) {
    const values = new Float32Array(count);
    for (let k = 0; k < count; k++) values[k] = this.#uniform();
    for (let start = 0; start + BLOCK <= count; start += BLOCK) this.#transform(values, start);
    if (count % BLOCK) {
      for (let k = count - BLOCK; k < count; k++) values[k] = this.#uniform();
      this.#transform(values, count - BLOCK);
    }
    return values;
  }

  #transform(values, start) {
    for (let k = start; k < start + BLOCK / 2; k++) {
      const radius = Math.sqrt(-2 * Math.log(1 - values[k]));
      const angle = 2 * Math.PI * values[k + BLOCK / 2];
      values[k] = radius * Math.cos(angle);
      values[k + BLOCK / 2] = radius * Math.sin(angle);
    }
  }
}
