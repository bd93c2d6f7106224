// Points, models and the scan around, on one canvas. Draws only when something has changed.

const NO_CUT = 1e9;
const AROUND = 0xffffff;
const SLOW_MS = 45, REST_MS = 180;

class Viewer {
  constructor(canvas, facts, buffers, scale) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    Object.assign(this, { gl, canvas, facts, scale, camera: new Camera(), selected: -1, colouring: 0, share: 1, part: 1, limit: facts.full });
    this.layers = { points: true, model: true, design: false, around: true };
    this.cut = [[-NO_CUT, -NO_CUT, -NO_CUT], [NO_CUT, NO_CUT, NO_CUT]];
    this.colours = {};
    this.drawn = () => {};
    this.programs = {
      points: this.program(POINTS_VERTEX, POINTS_FRAGMENT),
      shape: this.program(SHAPE_VERTEX, SHAPE_FRAGMENT),
      pickPoints: this.program(POINTS_VERTEX, PICK_FRAGMENT),
      pickShape: this.program(SHAPE_VERTEX, PICK_FRAGMENT),
      screen: this.program(SCREEN_VERTEX, SCREEN_FRAGMENT),
    };
    this.load(buffers);
    this.boxes = facts.items.map((item) => this.boxOf(item));
    this.extent = this.around(this.boxes.filter(Boolean));
    this.camera.extent = norm(add(this.extent[1], this.extent[0], -1));
    this.camera.see(this.extent, 0.8);
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.bindAttribLocation(program, 1, "value");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no program");
    const at = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const name = gl.getActiveUniform(program, k).name;
      at[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  load({ positions, values, vertices, faces }) {
    const { gl } = this;
    const filled = (target, bytes) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(target, buffer);
      gl.bufferData(target, bytes, gl.STATIC_DRAW);
      return buffer;
    };
    this.values = new Int8Array(values.buffer);
    const places = filled(gl.ARRAY_BUFFER, positions);
    const told = filled(gl.ARRAY_BUFFER, values);
    const corners = filled(gl.ARRAY_BUFFER, vertices);
    // Attributes begin where a cloud or shape does, so each has a vertex array of its own.
    const cloud = (where) => {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, places);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 6, where.first * 6);
      gl.bindBuffer(gl.ARRAY_BUFFER, told);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 1, gl.BYTE, true, 1, where.first);
      return { array, ...where };
    };
    this.clouds = this.facts.items.map((item) => item.cloud && cloud(item.cloud));
    this.scan = this.facts.around && cloud(this.facts.around);
    let vertex = 0, face = 0;
    gl.bindVertexArray(null);
    const indices = filled(gl.ELEMENT_ARRAY_BUFFER, faces);
    this.shapes = this.facts.shapes.map((shape) => {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, corners);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 12, vertex * 12);
      const made = { array, vertices: shape.vertices, faces: shape.faces, first: face * 12, low: shape.low, high: shape.high };
      vertex += shape.vertices;
      face += shape.faces;
      return made;
    });
    gl.bindVertexArray(null);
  }

  boxOf(item) {
    const boxes = [];
    if (item.cloud) boxes.push([item.cloud.low, add(item.cloud.low, item.cloud.size)]);
    const pose = item.stands || item.design;
    const shape = this.facts.shapes[item.shape];
    if (pose && shape) {
      const corners = [];
      for (let k = 0; k < 8; k++) corners.push(move(pose, [0, 1, 2].map((j) => ((k >> j) & 1 ? shape.high : shape.low)[j])));
      for (const corner of corners) boxes.push([corner, corner]);
    } else if (pose) boxes.push([pose.slice(12, 15), pose.slice(12, 15)]);
    return boxes.length ? this.around(boxes) : null;
  }

  around(boxes) {
    if (!boxes.length) return [[-1, -1, -1], [1, 1, 1]];
    return [0, 1, 2].reduce(([low, high], k) => [
      [...low, Math.min(...boxes.map((box) => box[0][k]))], [...high, Math.max(...boxes.map((box) => box[1][k]))],
    ], [[], []]);
  }

  // While things move, a slow machine draws fewer points, which are in an order drawn by chance; all when they stand.
  redraw(moving = false) {
    clearTimeout(this.resting);
    this.moving = moving;
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const now = performance.now();
      const took = this.moving && this.last ? now - this.last : 0;
      this.last = this.moving ? now : 0;
      if (took) this.part = Math.min(Math.max(this.part * (took > SLOW_MS ? 0.5 : 1.1), 0.05), 1);
      this.share = this.moving ? this.part : 1;
      this.draw();
      this.share = 1;
      // Counted from the next frame, which waits for this one: a slow one would seem a rest.
      if (this.moving) requestAnimationFrame(() => {
        clearTimeout(this.resting);
        this.resting = setTimeout(() => this.redraw(), REST_MS);
      });
    });
  }

  resize() {
    const { gl, canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
    if (this.frame && canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    const texture = (format) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      return made;
    };
    const frame = (...kinds) => {
      const made = { buffer: gl.createFramebuffer(), textures: kinds.map(texture) };
      gl.bindFramebuffer(gl.FRAMEBUFFER, made.buffer);
      [gl.COLOR_ATTACHMENT0, gl.DEPTH_ATTACHMENT].forEach((to, k) =>
        gl.framebufferTexture2D(gl.FRAMEBUFFER, to, gl.TEXTURE_2D, made.textures[k], 0));
      return made;
    };
    for (const old of [this.frame, this.picks].filter(Boolean)) {
      old.textures.forEach((one) => gl.deleteTexture(one));
      gl.deleteFramebuffer(old.buffer);
    }
    this.frame = frame(gl.RGBA8, gl.DEPTH_COMPONENT24);
    this.picks = frame(gl.RGBA32UI, gl.DEPTH_COMPONENT24);
  }

  use({ program, at }) {
    const { gl } = this;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.clipFromScene, false, this.clip.toFloat32Array());
    gl.uniform3fv(at.cutLow, this.cut[0]);
    gl.uniform3fv(at.cutHigh, this.cut[1]);
    return at;
  }

  draw() {
    this.resize();
    const { gl, canvas, camera, colours } = this;
    this.clip = camera.matrix(canvas.width / canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame.buffer);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...colours.paper, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.drawClouds();
    this.drawShapes();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    const at = this.use(this.programs.screen);
    this.frame.textures.forEach((texture, k) => {
      gl.activeTexture(gl.TEXTURE0 + k);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(at.picture, 0);
    gl.uniform1i(at.depths, 1);
    gl.uniform1f(at.near, camera.near);
    gl.uniform1f(at.far, camera.far);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.drawn();
  }

  drawClouds() {
    const { gl, colours } = this;
    const at = this.use(this.programs.points);
    gl.uniform3fv(at.faded, colours.scan);
    gl.uniform1f(at.full, this.facts.full);
    gl.uniform1f(at.limit, this.limit + this.facts.full / 254);
    gl.uniform3fv(at.within, colours.in);
    gl.uniform3fv(at.stops, this.scale.flatMap(([, colour]) => colour.map((c) => c / 255)));
    this.clouds.forEach((cloud, k) => {
      if (!cloud || !this.layers.points) return;
      gl.uniform1i(at.how, this.colouring);
      gl.uniform3fv(at.flatColour, this.colourOf(k));
      gl.uniform1f(at.fade, this.selected >= 0 && k !== this.selected ? 0.75 : 0);
      this.drawCloud(at, cloud);
    });
    if (!this.scan || !this.layers.around) return;
    gl.uniform1i(at.how, 3);
    gl.uniform3fv(at.flatColour, colours.scan);
    gl.uniform1f(at.fade, 0);
    this.drawCloud(at, this.scan);
  }

  drawCloud(at, cloud) {
    const { gl } = this;
    gl.uniform3fv(at.low, cloud.low);
    gl.uniform3fv(at.size, cloud.size);
    gl.uniform1f(at.width, this.spacing(cloud) * this.canvas.height / (2 * Math.tan(this.camera.field / 2)));
    gl.uniform1f(at.least, 1.5 * Math.min(window.devicePixelRatio || 1, 2));
    gl.bindVertexArray(cloud.array);
    gl.drawArrays(gl.POINTS, 0, Math.ceil(cloud.count * this.share));
  }

  drawShapes() {
    const { gl, camera } = this;
    const at = this.use(this.programs.shape);
    gl.uniform3fv(at.towards, camera.back());
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 8);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    for (const { k, pose, shape, ghost } of this.posed()) {
      // Where nothing was found, the design is all there is to see; behind points a model only hints at the shape.
      const lone = !this.facts.items[k].cloud;
      gl.uniform3fv(at.flatColour, ghost ? this.colours.design : this.modelColour(k));
      gl.uniform1f(at.opacity, lone && !ghost ? (k === this.selected ? 0.75 : 0.5) : 0.3);
      gl.uniform1i(at.faces, shape.faces > 0);
      gl.depthMask(lone && k === this.selected);
      this.drawShape(at, shape, pose);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  // The shapes that are to be drawn, and where.
  posed() {
    const told = [];
    this.facts.items.forEach((item, k) => {
      const shape = this.shapes[item.shape];
      if (!shape) return;
      const pose = item.stands || item.design;
      if (this.layers.model && pose) told.push({ k, pose, shape, ghost: false });
      if (item.design && item.stands && (this.layers.design || k === this.selected)) told.push({ k, pose: item.design, shape, ghost: true });
    });
    return told;
  }

  drawShape(at, shape, pose) {
    const { gl } = this;
    gl.uniformMatrix4fv(at.sceneFromShape, false, pose);
    gl.bindVertexArray(shape.array);
    if (shape.faces) gl.drawElements(gl.TRIANGLES, shape.faces * 3, gl.UNSIGNED_INT, shape.first);
    else gl.drawArrays(gl.POINTS, 0, shape.vertices);
  }

  colourOf(k) {
    const item = this.facts.items[k];
    return this.colours[item.verdict] || this.colours[item.status] || this.colours.none;
  }

  // A model behind its coloured points is grey, or its colour would be read as a deviation.
  modelColour(k) {
    return this.colouring === 2 || !this.facts.items[k].cloud ? this.colourOf(k) : this.colours.none;
  }

  // How wide a cloud's points are in the scene so that its surface closes: from its box, as if it were evenly covered.
  spacing(cloud) {
    const [x, y, z] = cloud.size;
    return 0.7 * Math.sqrt((x * y + y * z + z * x) / cloud.count);
  }

  // What is at a pixel of the page: { item (-1: the scan around), at: [x, y, z] }, or null.
  pick(x, y) {
    const { gl, canvas } = this;
    this.draw();
    const ratio = canvas.width / canvas.clientWidth;
    const [column, row] = [Math.floor(x * ratio), Math.floor(canvas.height - y * ratio)];
    const reach = Math.round(5 * ratio), side = 2 * reach + 1;
    const [left, low] = [Math.max(column - reach, 0), Math.max(row - reach, 0)];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picks.buffer);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, low, side, side);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    let at = this.use(this.programs.pickPoints);
    this.clouds.forEach((cloud, k) => {
      if (!cloud || !this.layers.points) return;
      gl.uniform1ui(at.item, k + 1);
      this.drawCloud(at, cloud);
    });
    if (this.scan && this.layers.around) {
      gl.uniform1ui(at.item, AROUND);
      this.drawCloud(at, this.scan);
    }
    at = this.use(this.programs.pickShape);
    for (const { k, pose, shape, ghost } of this.posed()) {
      if (ghost) continue;
      gl.uniform1ui(at.item, k + 1);
      this.drawShape(at, shape, pose);
    }
    const told = new Uint32Array(side * side * 4);
    gl.readPixels(left, low, side, side, gl.RGBA_INTEGER, gl.UNSIGNED_INT, told);
    gl.disable(gl.SCISSOR_TEST);
    const depths = new Float32Array(told.buffer);
    let best = null;
    for (let k = 0; k < side * side; k++) {
      if (!told[4 * k]) continue;
      const [c, r] = [left + k % side, low + Math.floor(k / side)];
      const off = Math.hypot(c - column, r - row);
      if (!best || off < best.off) best = { off, c, r, item: told[4 * k], depth: depths[4 * k + 1] };
    }
    if (!best) return null;
    const seen = this.clip.inverse().transformPoint(new DOMPoint(
      (best.c + 0.5) / canvas.width * 2 - 1, (best.r + 0.5) / canvas.height * 2 - 1, best.depth * 2 - 1, 1));
    return { item: best.item === AROUND ? -1 : best.item - 1, at: [seen.x / seen.w, seen.y / seen.w, seen.z / seen.w] };
  }

  // Where a point of the scene is on the page, or null where it is behind the eye.
  onPage(point) {
    const clip = this.clip.transformPoint(new DOMPoint(...point, 1));
    if (clip.w <= 0) return null;
    const { clientWidth, clientHeight } = this.canvas;
    return [(clip.x / clip.w + 1) / 2 * clientWidth, (1 - clip.y / clip.w) / 2 * clientHeight];
  }

  // Which share of an item's points lies within the limit; null where it has none.
  within(k) {
    const cloud = this.clouds[k];
    if (!cloud) return null;
    const most = this.limit / this.facts.full * 127 + 0.5; // half a step: what is at the limit is within it
    let count = 0;
    for (let j = cloud.first; j < cloud.first + cloud.count; j++) count += Math.abs(this.values[j]) <= most;
    return count / cloud.count;
  }
}
