// Vectors of three numbers, and rotations as nine: the rows of the matrix one after the other. As wearcap.geometry.rotation.

export const EYE = Object.freeze([1, 0, 0, 0, 1, 0, 0, 0, 1]);

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const lerp = (a, b, share) => a.map((value, k) => value + share * (b[k] - value));
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => scale(a, 1 / Math.max(norm(a), 1e-12));

export function mul(a, b) {
  const product = new Array(9);
  for (let row = 0; row < 9; row += 3) {
    for (let column = 0; column < 3; column++) {
      product[row + column] = a[row] * b[column] + a[row + 1] * b[3 + column] + a[row + 2] * b[6 + column];
    }
  }
  return product;
}

export const transpose = (a) => [a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]];
export const turned = (a, v) => [0, 3, 6].map((row) => a[row] * v[0] + a[row + 1] * v[1] + a[row + 2] * v[2]);
export const column = (a, k) => [a[k], a[3 + k], a[6 + k]];
export const ofColumns = (x, y, z) => [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];

// Rotation matrix of the first two columns, which need not be orthonormal.
export function ofTwo(first, second) {
  const x = unit(first);
  const y = unit(sub(second, scale(x, dot(x, second))));
  return ofColumns(x, y, cross(x, y));
}

export function ofQuat([x, y, z, w]) {
  const n = 2 / Math.max(x * x + y * y + z * z + w * w, 1e-30);
  return [
    1 - n * (y * y + z * z), n * (x * y - z * w), n * (x * z + y * w),
    n * (x * y + z * w), 1 - n * (x * x + z * z), n * (y * z - x * w),
    n * (x * z - y * w), n * (y * z + x * w), 1 - n * (x * x + y * y),
  ];
}

// Unit quaternion x, y, z, w.
export function toQuat(a) {
  const squares = [1 + a[0] - a[4] - a[8], 1 - a[0] + a[4] - a[8], 1 - a[0] - a[4] + a[8], 1 + a[0] + a[4] + a[8]];
  const largest = squares.indexOf(Math.max(...squares));
  const [xy, xz, yz] = [a[3] + a[1], a[6] + a[2], a[7] + a[5]];
  const [xw, yw, zw] = [a[7] - a[5], a[2] - a[6], a[3] - a[1]];
  const rows = [[squares[0], xy, xz, xw], [xy, squares[1], yz, yw], [xz, yz, squares[2], zw], [xw, yw, zw, squares[3]]];
  const length = Math.hypot(...rows[largest]);
  return rows[largest].map((value) => value / length);
}

export function slerp(p, q, share) {
  const cosine = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
  const sign = cosine < 0 ? -1 : 1;
  const angle = Math.acos(Math.min(Math.abs(cosine), 1));
  const sine = Math.sin(angle);
  const [a, b] = sine < 1e-6 ? [1 - share, share] : [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
  const mixed = p.map((value, k) => a * value + sign * b * q[k]);
  const length = Math.hypot(...mixed);
  return mixed.map((value) => value / length);
}

// Rotation at a share (0 … 1) of the turn from a to b.
export const between = (a, b, share) => ofQuat(slerp(toQuat(a), toQuat(b), share));

// Angle between two rotations (rad).
export function angle(a, b) {
  const turn = mul(transpose(a), b);
  return Math.atan2(Math.hypot(turn[7] - turn[5], turn[2] - turn[6], turn[3] - turn[1]), turn[0] + turn[4] + turn[8] - 1);
}

export const aboutZ = (rad) => [Math.cos(rad), -Math.sin(rad), 0, Math.sin(rad), Math.cos(rad), 0, 0, 0, 1];

// Heading (rad) about the vertical: where x points, or, of one that looks steeply up or down, z.
export function yaw(a) {
  const steep = Math.abs(a[6]) > 0.9;
  const [x, y] = steep ? [-a[2] * Math.sign(a[6]), -a[5] * Math.sign(a[6])] : [a[0], a[3]];
  return Math.atan2(y, x);
}

// The smallest rotation that turns direction a onto direction b.
export function swing(from, onto) {
  const [a, b] = [unit(from), unit(onto)];
  const cosine = dot(a, b);
  if (cosine < -1 + 1e-6) {
    const sizes = a.map(Math.abs);
    const across = unit(cross(a, [0, 1, 2].map((k) => (k === sizes.indexOf(Math.min(...sizes)) ? 1 : 0))));
    return EYE.map((one, k) => 2 * across[Math.floor(k / 3)] * across[k % 3] - one);
  }
  const v = cross(a, b);
  const K = [0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0];
  const square = mul(K, K);
  return EYE.map((one, k) => one + K[k] + square[k] / Math.max(1 + cosine, 1e-6));
}
