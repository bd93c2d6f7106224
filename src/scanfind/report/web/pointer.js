// Mouse, fingers and keys: turn, shift, zoom, fly; a press that does not move is a click.

const KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, 1, 0], q: [0, -1, 0] };

function listen(viewer, onClick) {
  const { canvas, camera } = viewer;
  const down = new Map();
  const held = new Set();
  let moved = 0, spread = 0;
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    down.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
    if (down.size === 1) moved = 0;
    spread = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    down.set(event.pointerId, event);
    moved += Math.hypot(x, y);
    if (down.size === 2) {
      const [one, other] = [...down.values()];
      const now = Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (spread) camera.zoom(spread / now);
      spread = now;
      camera.pan(x / 2, y / 2, canvas.clientHeight);
    } else if (event.buttons & 6 || event.shiftKey) camera.pan(x, y, canvas.clientHeight);
    else camera.turn(x, y, viewer.flying);
    viewer.redraw(true);
  });
  const up = (event) => {
    if (!down.delete(event.pointerId) || event.type !== "pointerup" || moved > 4 || event.button) return;
    const box = canvas.getBoundingClientRect();
    onClick(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (viewer.flying) camera.fly(0, 0, -event.deltaY * 0.001 * camera.distance);
    else camera.zoom(Math.exp(event.deltaY * 0.0012));
    viewer.redraw(true);
  }, { passive: false });
  let last = 0;
  const step = (now) => {
    const seconds = Math.min((now - last) / 1000, 0.1);
    last = now;
    for (const key of held) camera.fly(...KEYS[key].map((way) => way * seconds * camera.extent * 0.15));
    if (!held.size) return;
    viewer.redraw(true);
    requestAnimationFrame(step);
  };
  canvas.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    if (!viewer.flying || !KEYS[key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    if (!held.size) { last = performance.now(); requestAnimationFrame(step); }
    held.add(key);
  });
  canvas.addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()));
  canvas.addEventListener("blur", () => held.clear());
}
