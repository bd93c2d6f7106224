// The page: the table, the pane of what is chosen, and what the buttons do to the viewer.

const $ = (id) => document.getElementById(id);
const rows = [...document.querySelectorAll("#table tbody tr")];
const MM = 1000;

function bytes(id) {
  const text = atob($(id).textContent);
  const made = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) made[k] = text.charCodeAt(k);
  $(id).textContent = "";
  return made;
}

function length(metres) {
  return metres >= 1 ? `${metres.toFixed(3)} m` : `${(metres * MM).toFixed(1)} mm`;
}

function colour(name) {
  const probe = document.createElement("span");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const numbers = getComputedStyle(probe).color.match(/[\d.]+/g).slice(0, 3).map((c) => c / 255);
  probe.remove();
  return numbers;
}

// ── the table ──

const wanted = new Set();

function filter() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  let shown = 0;
  for (const row of rows) {
    const text = (row.textContent + " " + document.getElementById(row.dataset.key).querySelector(".ident").textContent).toLowerCase();
    const fits = (!wanted.size || wanted.has(row.dataset.status) || wanted.has(row.dataset.verdict)) && words.every((word) => text.includes(word));
    row.hidden = !fits;
    shown += fits;
  }
  $("shown").textContent = `${shown} of ${rows.length}`;
}

function sort(column, head) {
  const up = head.getAttribute("aria-sort") !== "ascending";
  for (const other of document.querySelectorAll("#table th")) other.setAttribute("aria-sort", "none");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const value = (row) => {
    const cell = row.cells[column];
    return "sort" in cell.dataset ? (cell.dataset.sort === "" ? null : Number(cell.dataset.sort)) : cell.textContent.trim();
  };
  const told = rows.map((row, k) => [value(row), k, row]);
  told.sort(([a, i], [b, j]) => {
    if (a === null || b === null) return (a === null) - (b === null) || i - j; // what has no number comes last, both ways
    const order = typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
    return (up ? order : -order) || i - j;
  });
  $("table").tBodies[0].append(...told.map(([, , row]) => row));
}

document.querySelectorAll("#table th").forEach((head, k) => head.addEventListener("click", () => sort(k, head)));
$("search").addEventListener("input", filter);
for (const chip of document.querySelectorAll(".chip")) {
  chip.setAttribute("aria-pressed", "false");
  chip.addEventListener("click", () => {
    const on = chip.getAttribute("aria-pressed") === "false";
    chip.setAttribute("aria-pressed", String(on));
    wanted[on ? "add" : "delete"](chip.dataset.show);
    filter();
  });
}
filter();

// ── the viewer ──

const facts = JSON.parse($("facts").textContent);
let viewer = null;
let marks = [];

function refresh() {
  if (!viewer) return;
  const c = (name) => colour(name);
  viewer.colours = {
    __proto__: null, // a status may be called anything
    paper: c("--view"), in: c("--in"), none: c("--none"), scan: c("--scan"), design: c("--accent"),
    installed: c("--in"), found: c("--in"), in_tolerance: c("--in"), not_found: c("--out"), out_of_tolerance: c("--out"),
    uncertain: c("--open"), extra: c("--open"), not_judged: c("--open"), occluded: c("--none"), not_enough_data: c("--none"), no_data: c("--none"),
  };
  const mm = viewer.limit * MM;
  $("limit-mm").textContent = `${mm.toFixed(1)} mm`;
  $("low").textContent = `−${mm.toFixed(1)}`;
  $("high").textContent = `+${mm.toFixed(1)} mm`;
  const [inside, outside] = [viewer.scale[0][1], viewer.scale[4][1]];
  const plain = viewer.colouring === 2;
  document.querySelector(".ends").hidden = $("ramp").hidden = plain;
  $("legend-words").textContent = ["Distance from the model: − inside, + outside",
    "Green: within the limit; blue: inside, red: outside it", "Each in the colour of its verdict or status"][viewer.colouring];
  const stops = viewer.colouring === 1
    ? [[0, inside], [0.3, inside], [0.3, viewer.colours.in.map((v) => v * 255)], [0.7, viewer.colours.in.map((v) => v * 255)], [0.7, outside], [1, outside]]
    : viewer.scale.map(([at, rgb]) => [(at + 1) / 2, rgb]);
  $("ramp").style.background = `linear-gradient(90deg, ${stops.map(([at, rgb]) => `rgb(${rgb.map(Math.round).join(" ")}) ${at * 100}%`).join(", ")})`;
  if (viewer.selected >= 0) {
    const line = document.getElementById(facts.items[viewer.selected].key).querySelector(".within");
    const share = viewer.within(viewer.selected);
    line.hidden = share === null;
    if (share !== null) line.querySelector("dd").textContent = `${(share * 100).toFixed(1)} %`;
  }
  viewer.redraw();
}

function choose(k, { look = true, scroll = true } = {}) {
  for (const row of rows) row.setAttribute("aria-selected", String(k >= 0 && row.dataset.key === facts.items[k].key));
  for (const item of document.querySelectorAll(".item")) item.hidden = k < 0 || item.id !== facts.items[k].key;
  $("hint").hidden = k >= 0;
  if (k >= 0) history.replaceState(null, "", `#${facts.items[k].key}`);
  if (scroll && k >= 0) document.querySelector('tr[aria-selected="true"]').scrollIntoView({ block: "nearest" });
  if (!viewer) return;
  viewer.selected = k;
  if (look && k >= 0 && viewer.boxes[k]) viewer.camera.see(viewer.boxes[k], 1.05);
  refresh();
}

