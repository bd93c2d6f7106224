// A camera that orbits about a target or flies; z is up. Matrices are sixteen numbers, column by column.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => { const n = norm(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
const middle = ([low, high]) => low.map((value, k) => (value + high[k]) / 2);
const move = (m, p) => [0, 1, 2].map((k) => m[k] * p[0] + m[4 + k] * p[1] + m[8 + k] * p[2] + m[12 + k]);

class Camera {
  constructor() {
    this.target = [0, 0, 0];
    this.distance = 10;
    this.yaw = 0.9;
    this.pitch = 0.45;
    this.field = 0.75;
    this.extent = 10;
  }

  // From the target to the eye.
  back() {
    const c = Math.cos(this.pitch);
    return [c * Math.sin(this.yaw), -c * Math.cos(this.yaw), Math.sin(this.pitch)];
  }

  eye() { return add(this.target, this.back(), this.distance); }

  axes() {
    const back = this.back();
    const right = [Math.cos(this.yaw), Math.sin(this.yaw), 0];
    return { back, right, up: cross(back, right) };
  }

  // Clip from scene, as a DOMMatrix, which is of double precision and can be inverted.
  matrix(aspect) {
    const { back, right, up } = this.axes();
    const eye = this.eye();
    const near = Math.max(this.distance * 0.01, 0.01);
    const far = this.distance * 3 + this.extent * 4;
    const f = 1 / Math.tan(this.field / 2);
    const view = new DOMMatrix([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ]);
    const lens = new DOMMatrix([
      f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0,
    ]);
    this.near = near;
    this.far = far;
    return lens.multiply(view);
  }

  see([low, high], closeness = 1) {
    this.target = middle([low, high]);
    this.distance = Math.max(norm(add(high, low, -1)) / 2 / Math.sin(this.field / 2) * closeness, 0.1);
  }

  turn(x, y, flying) {
    const eye = this.eye();
    this.yaw -= x * 0.006;
    this.pitch = Math.min(Math.max(this.pitch + y * 0.006, -1.55), 1.55);
    if (flying) this.target = add(eye, this.back(), -this.distance);
  }

  pan(x, y, height) {
    const { right, up } = this.axes();
    const step = 2 * this.distance * Math.tan(this.field / 2) / height;
    this.target = add(add(this.target, right, -x * step), up, y * step);
  }

  zoom(factor) { this.distance = Math.min(Math.max(this.distance * factor, 0.02), this.extent * 20); }

  // Metres to the right, upwards and ahead.
  fly(right, up, ahead) {
    const axes = this.axes();
    this.target = add(add(add(this.target, axes.right, right), [0, 0, 1], up), axes.back, -ahead);
  }
}