function drawOver() {
  const over = $("over");
  over.replaceChildren();
  const put = (name, attributes, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    over.append(made);
  };
  const line = (a, b, kind) => {
    const [p, q] = [viewer.onPage(a), viewer.onPage(b)];
    if (p && q) put("line", { x1: p[0], y1: p[1], x2: q[0], y2: q[1], class: kind });
  };
  if (!$("cuts").hidden) {
    const corner = (k) => [0, 1, 2].map((j) => viewer.cut[(k >> j) & 1][j]);
    for (let k = 0; k < 8; k++) for (let j = 0; j < 3; j++) if (!((k >> j) & 1)) line(corner(k), corner(k | (1 << j)), "box");
  }
  for (const mark of marks) {
    const at = viewer.onPage(mark);
    if (at) put("circle", { cx: at[0], cy: at[1], r: 3.5 });
  }
  if (marks.length === 2) {
    line(marks[0], marks[1], "");
    const at = viewer.onPage(middle(marks));
    const step = add(marks[1], marks[0], -1);
    if (at) put("text", { x: at[0] + 8, y: at[1] - 8 }, `${length(norm(step))}  (Δz ${(step[2] * MM).toFixed(1)} mm)`);
  }
}

function onClick(x, y) {
  const seen = viewer.pick(x, y);
  if ($("measure").getAttribute("aria-pressed") === "true") {
    if (seen) marks = marks.length === 2 ? [seen.at] : [...marks, seen.at];
    viewer.redraw();
  } else choose(seen ? seen.item : -1, { look: false });
}

function toggle(id, onChange) {
  $(id).addEventListener("click", () => {
    const on = $(id).getAttribute("aria-pressed") === "false";
    $(id).setAttribute("aria-pressed", String(on));
    onChange(on);
    refresh();
  });
}

function cutTo(box) {
  viewer.cut = box;
  for (const slider of document.querySelectorAll("[data-cut]")) {
    const k = Number(slider.dataset.cut), [low, high] = [viewer.reach[0][k % 3], viewer.reach[1][k % 3]];
    slider.value = Math.round(1000 * (box[Math.floor(k / 3)][k % 3] - low) / (high - low));
  }
  viewer.redraw();
}

try {
  viewer = new Viewer($("canvas"), facts, {
    positions: bytes("positions"), values: bytes("values"), vertices: bytes("vertices"), faces: bytes("faces"),
  }, facts.scale);
  const whole = facts.around ? [[facts.around.low, add(facts.around.low, facts.around.size)]] : [];
  viewer.reach = viewer.around([...whole, viewer.extent]).map((corner, k) => corner.map((value) => value + (k ? 0.01 : -0.01)));
  viewer.drawn = drawOver;
  const most = Math.max(facts.full, facts.limit);
  const slider = $("limit");
  slider.min = 1;
  slider.max = Math.ceil(most * MM * 10);
  slider.value = Math.round(facts.limit * MM * 10);
  viewer.limit = slider.value / MM / 10;
  slider.addEventListener("input", () => { viewer.limit = slider.value / MM / 10; refresh(); });
  $("colour").addEventListener("change", () => { viewer.colouring = Number($("colour").value); refresh(); });
  for (const box of document.querySelectorAll("[data-layer]")) {
    box.addEventListener("change", () => { viewer.layers[box.dataset.layer] = box.checked; refresh(); });
  }
  toggle("fly", (on) => { viewer.flying = on; $("canvas").focus(); });
  toggle("measure", (on) => { marks = []; $("viewer").classList.toggle("measuring", on); });
  toggle("section", (on) => { $("cuts").hidden = !on; cutTo(on ? viewer.reach : [[-NO_CUT, -NO_CUT, -NO_CUT], [NO_CUT, NO_CUT, NO_CUT]]); });
  for (const cut of document.querySelectorAll("[data-cut]")) {
    cut.addEventListener("input", () => {
      const k = Number(cut.dataset.cut), side = Math.floor(k / 3), axis = k % 3;
      const [low, high] = [viewer.reach[0][axis], viewer.reach[1][axis]];
      viewer.cut = viewer.cut.map((corner, j) => corner.map((value, i) => (j === side && i === axis ? low + cut.value / 1000 * (high - low) : value)));
      viewer.redraw();
    });
  }
  $("cut-item").addEventListener("click", () => {
    const box = viewer.boxes[viewer.selected];
    if (box) cutTo(box.map((corner, k) => corner.map((value) => value + (k ? 0.1 : -0.1))));
  });
  $("whole").addEventListener("click", () => { viewer.camera.see(viewer.extent, 0.8); viewer.redraw(); });
  listen(viewer, onClick);
  refresh();
} catch (error) {
  $("status").textContent = `The three-dimensional view is not available: ${error.message}`;
}

for (const row of rows) {
  const pick = () => choose(facts.items.findIndex((item) => item.key === row.dataset.key), { scroll: false });
  row.addEventListener("click", pick);
  row.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); pick(); } });
}
$("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  refresh();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);
const asked = facts.items.findIndex((item) => `#${item.key}` === location.hash);
if (asked >= 0) choose(asked);
window.scanfindReport = { viewer, choose, facts }; // for tests and the curious
